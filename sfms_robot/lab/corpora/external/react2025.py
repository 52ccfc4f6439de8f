"""REACT 2025 and 2026 (MARS): sessions of any length at 30 fps, FaceVerse coefficients.

`{train,val,test}/{coefficients,facial-attributes,audio,audio-features}/{speaker,listener}/session{n}/NAME`, the two
people of a dyad under one name. Roles are given, so pairs are read one way. All listeners of a session count as
appropriate. Motion stays what the files hold; the baseline's loader standardises it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.frames import Floats
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order
from sfms_robot.lab.corpora.reading import collect, filed_dyad, frames_of, npy, track

FPS: Final = 30.0
WIDTH: Final = 58
SPLITS: Final = {"train": "train", "validation": "val", "test": "test"}
# feature: folder, role, width
FEATURES: Final[Mapping[str, tuple[str, str, int]]] = {
    "attributes": ("facial-attributes", "listener", 25),
    "speaker_attributes": ("facial-attributes", "speaker", 25),
    "wav2vec2": ("audio-features", "speaker", 768),
}


def root(folder: Path) -> Path | None:
    for place in (folder, folder / "data"):
        if any((place / split / "coefficients").is_dir() for split in SPLITS.values()):
            return place
    return None


def splits(place: Path) -> Mapping[str, str]:
    return {ours: theirs for ours, theirs in SPLITS.items() if (place / theirs / "coefficients").is_dir()}


def scan(place: Path, split: str, order: Order | None) -> Dataset:
    folder = place / split
    roles = [folder / "coefficients" / role for role in ("speaker", "listener")]
    names = sorted({str(file.relative_to(role).with_suffix("")) for role in roles for file in role.rglob("*.npy")})
    heard = (folder / "audio").is_dir()

    def clip(row: int, path: str) -> Clip:
        name = path.replace("/", "+")
        files = [role / f"{path}.npy" for role in roles]
        frames = frames_of(name, *(npy(file).shape for file in files))
        voices = [folder / "audio" / role / f"{path}.wav" for role in ("speaker", "listener")] if heard else []
        if voices and not voices[0].is_file():
            raise ClipError.of("missing sound", voices[0], "no such file")
        features = {
            feature: partial(_feature, folder / kind / role / f"{path}.npy", frames, width)
            for feature, (kind, role, width) in FEATURES.items()
        }
        return Clip(
            name,
            frames,
            row,
            partial(filed_dyad, name, files, voices, frames, "faceverse58", FPS, order == "pose-first"),
            features,
        )

    clips, problems = collect(list(enumerate(names)), clip)
    notes = () if heard else (f"{folder / 'audio'}: no such folder: these clips have no sound",)
    return Dataset("react2025", split, "faceverse58", FPS, clips, problems, notes)


def _feature(file: Path, frames: int, width: int) -> Floats:
    """(frames, width); the last row again where a feature ends a frame or two early. Raises ClipError."""
    if not file.is_file():
        raise ClipError.of("missing feature", file, "no such file")
    values = npy(file)
    had = min(frames, frames_of(str(file), values.shape, (frames, width)))
    rows = track(str(file), values, had, width)
    return np.pad(rows, ((0, frames - had), (0, 0)), mode="edge")


LAYOUT: Final = Layout(
    "react2025", "REACT 2025/26: {train,val,test}/coefficients/{speaker,listener}/session{n}/NAME.npy",
    "faceverse58", FPS, "exp-first", root, splits, scan, features=tuple(FEATURES),
)  # fmt: skip
