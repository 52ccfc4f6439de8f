"""A head's picture with its forward kinematics, and the main function of the page's process, which shows it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from sfms_robot.config import Head, load_head
from sfms_robot.data import Report, head_names
from sfms_robot.face.robot_scene import RobotScene

_CELL_PX: Final = (300, 290)
_COLUMNS: Final = 3


def scene_of(head: Head, packages: Sequence[str] = ()) -> RobotScene:
    """Return the scene of a head, a generic one if the head is not shipped and names no URDF. Raises ConfigError.

    `packages`: folders outside the head's that meshes may come from.
    """
    from sfms_robot.retarget.head_retargeter import build_neck  # half a second of imports, after the page's start

    neck = build_neck(head.kinematics, head.joints) if head.kinematics else None
    return RobotScene.of(head, neck, packages)


def main() -> None:
    """Run the page's process, see `viewer.page_child`."""
    from sfms_robot.viewer import page_child  # only for the page's process

    page_child.main(lambda head, packages: scene_of(load_head(head, servos=False), packages))


def draw_scene(name: str, png: Path, packages: Sequence[str] = ()) -> Report:
    """Draw a head at rest; return its URDF, the joints that follow those of the head, and the meshes left out.

    `packages` as for `scene_of`. Raises ConfigError, MissingExtra.
    """
    scene = scene_of(load_head(name), packages)
    from sfms_robot.face.drawing import render_robots

    render_robots(png, [("", scene, scene.rest())])
    return {
        "name": name,
        "urdf": str(scene.urdf),
        "picture": str(png),
        "follows": dict(scene.follows),
        "by_kinematics": [joint for joint in scene.joints if joint not in scene.follows.values()],
        "undriven": list(scene.undriven),
        "left_out": scene.left_out,
    }


def draw_shipped_heads(png: Path) -> None:
    """Draw every shipped head at rest, side by side. Raises ConfigError, MissingExtra."""
    from sfms_robot.face.drawing import render_robots

    robots = []
    for name in head_names():
        scene = scene_of(load_head(name))
        robots.append((name, scene, scene.rest()))
    render_robots(png, robots, _COLUMNS, _CELL_PX)
