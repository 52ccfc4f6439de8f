"""Recorded faces to try a head on: those that ship with the package, or a folder of face tracks."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfms_robot.data import data_dir
from sfms_robot.frames import MOTION_DIM, POSE_CHANNELS, Floats
from sfms_robot.signals.motion_primitives import read_motions
from sfms_robot.signals.tracks import face_stretches, folder_takes

SHORTEST = 4  # frames that a curve can be laid through
_POSE = len(POSE_CHANNELS)
_PARTS = {  # kinds of recorded motion, and the channels that they give
    "faces": slice(_POSE, None),
    "talk": slice(_POSE, None),
    "smiles": slice(_POSE, None),
    "brows": slice(_POSE, None),
    "blinks": slice(_POSE, None),
    "heads": slice(0, _POSE),
    "sway": slice(0, 3),
}


def recorded_faces(folder: Path | None = None) -> list[Floats]:
    """Clips (T, 58) at 25 fps, T at least 4: the bundled ones, or every CSV track below `folder`.

    Raises ConfigError for a folder without tracks, and for a track that cannot be read.
    """
    return [clip for _, clip in named_faces(folder)]


def named_faces(folder: Path | None = None) -> list[tuple[str, Floats]]:
    """As `recorded_faces`, each clip with the name of its track or its kind of motion."""
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
                clip[:, _POSE:] = np.clip(clip[:, _POSE:], 0.0, 1.0)
                clips.append((kind, clip))
    return clips
