"""Main function of the page's process: the server of `viewer`, with the robot's picture and its forward kinematics."""

from __future__ import annotations

from collections.abc import Sequence

from sfms_robot.config import load_head
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.viewer import page_child


def main() -> None:
    """See `viewer.page_child`."""
    page_child.main(named_scene)


def named_scene(head: str, packages: Sequence[str]) -> RobotScene | None:
    """Return the picture of a head by its name or folder; None: it has none. Raises ConfigError."""
    from sfms_robot.app.head.head_scene import scene_of  # half a second of imports, which a page has not to wait for

    return scene_of(load_head(head), packages)
