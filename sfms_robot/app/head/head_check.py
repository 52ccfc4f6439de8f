"""Recorded faces on a head: the demands on its joints (`head check`), the share it can show (`evaluate fidelity`).

`head check` first reports every problem of the head's file. A sound head is then shown recorded faces, without its
limits, and the demands on its joints are compared with those limits.

For the fidelity the head's joints follow a face, without limits and servos. Their positions are converted back to a
face (the one that explains them with the least motion of the virtual head's skin). The loss is measured on that skin:

    share = 1 - sum over frames of |motion of the skin that is missing or wrong|^2 / sum of |motion of the skin|^2

It is 0 if a head shows nothing, or more wrong than right. For the head's pose it is the same with angles of rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from sfms_robot.app.head.fit import Tracker, skin_motion
from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.app.listen.report import limitation
from sfms_robot.app.open_head import check_safety
from sfms_robot.app.output_paths import INK, new_figure, plain, save
from sfms_robot.app.progress import tracked
from sfms_robot.config import Head, load_head
from sfms_robot.config.check import check_head, remarks
from sfms_robot.config.head import drives
from sfms_robot.data import Report, data_dir, head_names
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, MOTION_DIM, POSE, POSE_CHANNELS, SHAPES, Doubles, Floats, clip_shapes
from sfms_robot.motion.limits import JointLimits
from sfms_robot.retarget.head_retargeter import HeadRetargeter, Neck
from sfms_robot.retarget.response_fit import asked
from sfms_robot.signals.motion_primitives import read_motions
from sfms_robot.signals.tracks import face_stretches, folder_takes

_TICK_HZ: Final = 100.0
_PERCENTILE: Final = 99.0
_AT_END_RAD: Final = 1e-9
_CHUNK: Final = 4000  # rows mapped at once

_RANGE, _USED, _SPEED, _JERK, _OVER = "#dfe6ea", "#1f6f9c", "#5b8c5a", "#c29a2e", "#c8553d"
_WIDTH_IN: Final = 9.0
_ROW_IN: Final = 0.22
_DPI: Final = 80

SHORTEST = 4  # frames, the fewest for a curve through them
_PARTS = {  # kinds of recorded motion, and the channels that they contain
    "faces": SHAPES,
    "talk": SHAPES,
    "smiles": SHAPES,
    "brows": SHAPES,
    "blinks": SHAPES,
    "heads": POSE,
    "sway": slice(0, 3),
}
_ANGLES = slice(0, 3)
_EVERY = 5  # only every fifth frame is used: faces of two neighbours hardly differ


def check(name: str, data: Path | None = None, listener: str | None = None, packages: Sequence[str] = ()) -> Report:
    """Check a head by shipped name or folder, on the bundled faces or those in a folder; return the report.

    A head with `problems` has no other values. `remarks`: settings that are allowed but probably not intended, and
    parts of its picture that are not drawn. Each of `joints` has its `channels`, which move it by its drive or by the
    neck; `used`: share of its range through which the recorded faces move it; `clipped`: share of the time that it is
    at an end of its range that is not its rest; `speed`, `jerk`: 99th percentile of the demand, as a share of its limit
    (over 1 the limiter lags). `neck`: reach along each axis from home [deg or mm], and the share of recorded poses
    within it, None if no recorded face moves its head. `limitation`: channels that the named listener shows on no head.

    `packages`: folders outside the head's that meshes may come from. Raises ConfigError for bad data, and for an
    unknown listener.
    """
    report: Report = {
        "name": name,
        "problems": check_head(name),
        "joints": [],
        "blind_channels": [],
        "remarks": [],
        "dead_joints": [],
        "neck": None,
        "calibrate_first": False,
        "seconds": 0.0,
        "limitation": None,
    }
    limited = limitation(listener) if listener is not None else None
    if report["problems"]:
        return report
    head = load_head(name)
    report["name"] = head.name
    try:
        check_safety(head, head.joints)
        retargeter = HeadRetargeter(head, 1.0 / _TICK_HZ)
        scene = scene_of(head, packages)
    except ConfigError as error:  # a rule that its servos cannot keep, a home that is out of reach, a broken URDF
        return report | {"problems": [str(error)]}
    clips = [clip for _, clip in named_faces(data)]
    return report | {
        "joints": _rows(head, retargeter, [_angles(retargeter, clip) for clip in clips]),
        "blind_channels": retargeter.blind_channels,
        "dead_joints": retargeter.dead_joints,
        "neck": _neck(retargeter.neck, clips) if retargeter.neck else None,
        "calibrate_first": head.calibrate_first,
        "remarks": [*remarks(head), *scene.left_out],
        "seconds": round(sum(len(clip) for clip in clips) * FRAME_S, 1),
        "limitation": limited,
    }


def _angles(retargeter: HeadRetargeter, clip: Floats) -> Doubles:
    """Return angles (N, J) at the tick rate for a clip (T, 58), along a smooth curve, as if every frame were held."""
    times_s = np.arange(len(clip)) * FRAME_S
    ticks_s = np.arange(int((len(clip) - 1) * _TICK_HZ / FRAME_HZ) + 1) / _TICK_HZ
    motion, count = CubicSpline(times_s, clip.astype(np.float64))(ticks_s), len(retargeter.joints)
    parts = [
        retargeter.angles(np.broadcast_to(part[:, None], (len(part), count, part.shape[1])))
        for part in np.array_split(motion, max(1, len(motion) // _CHUNK))
    ]
    return np.concatenate(parts)


def _rows(head: Head, retargeter: HeadRetargeter, clips: Sequence[Doubles]) -> list[Report]:
    limits = JointLimits.of(head)
    rest = head.rest_rad
    every = np.concatenate(clips)
    low, high = every.min(axis=0), every.max(axis=0)
    at_end = ((every <= limits.low + _AT_END_RAD) & (rest > limits.low)) | (
        (every >= limits.high - _AT_END_RAD) & (rest < limits.high)
    )
    figures = {
        "used": (high - low) / (limits.high - limits.low),
        "low_deg": np.degrees(low),
        "high_deg": np.degrees(high),
        "clipped": at_end.mean(axis=0),
        "speed": _largest(clips, 1) / limits.speed,
        "jerk": _largest(clips, 3) / limits.jerk,
    }
    channels = _channels(head, retargeter)
    return [
        {
            "joint": name,
            "servo": joint.model,
            **joint.model_dump(include={"bus", "id", "min_deg", "rest_deg", "max_deg"}),
            "channels": channels[name],
            **{key: float(column[j]) for key, column in figures.items()},
        }
        for j, (name, joint) in enumerate(head.joints.items())
    ]


def _largest(clips: Sequence[Doubles], order: int) -> Doubles:
    """Return the 99th percentile (J,) of a derivative over all clips."""
    found = np.concatenate([np.diff(clip, order, axis=0) for clip in clips]) * _TICK_HZ**order
    return np.asarray(np.percentile(np.abs(found), _PERCENTILE, axis=0))


def _channels(head: Head, retargeter: HeadRetargeter) -> dict[str, Sequence[str]]:
    trees = drives(head)
    found: dict[str, Sequence[str]] = {name: sorted(tree.channels()) if tree else () for name, tree in trees.items()}
    neck, kinematics = retargeter.neck, head.kinematics
    if neck is not None and kinematics is not None:
        for name in neck.joints:
            found[name] = tuple(axis for axis in neck.axes if name in kinematics.joints_of(axis))
    return found


def _neck(neck: Neck, clips: Sequence[Floats]) -> Report:
    poses = np.concatenate([clip[:, : len(POSE_CHANNELS)] for clip in clips]).astype(np.float64)
    shown = np.array([channel in neck.axes for channel in POSE_CHANNELS])
    moved = np.abs(poses).max(axis=1) > 0  # frames without a head pose do not count
    wanted = np.where(shown, poses, 0.0)[moved]
    reached = float(neck.solve(wanted).reached.mean()) if len(wanted) else None
    return {"reach": {axis: _reach(neck, axis) for axis in POSE_CHANNELS if axis in neck.axes}, "reached": reached}


def _reach(neck: Neck, axis: str) -> tuple[float, float]:
    """Return how far the head moves along one axis from home, in whole degrees or millimetres."""
    turn = axis in ("roll", "pitch", "yaw")
    steps = np.arange(1, 181 if turn else 101)
    poses = np.zeros((2, len(steps), len(POSE_CHANNELS)))
    poses[:, :, POSE_CHANNELS.index(axis)] = np.outer([-1, 1], np.radians(steps) if turn else steps / 1000)
    reached = neck.solve(poses).reached.cumprod(axis=1).sum(axis=1)
    return -float(reached[0]), float(reached[1])


# --- the picture ----------------------------------------------------------------------------------------------------


def plot(checked: Report, png: Path) -> None:
    """Draw the check of a sound head: ranges, the part that recorded faces use, and the speed and jerk they demand.

    Raises ConfigError if the file cannot be written, MissingExtra without matplotlib.
    """
    joints = checked["joints"]
    figure = new_figure(_WIDTH_IN, 1.3 + _ROW_IN * max(len(joints), 4), _DPI)
    ranges, demand = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    for row, joint in enumerate(joints):
        for low, high, height, color in (("min_deg", "max_deg", 0.7, _RANGE), ("low_deg", "high_deg", 0.35, _USED)):
            ranges.barh(row, joint[high] - joint[low], left=joint[low], height=height, color=color)
        ranges.plot([joint["rest_deg"]] * 2, [row - 0.35, row + 0.35], color=INK, linewidth=1)
        for offset, share, color in ((-0.18, joint["speed"], _SPEED), (0.18, joint["jerk"], _JERK)):
            demand.barh(row + offset, 100 * share, height=0.32, color=color if share <= 1 else _OVER)
    ranges.set_yticks(range(len(joints)), [joint["joint"] for joint in joints])
    ranges.invert_yaxis()
    ranges.set_xlabel("deg: range, used, and rest", color=INK)
    demand.axvline(100, color=INK, linewidth=1)
    demand.set_xlabel("% of the limit: speed (upper), jerk (lower)", color=INK)
    for axes in (ranges, demand):
        plain(axes, grid="x")
    figure.suptitle(f"{checked['name']} on {checked['seconds']:.0f} s of recorded faces", color=INK, fontsize=11)
    save(figure, png)


# --- fidelity ---------------------------------------------------------------------------------------------------------


def fidelity(heads: Sequence[str] = (), data: Path | None = None) -> Report:
    """Score every shipped head (or those named) on every recorded face, and on all together. Raises ConfigError.

    A row has shares 0..1 of expression and pose; None if the recording has no such motion.
    """
    names = list(heads) or head_names()
    faces: dict[str, list[Floats]] = {}
    for face, clip in named_faces(data):
        faces.setdefault(face, []).append(clip)
    rows = []
    skin = skin_motion()

    def energy(shapes: Doubles) -> float:
        return float(np.einsum("ni,ij,nj->", shapes, skin, shapes, optimize=True))

    for head in map(load_head, tracked(names, "showing faces")):
        neck, tracker = HeadRetargeter(head).neck, Tracker(head)
        sums = {}  # seconds, expression lost and shown, pose lost and shown
        for face, clips in faces.items():
            motion = np.concatenate(clips)
            wanted = motion[::_EVERY, SHAPES].astype(np.float64)
            turns = np.zeros((len(motion), len(POSE_CHANNELS)))
            turns[:, _ANGLES] = motion[:, _ANGLES]
            missing = turns if neck is None else neck.solve(turns).residual_rad  # without a neck, all is missing
            lost = tracker.face(asked(head, wanted)) - wanted
            sums[face] = np.array(
                [len(motion) * FRAME_S, energy(lost), energy(wanted), (missing**2).sum(), (turns**2).sum()]
            )
        sums["all"] = np.sum(list(sums.values()), axis=0)
        for face, total in sums.items():
            seconds, lost, wanted, pose_lost, pose_wanted = total.tolist()
            rows.append(
                {
                    "head": head.name,
                    "face": face,
                    "seconds": round(seconds, 1),
                    "expression": _share(lost, wanted),
                    "pose": _share(pose_lost, pose_wanted),
                }
            )
    return {"version": 1, "rows": rows}


def _share(lost: float, wanted: float) -> float | None:
    return round(max(0.0, 1.0 - lost / wanted), 3) if wanted > 1e-9 else None


# --- recorded faces ---------------------------------------------------------------------------------------------------


def named_faces(folder: Path | None = None) -> list[tuple[str, Floats]]:
    """Return (name, clip) of recorded faces, (T, 58) at 25 fps: the bundled ones, or every CSV track in a folder.

    Raises ConfigError for a folder without tracks, and for a track that cannot be read.
    """
    found = _bundled() if folder is None else [(take.name, take.motion) for take in folder_takes(folder)]
    return [(name, clip) for name, clip in found if len(clip) >= SHORTEST]


def _bundled() -> list[tuple[str, Floats]]:
    sim = data_dir("sim")
    speakers = sorted(sim.glob("speakers/*/face.csv.gz"))
    clips = [(take.name, take.motion) for track in speakers for take in face_stretches(track, track.parent.name)]
    for motions in read_motions(sim / "listeners" / "motions.npz").values():
        for kind, columns in _PARTS.items():
            for piece in getattr(motions, kind):
                clip = np.zeros((len(piece), MOTION_DIM), dtype=np.float32)
                clip[:, columns] = piece
                clip_shapes(clip)
                clips.append((kind, clip))
    return clips
