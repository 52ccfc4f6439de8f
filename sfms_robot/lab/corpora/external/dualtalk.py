"""DualTalk (Peng et al., CVPR 2025): two people who talk, at 25 fps; each listens to the other. Both have a voice.

`{train,test,ood}/<id>_speaker{1,2}.{wav,npz}`, the .npz with FLAME's `exp` (T, 50) and `pose` (T, 6) = head | jaw,
among others. Its published demo (`demo/`, a split of that name) has two voices and one face a clip: the person with the
face listens, and the face of the other is unknown.

The edition in ARKit's shapes (OpenFacebot/DualTalk_Dataset_ARKit @ 4313f343) adds, for the same names,
`ARKit_npy/{train,test,ood}/<id>_speaker{1,2}.npy` (T, 61): 51 shapes in Apple's order, TongueOut 0 | HeadYaw, HeadPitch
and HeadRoll of R = Ry Rx Rz in FLAME's axes, which are our three angles, cut at 1 rad | eyes, all 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.frames import BLENDSHAPES, ORDERS, POSE, SHAPES, Floats
from sfms_robot.lab.corpora.clips import WIDTHS, Dyad
from sfms_robot.lab.corpora.collection import (
    Clip,
    ClipError,
    Found,
    Layout,
    attempt,
    dyad_of,
    existing,
    frames_of,
    npy,
    npz,
    npz_shapes,
    track,
    voices_of,
)

FPS: Final = 25.0
LICENCE: Final = "Apache 2.0, as its README says; made from RealTalk"
SPLITS: Final = ("train", "test", "ood")
DEMO: Final = "demo"
PARTS: Final = {"exp": 50, "pose": 6}
ARKIT_FOLDER: Final = "ARKit_npy"
ARKIT_WIDTH: Final = 61
_SHAPES: Final = [ORDERS["apple"].index(name) for name in BLENDSHAPES]  # columns of our shapes
_YAW_PITCH_ROLL: Final = slice(52, 55)


@dataclass(frozen=True)
class Faces:
    """Face files of one edition: their ending, their frames (from the header), and their rows (T, D)."""

    ending: str
    space: str
    shape: Callable[[Path], tuple[int, ...]]
    rows: Callable[[Path, int, bool], Floats]

    def people(self, folder: Path) -> list[str]:
        """Return `<id>_speaker{1,2}` of every face in a folder."""
        return sorted(file.stem for file in folder.glob(f"*_speaker[12]{self.ending}"))


def _flame_shape(file: Path) -> tuple[int, ...]:
    shapes = npz_shapes(file)
    for key, width in PARTS.items():
        if key not in shapes:
            raise ClipError("missing half", file, f"has no {key}, only {', '.join(shapes)}")
        if len(shapes[key]) < 2 or shapes[key][-1] != width:
            raise ClipError("wrong dims", file, f"{key} has shape {shapes[key]}, expected (T, {width})")
    return shapes["exp"]


def _flame_rows(file: Path, frames: int, gaps: bool) -> Floats:
    parts = zip(PARTS.items(), npz(file, *PARTS), strict=True)
    return np.concatenate([track(f"{file} {key}", rows, frames, n, gaps=gaps) for (key, n), rows in parts], axis=1)


def _arkit_shape(file: Path) -> tuple[int, ...]:
    shape = npy(file).shape
    if len(shape) != 2 or shape[1] != ARKIT_WIDTH:
        raise ClipError("wrong dims", file, f"shape {shape}, expected (T, {ARKIT_WIDTH})")
    return shape


def _arkit_rows(file: Path, frames: int, gaps: bool) -> Floats:
    filed = track(str(file), npy(file), frames, ARKIT_WIDTH, gaps=gaps)
    out = np.zeros((frames, WIDTHS["arkit58"]), np.float32)
    out[:, POSE][:, :3] = filed[:, _YAW_PITCH_ROLL][:, ::-1]
    out[:, SHAPES] = np.clip(filed[:, _SHAPES], 0.0, 1.0)
    return out


FLAME: Final = Faces(".npz", "deca56", _flame_shape, _flame_rows)
ARKIT: Final = Faces(".npy", "arkit58", _arkit_shape, _arkit_rows)


def splits(place: Path) -> Mapping[str, str]:
    """Return the splits with FLAME's faces; the demo's own folder is also one."""
    demo = FLAME.people(place) and any(place.glob("*_speaker[12].wav"))
    return {split: split for split in (*SPLITS, DEMO) if FLAME.people(place / split)} or ({DEMO: "."} if demo else {})


def scan(place: Path, split: str) -> Iterator[Found]:
    return _found(split, place / split, place / split, FLAME)


def arkit_scan(place: Path, split: str) -> Iterator[Found]:
    voices = next((base for base in (place, place / "DualTalk_Dataset") if (base / split).is_dir()), place)
    return _found(split, voices / split, place / ARKIT_FOLDER / split, ARKIT)


def _found(split: str, voices: Path, folder: Path, kind: Faces) -> Iterator[Found]:
    voiced = any(voices.glob("*_speaker[12].wav"))
    if not voiced:
        yield f"{voices}: no .wav files: these clips have no sound"
    listeners = kind.people(folder)
    if split not in (DEMO, "."):  # the demo has one face a clip: the other direction does not exist
        chats = sorted({name[:-1] for name in listeners})
        listeners = [f"{chat}{person}" for chat in chats for person in "12"]

    def clip(listener: str) -> Clip:
        stems = [f"{listener[:-1]}{'21'[int(listener[-1]) - 1]}", listener]
        faces = [folder / f"{stem}{kind.ending}" for stem in stems]
        existing(faces[1])
        frames = frames_of(listener, *(kind.shape(file) for file in faces if file.is_file()))
        sounds = voices_of(*(voices / f"{stem}.wav" for stem in stems)) if voiced else []

        def read() -> Dyad:
            heard = kind.rows(faces[1], frames, False)
            speaker = kind.rows(faces[0], frames, True) if faces[0].is_file() else np.full_like(heard, np.nan)
            pair = list(zip(faces, (speaker, heard), strict=True))
            return dyad_of(listener, pair, frames, kind.space, FPS, voices=sounds, own=True)

        return Clip(name=listener, frames=frames, read=read)

    yield from attempt(listeners, clip)


LAYOUT: Final = Layout(
    name="dualtalk", about="DualTalk: {train,test,ood,demo}/<id>_speaker{1,2}.{wav,npz}", space="deca56", fps=FPS,
    splits=splits, scan=scan, held_out=0.1, licence=LICENCE,
)  # fmt: skip
ARKIT_LAYOUT: Final = Layout(
    name="dualtalk_arkit",
    about="DualTalk in ARKit's shapes: ARKit_npy/{train,test,ood}/<id>_speaker{1,2}.npy beside its .wav",
    splits=lambda place: {split: split for split in SPLITS if ARKIT.people(place / ARKIT_FOLDER / split)},
    space="arkit58", fps=FPS, scan=arkit_scan, held_out=0.1, licence=LICENCE,
)  # fmt: skip
