"""`head fit`: a recording of a head's joints, and a face tracker's track of it -> drives that show each expression.

A recording is a folder: `run.mcap` as `run --record` and `head fit --babble` write it, and `face.csv` (or .csv.gz), the
track of the robot's face on the same clock. The delay of the tracker is estimated from the two.

`--babble` moves every channel that the head follows up and down once, alone; then several at a time, at random, as
faces do. The pose of the head stays at rest, so that a camera in front of it sees the face throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.app.head.pose import FaceTrack
from sfms_robot.app.listen.report import failure
from sfms_robot.app.options import SIM, HeadOptions
from sfms_robot.app.replay.run_file import RunRecording, read_recording
from sfms_robot.app.session import Panel
from sfms_robot.config import Head, load_head
from sfms_robot.config.head import drives
from sfms_robot.config.overlay import (
    FitLayer,
    Fitted,
    check_writable,
    head_hash,
    layered,
    load_overlay,
    overlay_file,
    save_overlay,
)
from sfms_robot.data import Report
from sfms_robot.errors import ConfigError
from sfms_robot.face.human import load_human
from sfms_robot.frames import BLENDSHAPES, MOTION_DIM, SHAPES, Doubles, Floats
from sfms_robot.listeners.space import bounded_least_squares
from sfms_robot.retarget.channel_mapping import Units
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.retarget.response_fit import Response, fit, fitted_drives, looks_like, rms
from sfms_robot.runtime.safety import EASE_S
from sfms_robot.signals.tracks import Track, read_track, write_track

FACE_FILES: Final = ("face.csv", "face.csv.gz")
PRACTICE_NOISE: Final = 0.01  # noise of a blendshape, 1 sigma
_PRACTICE_SEED: Final = 1
ALONE_S: Final = 1.6  # time for one channel alone, up and down again
TOGETHER_S: Final = 1.0  # time from one random face to the next
AT_ONCE: Final = 6  # channels in a random face
_DELAYS_S: Final = np.arange(-0.1, 0.41, 0.02)
_BLOCK: Final = 50  # frames; every fifth block is held out
_MOVING: Final = 0.05  # least travel of a joint that counts as moving, in joint units
_LEAST_MOTION_PRICE: Final = 0.002  # weight of skin motion, against the unexplained part of a joint's value
_SIZE_PRICE: Final = 0.01  # weight of the size of a shape, for shapes that hardly move the skin


# --- babble -----------------------------------------------------------------------------------------------------------


def babble(options: HeadOptions, record: Path, *, minutes: float, seed: int, panel: Panel | None = None) -> Report:
    """Move the face at random, and record the run in a folder. Block until the end; return its report.

    Raises RobotError with the head at rest; ConfigError, before it moves, if the fit could not be written.
    """
    head = load_head(options.head)
    check_writable(overlay_file(head.name, practice=options.port == SIM))
    blind = HeadRetargeter(head).blind_channels
    faces = random_faces([i for i, shape in enumerate(BLENDSHAPES) if shape not in blind], 60.0 * minutes, seed)
    report = faces.play(options, panel, record=record)
    if (error := failure(report)) is not None:
        raise error
    return report


def random_faces(channels: Sequence[int], duration_s: float, seed: int) -> FaceTrack:
    """Return a track of each channel alone, then of random faces until the time is over; neutral at both ends."""
    rng = np.random.default_rng(seed)
    times_s, shapes = [EASE_S], [np.zeros(len(BLENDSHAPES))]
    for channel in channels:
        for value in (1.0, 0.0):
            times_s.append(times_s[-1] + ALONE_S / 2)
            shapes.append(np.eye(len(BLENDSHAPES))[channel] * value)
    while channels and times_s[-1] < duration_s - TOGETHER_S:
        face = np.zeros(len(BLENDSHAPES))
        face[rng.permutation(channels)[:AT_ONCE]] = rng.uniform(0.0, 1.0, min(AT_ONCE, len(channels)))
        times_s.append(times_s[-1] + TOGETHER_S)
        shapes.append(face)
    motion = np.zeros((len(shapes) + 1, MOTION_DIM), dtype=np.float32)
    motion[:-1, SHAPES] = shapes
    return FaceTrack(np.array([*times_s, times_s[-1] + TOGETHER_S]), motion, smooth=True)


# --- fit --------------------------------------------------------------------------------------------------------------


def fit_head(name: str, recording: Path) -> Report:
    """Learn from a recording, write the overlay's fit layer, and report both. Raises ConfigError for a bad recording.

    Errors are rms in joint units on held-out frames, between the seen and the commanded value: `before` with the drive
    of the file, `after` with the learnt response; None for a joint that hardly moved. `file`: the written file.

    `practice`: the recording is of emulated servos; its fit is kept apart from that of the real head and never used.
    """
    shipped, sha256, run = load_head(name), head_hash(name), read_recording(recording)
    practice = run.about.get("port") == SIM
    file = check_writable(overlay_file(shipped.name, practice))
    overlay = load_overlay(shipped, file)
    head = layered(shipped, overlay.replaced(fit=None), sha256).head
    angles_rad, shapes, delay_s = read_pairs(head, recording, run)
    units = Units.of(head)
    has, looks = units.values(angles_rad), looks_like(head, shapes)
    held_out = np.arange(len(has)) // _BLOCK % 5 == 4
    dead = np.array([drive is None for drive in drives(head).values()])
    has[:, dead] = looks[:, dead] = 0.0  # for example a neck joint, which moves nothing on the face
    trial = fit(has[~held_out], looks[~held_out], units.low, units.high)
    rows = _rows(head, trial, has[held_out], looks[held_out])
    measured = [row for row in rows if row["moved"] is not None]
    if not measured:
        raise ConfigError(f"{recording}: no joint moved enough to learn from ({', '.join(head.joints)})")
    learnt = fitted_drives(head, fit(has, looks, units.low, units.high))
    layer = FitLayer(
        head_sha256=sha256,
        date=date.today(),
        note=f"{len(has)} frames of {recording.name}",
        joints={joint: Fitted(drive=drive) for joint, drive in learnt.items()},
    )
    layered(shipped, changed := overlay.replaced(fit=layer), sha256)  # raises ConfigError for an invalid layer
    save_overlay(changed, file)
    return {
        "head": head.name,
        "frames": len(has),
        "delay_s": delay_s,
        **{key: rms(np.array([row[key] for row in measured])) for key in ("before", "after")},
        "joints": rows,
        "file": str(file),
        "practice": practice,
    }


def _rows(head: Head, responses: Sequence[Response | None], has: Doubles, looks: Doubles) -> list[Report]:
    rows = []
    for joint, response, value, look in zip(head.joints, responses, has.T, looks.T, strict=True):
        row: Report = {"joint": joint, "moved": None, "before": None, "after": None}
        if response is not None:
            seen = look - response.offset
            row |= {"moved": response.moved, "before": rms(seen - value), "after": rms(seen - response(value))}
        rows.append(row)
    return rows


def read_pairs(head: Head, folder: Path, run: RunRecording) -> tuple[Doubles, Floats, float]:
    """Return angles (N, J) [rad] and faces (N, 52) at the N instants of a recording's face track, and its delay [s].

    `run`: the recording of `folder`. Raises ConfigError.
    """
    if missing := [joint for joint in head.joints if joint not in run.joints]:
        raise ConfigError(
            f"{folder}: is of head {run.about.get('head', '?')!r}, without joint {missing[0]!r} of {head.name!r}"
        )
    found = [folder / name for name in FACE_FILES if (folder / name).is_file()]
    if not found:
        raise ConfigError(f"{folder}: has no {FACE_FILES[0]}: the track of the robot's own face, on the run's clock")
    track = read_track(found[0])
    seen = np.isfinite(track.motion).all(axis=1)
    times_s, shapes = track.times_s[seen], track.motion[seen][:, SHAPES]
    columns = [run.joints.index(joint) for joint in head.joints]
    goals, present = run.goals_rad[:, columns], run.present_rad[:, columns]
    angles = np.where(np.isfinite(present).all(axis=0), present, goals)  # a hobby servo reports no position
    delay_s = _delay(head, run.times_s, angles, times_s, shapes)
    at_s = times_s - delay_s
    inside = (at_s >= run.times_s[0]) & (at_s <= run.times_s[-1])
    if not inside.any():
        raise ConfigError(
            f"{found[0]}: column time lies outside the run ({run.times_s[0]:.1f}..{run.times_s[-1]:.1f} s)"
        )
    return _at(at_s[inside], run.times_s, angles), shapes[inside], delay_s


def _at(at_s: Doubles, times_s: Doubles, values: Doubles) -> Doubles:
    return np.stack([np.interp(at_s, times_s, column) for column in values.T], axis=1)


def _delay(head: Head, run_s: Doubles, angles: Doubles, face_s: Doubles, shapes: Floats) -> float:
    """Return the delay of the tracker [s] at which joints and faces correlate best."""
    units = Units.of(head)
    looks = looks_like(head, shapes)
    moving = np.flatnonzero((np.ptp(units.values(angles), axis=0) > _MOVING) & (np.ptp(looks, axis=0) > _MOVING))
    if not len(moving):
        return 0.0
    looks = looks[:, moving] - looks[:, moving].mean(axis=0)
    scores = []
    for delay_s in _DELAYS_S:
        has = units.values(_at(face_s - delay_s, run_s, angles))[:, moving]
        has = has - has.mean(axis=0)
        size = np.sqrt((has**2).sum(axis=0) * (looks**2).sum(axis=0))
        scores.append(float(((has * looks).sum(axis=0) / np.where(size > 0, size, 1.0)).sum()))
    return round(float(_DELAYS_S[int(np.argmax(scores))]), 3)


def see_virtual_face(name: str, folder: Path) -> None:
    """Write the track of a virtual face, with a random skin, into the folder of a run on emulated servos."""
    head, run = load_head(name), read_recording(folder)
    columns = [run.joints.index(joint) for joint in head.joints]
    step = max(1, round(0.04 / float(np.median(np.diff(run.times_s)))))
    angles = np.where(np.isfinite(run.present_rad), run.present_rad, run.goals_rad)[::step, columns]
    motion = np.zeros((len(angles), MOTION_DIM), dtype=np.float32)
    tracker = Tracker(head, hidden_skin(len(columns), _PRACTICE_SEED))
    motion[:, SHAPES] = tracker.seen(Units.of(head).values(angles), np.random.default_rng(_PRACTICE_SEED))
    write_track(folder / FACE_FILES[0], Track(run.times_s[::step], motion, frozenset(BLENDSHAPES)))


# --- a virtual tracker ------------------------------------------------------------------------------------------------

Skin = Callable[[Doubles], Doubles]  # values of joints (N, J) -> their look (N, J), in joint units


def hidden_skin(joints: int, seed: int) -> Skin:
    """Return a random skin: gain x (|value| beyond a dead band)^power for each joint and each side of rest."""
    rng = np.random.default_rng(seed)
    ranges = (0.85, 1.3), (0.5, 2.0), (0.0, 0.06)
    parts = [rng.uniform(low, high, (2, joints)) for low, high in ranges]  # below rest, above rest

    def look(values: Doubles) -> Doubles:
        gain, power, dead = (np.where(values > 0, above, below) for below, above in parts)
        beyond = np.maximum(np.abs(values) - dead, 0.0) / (1.0 - dead)
        out: Doubles = np.sign(values) * gain * beyond**power
        return out

    return look


class Tracker:
    """A virtual face tracker that sees the virtual face of a head: joint values in, blendshapes out.

    It reports the face that explains the look of the joints: of all blendshapes 0..1 that would drive the joints like
    this, those that move the virtual head's skin least. `skin` None: the skin that the head's file assumes.
    """

    def __init__(self, head: Head, skin: Skin | None = None) -> None:
        self._skin, identity = skin or (lambda values: values), np.eye(len(BLENDSHAPES))
        showing = looks_like(head, identity.astype(np.float32)).T  # (J, 52)
        least = np.sqrt(_LEAST_MOTION_PRICE) * np.linalg.cholesky(skin_motion() + 1e-9 * identity).T
        self._matrix = np.concatenate([showing, least, _SIZE_PRICE * identity])

    def face(self, values: Doubles) -> Doubles:
        """Return blendshapes (N, 52) 0..1 for joint values (N, J), without noise."""
        shown = self._skin(values)
        none, all_ = np.zeros(len(BLENDSHAPES)), np.ones(len(BLENDSHAPES))
        wanted = np.pad(shown, ((0, 0), (0, len(self._matrix) - shown.shape[1])))
        return bounded_least_squares(self._matrix, wanted, none, all_)

    def seen(self, values: Doubles, rng: np.random.Generator) -> Floats:
        """Return `face` with noise."""
        face = self.face(values)
        return np.clip(face + rng.normal(0.0, PRACTICE_NOISE, face.shape), 0.0, 1.0).astype(np.float32)


def skin_motion() -> Doubles:
    """Return a matrix (52, 52) of how similarly two blendshapes move the skin; the mean of its diagonal is 1.

    For blendshapes b, b skin_motion b is the mean square displacement of the vertices, in units of that of one shape.
    """
    deltas = load_human().deltas.reshape(len(BLENDSHAPES), -1).astype(np.float64)
    gram = deltas @ deltas.T
    out: Doubles = gram * (len(BLENDSHAPES) / np.trace(gram))
    return out
