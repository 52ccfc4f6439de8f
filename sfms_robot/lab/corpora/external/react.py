"""REACT 2023 and 2024 (reactmultimodalchallenge/baseline_react2023 @ c5a8ff85, _react2024 @ 0c3ce587): 30 s at 25 fps.

`{train,val,test}.csv` list (speaker, listener) as `site/chat/person/clip`; below `{split}/` lie `3D_FV_files/*.npy`
(751 FaceVerse frames of 58), `Audio_files/*.wav` (44.1 kHz) and `Emotion/*.csv` (25 attributes a frame), one file per
clip. Metrics use 750 frames. Every pair is read both ways: val and test as the reference doubles them, so that a
clip's `row` is its row in the appropriateness matrix; train because swapping by chance comes to the same.

Deviation: the reference subtracts a mean face on loading. Here motion stays what the files hold, which is what the
retargeting of `faceverse58` reads; `faceverse58-centred` is the reference's (`centred`), and never drives a head.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order, Problem
from sfms_robot.lab.corpora.reading import collect, filed_dyad, frames_of, npy, table, track

FPS: Final = 25.0
WIDTH: Final = 58
FRAMES: Final = 750
ATTRIBUTES: Final = 25  # 15 action units | valence, arousal | 8 expressions
SPLITS: Final = {"train": "train", "validation": "val", "test": "test"}
FACES, SOUNDS, EMOTIONS = "3D_FV_files", "Audio_files", "Emotion"
# The cleaned release names the two people of a chat P1 and P2 in the Emotion tree alone.
FIRST: Final = ("Expert_video", "P25", "P41", "P45")
SECOND: Final = ("Novice_video", "P26", "P42", "P46")
MEAN_FACE: Final = ("mean_face.npy", "external/FaceVerse/mean_face.npy")


def root(folder: Path) -> Path | None:
    for place in (folder, folder / "data"):
        if any((place / split / FACES).is_dir() for split in SPLITS.values()):
            return place
    return None


def splits(place: Path) -> Mapping[str, str]:
    return {ours: theirs for ours, theirs in SPLITS.items() if (place / theirs / FACES).is_dir()}


def scan(place: Path, split: str, order: Order | None) -> Dataset:
    pairs = _pairs(place / f"{split}.csv")
    pairs += [(listener, speaker) for speaker, listener in pairs]
    folder = place / split
    heard = (folder / SOUNDS).is_dir()

    def clip(row: int, listener: str) -> Clip:
        speaker = pairs[row][0]
        name = listener.replace("/", "+")
        files = [folder / FACES / f"{person}.npy" for person in (speaker, listener)]
        frames = min(FRAMES, frames_of(name, *(npy(file).shape for file in files), slack=1))
        voices = [folder / SOUNDS / f"{person}.wav" for person in (speaker, listener)] if heard else []
        if voices and not voices[0].is_file():
            raise ClipError.of("missing sound", voices[0], "no such file")
        features = {
            "attributes": partial(attributes, folder, listener, frames),
            "speaker_attributes": partial(attributes, folder, speaker, frames),
        }
        return Clip(
            name=name,
            frames=frames,
            row=row,
            read=partial(filed_dyad, name, files, voices, frames, "faceverse58", FPS, order == "pose-first"),
            features=features,
        )

    clips, problems = collect([(row, listener) for row, (_, listener) in enumerate(pairs)], clip)
    notes = [] if heard else [f"{folder / SOUNDS}: no such folder: these clips have no sound"]
    if not (folder / EMOTIONS).is_dir():
        notes.append(f"{folder / EMOTIONS}: no such folder: no attributes, which the REACT metrics are defined on")
    return Dataset(
        layout="react",
        split=split,
        space="faceverse58",
        fps=FPS,
        clips=clips,
        problems=_once(problems),
        notes=tuple(notes),
    )


def _pairs(file: Path) -> list[tuple[str, str]]:
    """(speaker, listener) of every row. Raises ConfigError for a list that is missing or broken."""
    if not file.is_file():
        raise ConfigError(f"{file}: no such file: it lists which clips belong together")
    rows = table(file)[1:]
    if broken := [row for row in rows if len(row) < 3]:
        raise ConfigError(f"{file}: {','.join(broken[0])!r} holds no index, speaker and listener")
    return [(row[1].strip(), row[2].strip()) for row in rows]


def _once(problems: tuple[Problem, ...]) -> tuple[Problem, ...]:
    """A file that both ways of a pair need is one problem."""
    return tuple(dict.fromkeys(problems))


def attributes(folder: Path, clip: str, frames: int) -> Floats:
    """(frames, 25) of one clip, as the challenge labels it. Raises ClipError."""
    named = folder / EMOTIONS / f"{clip}.csv"
    file = named if named.is_file() else folder / EMOTIONS / f"{_cleaned(clip)}.csv"
    if not file.is_file():
        raise ClipError.of("missing feature", named, "no such file")
    try:
        rows = np.loadtxt(file, delimiter=",", skiprows=1, dtype=np.float32, ndmin=2)
    except ValueError as error:
        raise ClipError.of("unreadable", file, error) from error
    return track(str(file), rows, frames, ATTRIBUTES)


def _cleaned(clip: str) -> str:
    parts = clip.split("/")
    return "/".join("P1" if part in FIRST else "P2" if part in SECOND else part for part in parts)


def mean_face(place: Path) -> Floats:
    """(58,) the face that the reference subtracts, where the user has put it. Raises ConfigError."""
    tried = [base / name for base in (place, place.parent) for name in MEAN_FACE]
    file = next((file for file in tried if file.is_file()), None)
    if file is None:
        raise ConfigError(f"{place}: faceverse58-centred needs {MEAN_FACE[0]} or {MEAN_FACE[1]} there or above")
    try:
        mean = np.asarray(npy(file), np.float32).reshape(-1)
    except ValueError as error:
        raise ConfigError(f"{file}: holds no mean face: {error}") from error
    if mean.shape != (WIDTH,) or not np.isfinite(mean).all():
        raise ConfigError(f"{file}: a mean face is ({WIDTH},) and finite, this is {mean.shape}")
    return mean


def centred(mean: Floats, clip: Dyad) -> Dyad:
    """A dyad less the mean face."""
    return replace(clip, speaker=clip.speaker - mean, listener=clip.listener - mean, space="faceverse58-centred")


LAYOUT: Final = Layout(
    name="react", about="REACT 2023/24: {train,val,test}/3D_FV_files and {split}.csv", space="faceverse58", fps=FPS,
    order="exp-first", root=root, splits=splits, scan=scan, features=("attributes", "speaker_attributes"),
)  # fmt: skip


# --- REACT 2025 and 2026 (MARS): sessions of any length at 30 fps, FaceVerse coefficients -------------------------
#
# `{train,val,test}/{coefficients,facial-attributes,audio,audio-features}/{speaker,listener}/session{n}/NAME`, the two
# people of a dyad under one name. Roles are given, so pairs are read one way. All listeners of a session count as
# appropriate. Motion stays what the files hold; the baseline's loader standardises it.

REACT2025_FPS: Final = 30.0
# feature: folder, role, width
FEATURES: Final[Mapping[str, tuple[str, str, int]]] = {
    "attributes": ("facial-attributes", "listener", 25),
    "speaker_attributes": ("facial-attributes", "speaker", 25),
    "wav2vec2": ("audio-features", "speaker", 768),
}


def react2025_root(folder: Path) -> Path | None:
    for place in (folder, folder / "data"):
        if any((place / split / "coefficients").is_dir() for split in SPLITS.values()):
            return place
    return None


def react2025_splits(place: Path) -> Mapping[str, str]:
    return {ours: theirs for ours, theirs in SPLITS.items() if (place / theirs / "coefficients").is_dir()}


def react2025_scan(place: Path, split: str, order: Order | None) -> Dataset:
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
            name=name,
            frames=frames,
            row=row,
            read=partial(filed_dyad, name, files, voices, frames, "faceverse58", REACT2025_FPS, order == "pose-first"),
            features=features,
        )

    clips, problems = collect(list(enumerate(names)), clip)
    notes = () if heard else (f"{folder / 'audio'}: no such folder: these clips have no sound",)
    return Dataset(
        layout="react2025",
        split=split,
        space="faceverse58",
        fps=REACT2025_FPS,
        clips=clips,
        problems=problems,
        notes=notes,
    )


def _feature(file: Path, frames: int, width: int) -> Floats:
    """(frames, width); the last row again where a feature ends a frame or two early. Raises ClipError."""
    if not file.is_file():
        raise ClipError.of("missing feature", file, "no such file")
    values = npy(file)
    had = min(frames, frames_of(str(file), values.shape, (frames, width)))
    rows = track(str(file), values, had, width)
    return np.pad(rows, ((0, frames - had), (0, 0)), mode="edge")


REACT2025_LAYOUT: Final = Layout(
    name="react2025", about="REACT 2025/26: {train,val,test}/coefficients/{speaker,listener}/session{n}/NAME.npy",
    space="faceverse58", fps=REACT2025_FPS, order="exp-first",
    root=react2025_root, splits=react2025_splits, scan=react2025_scan, features=tuple(FEATURES),
)  # fmt: skip
