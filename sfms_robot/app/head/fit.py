"""`head fit`: a recording of a head's joints, and of what a face tracker saw on it -> drives that look as asked.

A recording is a folder: `run.mcap` as `run --record` and `head fit --babble` write it, and beside it `face.csv` (or
.csv.gz), the track of the robot's own face on the same clock. How late the tracker is, is found from the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.config import Head, load_head
from sfms_robot.config.head import drives
from sfms_robot.config.overlay import FitLayer, Fitted, head_hash, layered, load_overlay, overlay_file, save_overlay
from sfms_robot.errors import ConfigError
from sfms_robot.face.tracker import Skin, Tracker
from sfms_robot.frames import BLENDSHAPES, MOTION_DIM, SHAPES, Doubles, Floats
from sfms_robot.retarget.channel_mapping import Units
from sfms_robot.retarget.response_fit import Response, fit, fitted_drives, looks_like, rms
from sfms_robot.signals.tracks import Track, read_track, write_track

FACE_FILES: Final = ("face.csv", "face.csv.gz")
PRACTICE_NOISE: Final = 0.01
_DELAYS_S: Final = np.arange(-0.1, 0.41, 0.02)
_BLOCK: Final = 50  # frames; every fifth block is held out
_MOVING: Final = 0.05  # joint units


@dataclass(frozen=True)
class Pairs:
    """N instants at which joints stood somewhere and a face was seen: angles (N, J) [rad], shapes (N, 52)."""

    angles_rad: Doubles
    shapes: Floats
    delay_s: float


@dataclass(frozen=True)
class FitRow:
    """One joint, rms errors in joint units on held-out frames: what it looked like against what it was told.

    `before` with the drive of the file, `after` with the response learnt; None for a joint that hardly moved.
    """

    joint: str
    moved: tuple[float, float] | None
    before: float | None
    after: float | None


@dataclass(frozen=True)
class HeadFit:
    """What was learnt. `file` is where it was written."""

    head: str
    frames: int
    delay_s: float
    before: float
    after: float
    rows: Sequence[FitRow]
    file: str

    def as_dict(self) -> dict[str, Any]:
        told = asdict(self)
        told["joints"] = told.pop("rows")
        return told


def fit_head(name: str, recording: Path, practice: bool = False) -> HeadFit:
    """Learn from a recording and write the overlay's fit layer. Raises ConfigError for what cannot be used.

    `practice`: what was seen is the virtual head; the overlay goes beside that of the real one and is never used.
    """
    shipped, sha256 = load_head(name), head_hash(name)
    file = overlay_file(shipped.name, practice)
    overlay = load_overlay(shipped, file)
    head = layered(shipped, overlay.model_copy(update={"fit": None}), sha256).head
    pairs = read_pairs(head, recording)
    units = Units.of(head)
    has, looks = units.values(pairs.angles_rad), looks_like(head, pairs.shapes)
    held_out = np.arange(len(has)) // _BLOCK % 5 == 4
    dead = np.array([drive is None for drive in drives(head).values()])
    has[:, dead] = looks[:, dead] = 0.0  # a neck, say: nothing on the face follows it
    trial = fit(has[~held_out], looks[~held_out], units.low, units.high)
    rows = _rows(head, trial, has[held_out], looks[held_out])
    measured = [row for row in rows if row.before is not None and row.after is not None]
    if not measured:
        raise ConfigError(f"{recording}: no joint moved enough to learn from ({', '.join(head.joints)})")
    learnt = fitted_drives(head, fit(has, looks, units.low, units.high))
    layer = FitLayer(
        head_sha256=sha256,
        date=date.today(),
        note=f"{len(has)} frames of {recording.name}",
        joints={joint: Fitted(drive=drive) for joint, drive in learnt.items()},
    )
    layered(shipped, changed := overlay.model_copy(update={"fit": layer}), sha256)  # refuses what is not sound
    save_overlay(changed, file)
    before, after = (rms(np.array([getattr(row, key) for row in measured])) for key in ("before", "after"))
    return HeadFit(head.name, len(has), pairs.delay_s, before, after, rows, str(file))


def _rows(head: Head, responses: Sequence[Response | None], has: Doubles, looks: Doubles) -> list[FitRow]:
    rows = []
    for j, (joint, response) in enumerate(zip(head.joints, responses, strict=True)):
        if response is None:
            rows.append(FitRow(joint, None, None, None))
            continue
        seen = looks[:, j] - response.offset
        errors = rms(seen - has[:, j]), rms(seen - response(has[:, j]))
        rows.append(FitRow(joint, response.moved, *errors))
    return rows


def read_pairs(head: Head, folder: Path) -> Pairs:
    """Joints and face of a recording at the instants of its face track. Raises ConfigError."""
    run = read_recording(folder)
    if missing := [joint for joint in head.joints if joint not in run.joints]:
        recorded = run.about.get("head", "?")
        raise ConfigError(f"{folder}: is of head {recorded!r}, without joint {missing[0]!r} of {head.name!r}")
    found = [folder / name for name in FACE_FILES if (folder / name).is_file()]
    if not found:
        raise ConfigError(f"{folder}: has no {FACE_FILES[0]}: the track of the robot's own face, on the run's clock")
    track = read_track(found[0])
    seen = np.isfinite(track.motion).all(axis=1)
    times_s, shapes = track.times_s[seen], track.motion[seen][:, SHAPES]
    columns = [run.joints.index(joint) for joint in head.joints]
    goals, present = run.goals_rad[:, columns], run.present_rad[:, columns]
    angles = np.where(np.isfinite(present).all(axis=0), present, goals)  # a hobby servo never tells where it is
    delay_s = _delay(head, run.times_s, angles, times_s, shapes)
    at_s = times_s - delay_s
    inside = (at_s >= run.times_s[0]) & (at_s <= run.times_s[-1])
    if not inside.any():
        ends = f"{run.times_s[0]:.1f}..{run.times_s[-1]:.1f} s"
        raise ConfigError(f"{found[0]}: column time lies outside the run ({ends})")
    return Pairs(_at(at_s[inside], run.times_s, angles), shapes[inside], delay_s)


def _at(at_s: Doubles, times_s: Doubles, values: Doubles) -> Doubles:
    return np.stack([np.interp(at_s, times_s, column) for column in values.T], axis=1)


def _delay(head: Head, run_s: Doubles, angles: Doubles, face_s: Doubles, shapes: Floats) -> float:
    """How late the tracker is: where joints and looks go together best."""
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


def see_virtual_face(head: Head, folder: Path, seed: int = 1) -> None:
    """Beside a recorded run on emulated servos, what a tracker would have seen: a face with a skin of its own."""
    run = read_recording(folder)
    columns = [run.joints.index(joint) for joint in head.joints]
    step = max(1, round(0.04 / float(np.median(np.diff(run.times_s)))))
    angles = np.where(np.isfinite(run.present_rad), run.present_rad, run.goals_rad)[::step, columns]
    tracker = virtual_tracker(head, Skin.hidden(len(columns), seed), PRACTICE_NOISE)
    motion = np.zeros((len(angles), MOTION_DIM), dtype=np.float32)
    motion[:, SHAPES] = tracker.seen(Units.of(head).values(angles), np.random.default_rng(seed))
    known = frozenset(BLENDSHAPES)
    write_track(folder / FACE_FILES[0], Track(run.times_s[::step], motion, known))


def virtual_tracker(head: Head, skin: Skin, noise: float = 0.0) -> Tracker:
    """A tracker that sees the virtual face of this head."""
    return Tracker(showing(head), skin, noise)


def showing(head: Head) -> Doubles:
    """(J, 52) the value that every blendshape, alone and at 1, asks of every joint."""
    return looks_like(head, np.eye(len(BLENDSHAPES), dtype=np.float32)).T
