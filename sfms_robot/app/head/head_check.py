"""What a head makes of recorded faces, joint by joint: what `sfms-robot head check` tells.

Every problem of the file comes first, all at once; a sound head is then shown recorded faces, without its limits, and
what its joints would have to do is held against what they may.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from scipy.interpolate import CubicSpline

from sfms_robot.app.head.faces import recorded_faces
from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.app.listen.report import limitation
from sfms_robot.app.open_head import check_safety
from sfms_robot.app.out_files import INK, new_figure, plain, save
from sfms_robot.app.wiring import firmware_maps
from sfms_robot.config import Head, load_head
from sfms_robot.config.check import check_head
from sfms_robot.config.head import drives
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, POSE_CHANNELS, Doubles, Floats
from sfms_robot.motion.limits import JointLimits
from sfms_robot.retarget.head_retargeter import HeadRetargeter, Neck

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TICK_HZ: Final = 100.0
_PERCENTILE: Final = 99.0
_AT_END_RAD: Final = 1e-9
_CHUNK: Final = 4000  # rows mapped at once

_RANGE, _USED, _SPEED, _JERK, _OVER = "#dfe6ea", "#1f6f9c", "#5b8c5a", "#c29a2e", "#c8553d"
_WIDTH_IN: Final = 9.0
_ROW_IN: Final = 0.22
_DPI: Final = 80


@dataclass(frozen=True)
class JointCheck:
    """One row of the table.

    Attributes:
        channels: what moves it, by its drive or by the neck.
        used: share of its range that the recorded faces move it through, 0..1.
        clipped: share of the time it is at an end of its range that is not its rest, 0..1.
        speed, jerk: 99th percentile of what the faces ask of it, as a share of its limit; over 1 the limiter lags.
    """

    joint: str
    servo: str
    bus: str
    id: int
    min_deg: float
    rest_deg: float
    max_deg: float
    channels: Sequence[str]
    used: float
    low_deg: float
    high_deg: float
    clipped: float
    speed: float
    jerk: float


@dataclass(frozen=True)
class NeckCheck:
    """How far the neck goes along each axis from home [deg or mm], and the share of recorded poses in its reach.

    `reached` is None where no recorded face moves its head.
    """

    reach: dict[str, tuple[float, float]]
    reached: float | None


@dataclass(frozen=True)
class HeadCheck:
    """Everything about one head; after `problems` there is nothing else.

    `limitation`: what the listener that was named cannot show on any head, or None.
    """

    name: str
    problems: Sequence[str]
    joints: Sequence[JointCheck] = ()
    blind_channels: Sequence[str] = ()
    dead_joints: Sequence[str] = ()
    neck: NeckCheck | None = None
    calibrate_first: bool = False
    seconds: float = 0.0
    limitation: str | None = None

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def check(name: str, data: Path | None = None, listener: str | None = None, packages: Sequence[str] = ()) -> HeadCheck:
    """Check a head by shipped name or folder, on the bundled faces or those in a folder.

    `packages`: folders outside the head's that meshes may come from. Raises ConfigError for bad data, and for a
    listener that is not one.
    """
    limited = limitation(listener) if listener is not None else None
    problems = check_head(name)
    if problems:
        return HeadCheck(name, problems)
    head = load_head(name)
    try:
        check_safety(head, head.joints, firmware_maps(head.joints))
        retargeter = HeadRetargeter(head, 1.0 / _TICK_HZ)
        scene = scene_of(head, packages)
    except ConfigError as error:  # what no servo of it can do, a home that is out of reach, a broken URDF
        return HeadCheck(head.name, [str(error)])
    if scene and scene.left_out:
        return HeadCheck(head.name, scene.left_out)
    clips = recorded_faces(data)
    angles = [_angles(retargeter, _at_ticks(clip)) for clip in clips]
    neck = _neck(retargeter.neck, clips) if retargeter.neck else None
    return HeadCheck(
        head.name,
        (),
        _rows(head, retargeter, angles),
        retargeter.blind_channels,
        retargeter.dead_joints,
        neck,
        head.calibrate_first,
        round(sum(len(clip) for clip in clips) * FRAME_S, 1),
        limited,
    )


def _at_ticks(clip: Floats) -> Doubles:
    """A clip (T, 58) at the tick rate, as a curve without kinks; expressions stay within 0..1."""
    times_s = np.arange(len(clip)) * FRAME_S
    ticks_s = np.arange(int((len(clip) - 1) * _TICK_HZ / FRAME_HZ) + 1) / _TICK_HZ
    return np.asarray(CubicSpline(times_s, clip.astype(np.float64))(ticks_s))


def _angles(retargeter: HeadRetargeter, motion: Doubles) -> Doubles:
    """Motion (N, 58) -> angles (N, J), as if every frame were held."""
    count = len(retargeter.joints)
    parts = [
        retargeter.angles(np.broadcast_to(part[:, None], (len(part), count, part.shape[1])))
        for part in np.array_split(motion, max(1, len(motion) // _CHUNK))
    ]
    return np.concatenate(parts)


def _rows(head: Head, retargeter: HeadRetargeter, clips: Sequence[Doubles]) -> list[JointCheck]:
    limits = JointLimits.of(head)
    rest = np.array([joint.rest_rad for joint in head.joints.values()])
    every = np.concatenate(clips)
    low, high = every.min(axis=0), every.max(axis=0)
    at_end = ((every <= limits.low + _AT_END_RAD) & (rest > limits.low)) | (
        (every >= limits.high - _AT_END_RAD) & (rest < limits.high)
    )
    speed = _largest(clips, 1) / limits.speed
    jerk = _largest(clips, 3) / limits.jerk
    channels = _channels(head, retargeter)
    return [
        JointCheck(
            name,
            joint.model,
            joint.bus,
            joint.id,
            joint.min_deg,
            joint.rest_deg,
            joint.max_deg,
            channels[name],
            float((high[j] - low[j]) / (limits.high[j] - limits.low[j])),
            float(np.degrees(low[j])),
            float(np.degrees(high[j])),
            float(at_end[:, j].mean()),
            float(speed[j]),
            float(jerk[j]),
        )
        for j, (name, joint) in enumerate(head.joints.items())
    ]


def _largest(clips: Sequence[Doubles], order: int) -> Doubles:
    """99th percentile (J,) of a derivative over all clips."""
    found = np.concatenate([np.diff(clip, order, axis=0) for clip in clips]) * _TICK_HZ**order
    return np.asarray(np.percentile(np.abs(found), _PERCENTILE, axis=0))


def _channels(head: Head, retargeter: HeadRetargeter) -> dict[str, Sequence[str]]:
    trees = drives(head)
    found: dict[str, Sequence[str]] = {name: sorted(tree.channels()) if tree else () for name, tree in trees.items()}
    if retargeter.neck is not None:
        for name in retargeter.neck.joints:
            found[name] = _axes_of(head, retargeter.neck, name)
    return found


def _axes_of(head: Head, neck: Neck, joint: str) -> Sequence[str]:
    """The axes of a serial neck that a joint has a part in; of a platform, all, and yaw for the body."""
    kinematics = head.kinematics
    if kinematics is None or kinematics.kind == "stewart":
        body = kinematics is not None and kinematics.body_yaw is not None and kinematics.body_yaw.joint == joint
        return ("yaw",) if body else tuple(neck.axes)
    pair = kinematics.differential
    if pair is not None and joint in (pair.left, pair.right):
        return ("pitch", "roll")
    return tuple(
        axis
        for axis, place in kinematics.axes.items()
        if place == joint or (not isinstance(place, str) and joint in (place.lower, place.upper))
    )


def _neck(neck: Neck, clips: Sequence[Floats]) -> NeckCheck:
    poses = np.concatenate([clip[:, : len(POSE_CHANNELS)] for clip in clips]).astype(np.float64)
    shown = np.array([channel in neck.axes for channel in POSE_CHANNELS])
    moved = np.abs(poses).max(axis=1) > 0  # clips without a head say nothing about the neck
    asked = np.where(shown, poses, 0.0)[moved]
    reached = float(neck.solve(asked).reached.mean()) if len(asked) else None
    return NeckCheck({axis: _reach(neck, axis) for axis in POSE_CHANNELS if axis in neck.axes}, reached)


def _reach(neck: Neck, axis: str) -> tuple[float, float]:
    """How far the head goes along one axis from home, in whole degrees or millimetres."""
    turn = axis in ("roll", "pitch", "yaw")
    steps = np.arange(1, 181 if turn else 101)
    poses = np.zeros((2, len(steps), len(POSE_CHANNELS)))
    poses[:, :, POSE_CHANNELS.index(axis)] = np.outer([-1, 1], np.radians(steps) if turn else steps / 1000)
    reached = neck.solve(poses).reached.cumprod(axis=1).sum(axis=1)
    return -float(reached[0]), float(reached[1])


# --- the picture ----------------------------------------------------------------------------------------------------


def plot(checked: HeadCheck, png: Path) -> None:
    """Draw the check of a sound head: ranges, what recorded faces use of them, and how fast they ask joints to be.

    Raises ConfigError where the file cannot be written, MissingExtra without matplotlib.
    """
    figure = new_figure(_WIDTH_IN, 1.3 + _ROW_IN * max(len(checked.joints), 4), _DPI)
    ranges, demand = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    _ranges(ranges, checked)
    _demand(demand, checked)
    figure.suptitle(f"{checked.name} on {checked.seconds:.0f} s of recorded faces", color=INK, fontsize=11)
    save(figure, png)


def _ranges(axes: Axes, checked: HeadCheck) -> None:
    for row, joint in enumerate(checked.joints):
        axes.barh(row, joint.max_deg - joint.min_deg, left=joint.min_deg, height=0.7, color=_RANGE)
        axes.barh(row, joint.high_deg - joint.low_deg, left=joint.low_deg, height=0.35, color=_USED)
        axes.plot([joint.rest_deg] * 2, [row - 0.35, row + 0.35], color=INK, linewidth=1)
    axes.set_yticks(range(len(checked.joints)), [joint.joint for joint in checked.joints])
    axes.invert_yaxis()
    axes.set_xlabel("deg: range, used, and rest", color=INK)
    plain(axes, grid="x")


def _demand(axes: Axes, checked: HeadCheck) -> None:
    for row, joint in enumerate(checked.joints):
        for offset, share, color in ((-0.18, joint.speed, _SPEED), (0.18, joint.jerk, _JERK)):
            axes.barh(row + offset, 100 * share, height=0.32, color=color if share <= 1 else _OVER)
    axes.axvline(100, color=INK, linewidth=1)
    axes.set_xlabel("% of the limit: speed (upper), jerk (lower)", color=INK)
    plain(axes, grid="x")
