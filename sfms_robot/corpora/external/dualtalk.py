"""DualTalk (OpenFacebot): two people who talk, at 25 fps, FLAME; each listens to the other.

`{train,test,ood}/<id>_speaker{1,2}.{wav,npz}`, the .npz with `exp` (T, 50) and `pose` (T, 6) = head | jaw. Both have a
voice, so who listens when is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.corpora.clips import Dyad
from sfms_robot.corpora.collection import Clip, ClipError, Dataset, Layout, Order
from sfms_robot.corpora.reading import collect, dyad, frames_of, npz_shapes, track, voices_of
from sfms_robot.frames import Floats

FPS: Final = 25.0
WIDTH: Final = 56
SPLITS: Final = ("train", "test", "ood")
PEOPLE: Final = ("speaker1", "speaker2")
PARTS: Final = {"exp": 50, "pose": 6}


def root(folder: Path) -> Path | None:
    for place in (folder, folder / "data"):
        if any(next((place / split).glob("*_speaker[12].npz"), None) for split in SPLITS):
            return place
    return None


def splits(place: Path) -> Mapping[str, str]:
    return {split: split for split in SPLITS if next((place / split).glob("*_speaker[12].npz"), None)}


def scan(place: Path, split: str, order: Order | None) -> Dataset:
    folder = place / split
    chats = sorted({file.stem.rsplit("_", 1)[0] for file in folder.glob("*_speaker[12].npz")})
    voiced = next(folder.glob("*_speaker[12].wav"), None) is not None

    def clip(row: int, name: str) -> Clip:
        chat, listener = name.rsplit("_", 1)
        speaker = next(person for person in PEOPLE if person != listener)
        faces = [folder / f"{chat}_{person}.npz" for person in (speaker, listener)]
        frames = frames_of(name, *(_shape(file) for file in faces))
        voices = [file.with_suffix(".wav") for file in faces] if voiced else []
        if voices and not voices[0].is_file():
            raise ClipError.of("missing sound", voices[0], "no such file")
        return Clip(name, frames, row, partial(_read, name, faces, voices, frames))

    names = [f"{chat}_{person}" for chat in chats for person in PEOPLE]
    clips, problems = collect(list(enumerate(names)), clip)
    notes = () if voiced else (f"{folder}: no .wav files: these clips have no sound",)
    return Dataset("dualtalk", split, "deca56", FPS, clips, tuple(dict.fromkeys(problems)), notes)


def _shape(file: Path) -> tuple[int, ...]:
    if not file.is_file():
        raise ClipError.of("missing half", file, "no such file")
    shapes = npz_shapes(file)
    for key, width in PARTS.items():
        if key not in shapes:
            raise ClipError.of("missing half", file, f"has no {key}, only {', '.join(shapes)}")
        if len(shapes[key]) < 2 or shapes[key][-1] != width:
            raise ClipError.of("wrong dims", file, f"{key} has shape {shapes[key]}, expected (T, {width})")
    return shapes["exp"]


def _face(file: Path, frames: int, gaps: bool) -> Floats:
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        parts = [track(f"{file} {key}", arrays[key], frames, width, gaps=gaps) for key, width in PARTS.items()]
    return np.concatenate(parts, axis=1)


def _read(name: str, faces: list[Path], voices: list[Path], frames: int) -> Dyad:
    speaker, listener = _face(faces[0], frames, True), _face(faces[1], frames, False)
    return dyad(name, speaker, listener, "deca56", FPS, **voices_of(voices, frames, FPS))


LAYOUT: Final = Layout(
    "dualtalk", "DualTalk: {train,test,ood}/<id>_speaker{1,2}.{wav,npz}", "deca56", FPS, None, root, splits, scan,
    held_out=0.1,
)  # fmt: skip
