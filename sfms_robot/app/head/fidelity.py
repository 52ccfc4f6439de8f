"""How much of a recorded face a head can show at all, its limits and its servos left aside.

The head's joints are asked for the face; what they stand for is a face again (the one that explains them while moving
the virtual head's skin least); and what is lost on the way is measured on that skin:

    share = 1 - sum over frames of |way of the skin that is missing or wrong|^2 / sum of |way of the skin asked for|^2

0 where a head shows nothing, or more wrong than right. For the head's pose it is the same with angles of rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sfms_robot.app.head.faces import named_faces
from sfms_robot.app.head.fit import virtual_tracker
from sfms_robot.config import load_head
from sfms_robot.data import head_names
from sfms_robot.face.tracker import Skin, skin_motion
from sfms_robot.frames import FRAME_S, POSE, POSE_CHANNELS, SHAPES, Doubles, Floats
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.retarget.response_fit import asked

_ANGLES = slice(0, 3)
_EVERY = 5  # frames: faces of two neighbours hardly differ


@dataclass(frozen=True)
class Fidelity:
    """Shares 0..1 of one recorded face, or one kind of motion; None where the recording has none of it."""

    head: str
    face: str
    seconds: float
    expression: float | None
    pose: float | None


def fidelity(heads: Sequence[str] = (), data: Path | None = None) -> dict[str, Any]:
    """Every shipped head (or those named) on every recorded face, and all faces together. Raises ConfigError."""
    names = list(heads) or head_names()
    faces: dict[str, list[Floats]] = {}
    for face, clip in named_faces(data):
        faces.setdefault(face, []).append(clip)
    rows = [row for name in names for row in of_head(name, faces)]
    return {"version": 1, "rows": [asdict(row) for row in rows]}


def of_head(name: str, faces: dict[str, list[Floats]]) -> list[Fidelity]:
    """One row per face, then one for all of them."""
    head = load_head(name)
    retargeter = HeadRetargeter(head)
    tracker = virtual_tracker(head, Skin.plain(len(head.joints)))
    skin = skin_motion()
    motions = {face: np.concatenate(clips) for face, clips in faces.items()}
    rows, sums = [], []
    for face, motion in motions.items():
        wanted = motion[::_EVERY, SHAPES].astype(np.float64)
        lost = tracker.face(asked(head, wanted)) - wanted
        energy = [_energy(lost, skin), _energy(wanted, skin), *_turns(retargeter, motion[:, POSE])]
        sums.append(energy)
        rows.append(_row(head.name, face, len(motion), energy))
    total = np.sum(sums, axis=0).tolist()
    return [*rows, _row(head.name, "all", sum(map(len, motions.values())), total)]


def _energy(shapes: Doubles, skin: Doubles) -> float:
    return float(np.einsum("ni,ij,nj->", shapes, skin, shapes, optimize=True))


def _turns(retargeter: HeadRetargeter, pose: Floats) -> tuple[float, float]:
    """Squares of the angles that are missing, and of those asked for; a head without a neck misses them all."""
    turns = np.zeros((len(pose), len(POSE_CHANNELS)))
    turns[:, _ANGLES] = pose[:, _ANGLES]
    wanted = float((turns[:, _ANGLES] ** 2).sum())
    if retargeter.neck is None:
        return wanted, wanted
    return float((retargeter.neck.solve(turns).residual_rad ** 2).sum()), wanted


def _row(head: str, face: str, frames: int, energy: Sequence[float]) -> Fidelity:
    return Fidelity(head, face, round(frames * FRAME_S, 1), _share(*energy[:2]), _share(*energy[2:]))


def _share(lost: float, wanted: float) -> float | None:
    return round(max(0.0, 1.0 - lost / wanted), 3) if wanted > 1e-9 else None
