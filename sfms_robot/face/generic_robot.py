"""The picture of a head without a URDF of its own: a ball on a neck, and a part of the face for each joint.

The neck turns by forward kinematics if the head has `kinematics`, otherwise by the joints that follow roll, pitch and
yaw. Every other joint turns a part at the place that the channels of its drive have in a face. Joints of the same place
are drawn below one another, and a joint without a drive is a bar on top. Sizes are those of a small robot head, in
metres.
"""

from __future__ import annotations

from collections import Counter
from typing import Final
from xml.sax.saxutils import quoteattr

from sfms_robot.config import Head
from sfms_robot.config.head import drives

_AXES: Final = {"yaw": "0 0 1", "pitch": "0 1 0", "roll": "1 0 0"}  # axes of the neck, from the base up
_NECK_M: Final = 0.09  # height of its lowest joint
_STACK_M: Final = 0.013  # distance between two parts of one place
_EYE: Final = '<sphere radius="0.011"/>'
_SKIN: Final = "0.78 0.76 0.72"
# Beginnings of channel names; place of the left part, its shape, axis, colour.
_PARTS: Final = (
    (("eyeLookIn", "eyeLookOut"), (0.066, 0.028, 0.098), _EYE, "0 0 1", "0.95 0.95 0.93"),
    (("eyeLook",), (0.066, 0.028, 0.098), _EYE, "0 1 0", "0.95 0.95 0.93"),
    (("eye",), (0.070, 0.028, 0.112), '<box size="0.014 0.026 0.005"/>', "0 1 0", "0.80 0.62 0.52"),
    (("brow",), (0.066, 0.028, 0.126), '<box size="0.008 0.030 0.006"/>', "1 0 0", "0.30 0.22 0.17"),
    (("cheek",), (0.064, 0.042, 0.076), '<box size="0.010 0.018 0.012"/>', "1 0 0", "0.85 0.60 0.52"),
    (("nose",), (0.078, 0.010, 0.084), '<box size="0.010 0.008 0.012"/>', "1 0 0", "0.80 0.62 0.52"),
    (("jaw", "tongue"), (0.050, 0.020, 0.026), '<box size="0.046 0.050 0.012"/>', "0 1 0", "0.70 0.52 0.45"),
    (("mouth",), (0.072, 0.022, 0.060), '<box size="0.008 0.018 0.006"/>', "1 0 0", "0.72 0.30 0.30"),
    ((), (0.000, 0.045, 0.176), '<box size="0.006 0.006 0.050"/>', "1 0 0", "0.45 0.50 0.55"),
)


def generic_urdf(head: Head) -> bytes:
    """Return a URDF whose joints have the names of the head's joints, or of its pose (`face.robot_scene`)."""
    foot = _visual('<box size="0.1 0.12 0.02"/>', "0 0 0.01", _SKIN)
    post = _visual('<cylinder radius="0.016" length="0.08"/>', "0 0 0.06", _SKIN)
    elements = [f'<link name="base">{foot}{post}</link>']
    channels = {name: drive.channels() if drive else set[str]() for name, drive in drives(head).items()}
    turning, neck = {name: axis for axis in _AXES for name, used in channels.items() if axis in used}, set[str]()
    if head.kinematics is not None:
        turning, neck = {f"pose_{axis}": axis for axis in _AXES}, set(head.kinematics.joints())
    parent, height_m = "base", _NECK_M
    for name, axis in turning.items():
        elements.append(_part(name, parent, f"{name}_link", (0, 0, height_m), _AXES[axis]))
        parent, height_m = f"{name}_link", 0.0
    ball = _visual('<sphere radius="0.075"/>', "0 0 0.082", _SKIN)
    elements.append(_part("head_fixed", parent, "head", (0, 0, height_m), "", ball))
    taken = Counter[tuple[int, int]]()
    for name, used in channels.items():
        if name in turning or name in neck:
            continue
        rows = (i for i, (begins, *_) in enumerate(_PARTS) if any(c.startswith(begins) for c in used))
        row = next(rows, len(_PARTS) - 1)
        _, (x, y, z), shape, axis, color = _PARTS[row]
        side = 1 if "left" in name or name.endswith("_l") else -1 if "right" in name or name.endswith("_r") else 0
        if shape == _EYE and not side:  # a joint of both eyes: a bar between them, not a third eye
            shape = '<box size="0.006 0.03 0.005"/>'
        place = (x, side * y, z - _STACK_M * taken[row, side])
        taken[row, side] += 1
        visuals = [_visual(shape, "0 0 0", color)]
        if shape == _EYE:
            visuals.append(_visual('<sphere radius="0.005"/>', "0.009 0 0", "0.15 0.15 0.18"))
        elements.append(_part(name, "head", f"{name}_link", place, axis, *visuals))
    return "\n".join([f"<robot name={quoteattr(head.name)}>", *elements, "</robot>"]).encode()


def _visual(shape: str, place: str, color: str) -> str:
    return (
        f'<visual><origin xyz="{place}"/><geometry>{shape}</geometry>'
        f'<material name=""><color rgba="{color} 1"/></material></visual>'
    )


def _part(name: str, parent: str, link: str, place: tuple[float, float, float], axis: str, *visuals: str) -> str:
    """Return a link, and the joint that holds it; without an `axis` the joint is fixed."""
    kind = f'type="continuous"><axis xyz="{axis}"/>' if axis else 'type="fixed">'
    return (
        f"<link name={quoteattr(link)}>{''.join(visuals)}</link>\n"
        f'<joint name={quoteattr(name)} {kind}<parent link="{parent}"/><child link="{link}"/>'
        f'<origin xyz="{" ".join(map(str, place))}"/></joint>'
    )
