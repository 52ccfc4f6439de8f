"""DualTalk (Peng et al., CVPR 2025): two people who talk, at 25 fps; each listens to the other. Both have a voice.

`{train,test,ood}/<id>_speaker{1,2}.{wav,npz}`, the .npz with FLAME's `exp` (T, 50) and `pose` (T, 6) = head | jaw,
among others. Its published demo (`demo/`, a split of that name) has two voices and one face a clip: whose face is there
listens, and the other's is unknown.

The edition in ARKit's shapes (OpenFacebot/DualTalk_Dataset_ARKit @ 4313f343) adds, for the same names,
`ARKit_npy/{train,test,ood}/<id>_speaker{1,2}.npy` (T, 61): 51 shapes in Apple's order, TongueOut 0 | HeadYaw, HeadPitch
and HeadRoll of R = Ry Rx Rz in FLAME's axes, which are our three angles, cut at 1 rad | eyes, all 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.frames import POSE, SHAPES, Floats, reorder
from sfms_robot.lab.corpora.clips import WIDTHS, Dyad
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order
from sfms_robot.lab.corpora.reading import collect, dyad, frames_of, npy, npz_shapes, track, voices_of

FPS: Final = 25.0
LICENCE: Final = "Apache 2.0, as its README says; made from RealTalk"
SPLITS: Final = ("train", "test", "ood")
DEMO: Final = "demo"
PEOPLE: Final = ("speaker1", "speaker2")
PARTS: Final = {"exp": 50, "pose": 6}
ARKIT_FOLDER: Final = "ARKit_npy"
ARKIT_WIDTH: Final = 61
_SHAPES: Final = slice(0, 52)
_YAW_PITCH_ROLL: Final = slice(52, 55)


@dataclass(frozen=True)
class Faces:
    """Face files of one edition: their ending, their frames (from the header), and their rows (T, D)."""

    ending: str
    space: str
    frames: Callable[[Path], tuple[int, ...]]
    rows: Callable[[Path, int, bool], Floats]


# --- the two editions -------------------------------------------------------------------------------------------


def _flame_shape(file: Path) -> tuple[int, ...]:
    shapes = npz_shapes(file)
    for key, width in PARTS.items():
        if key not in shapes:
            raise ClipError.of("missing half", file, f"has no {key}, only {', '.join(shapes)}")
        if len(shapes[key]) < 2 or shapes[key][-1] != width:
            raise ClipError.of("wrong dims", file, f"{key} has shape {shapes[key]}, expected (T, {width})")
    return shapes["exp"]


def _flame_rows(file: Path, frames: int, gaps: bool) -> Floats:
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        parts = [track(f"{file} {key}", arrays[key], frames, width, gaps=gaps) for key, width in PARTS.items()]
    return np.concatenate(parts, axis=1)


def _arkit_shape(file: Path) -> tuple[int, ...]:
    shape = npy(file).shape
    if len(shape) != 2 or shape[1] != ARKIT_WIDTH:
        raise ClipError.of("wrong dims", file, f"shape {shape}, expected (T, {ARKIT_WIDTH})")
    return shape


def _arkit_rows(file: Path, frames: int, gaps: bool) -> Floats:
    filed = track(str(file), npy(file), frames, ARKIT_WIDTH, gaps=gaps)
    out = np.zeros((frames, WIDTHS["arkit58"]), np.float32)
    out[:, POSE][:, :3] = filed[:, _YAW_PITCH_ROLL][:, ::-1]
    out[:, SHAPES] = np.clip(reorder(filed[:, _SHAPES], "apple"), 0.0, 1.0)
    return out


FLAME: Final = Faces(".npz", "deca56", _flame_shape, _flame_rows)
ARKIT: Final = Faces(".npy", "arkit58", _arkit_shape, _arkit_rows)


def root(folder: Path) -> Path | None:
    for place in (folder, folder / "data"):
        if _flame_splits(place) or _voiced(place):
            return place
    return None


def _flame_splits(place: Path) -> list[str]:
    return [split for split in (*SPLITS, DEMO) if next((place / split).glob("*_speaker[12].npz"), None)]


def _voiced(place: Path) -> bool:
    """Is this the demo's own folder?"""
    return all(next(place.glob(f"*_speaker[12]{ending}"), None) for ending in (".npz", ".wav"))


def splits(place: Path) -> Mapping[str, str]:
    return {split: split for split in _flame_splits(place)} or {DEMO: "."}


def scan(place: Path, split: str, order: Order | None) -> Dataset:
    folder = place / split
    return _scanned("dualtalk", split, folder, folder, FLAME)


def arkit_root(folder: Path) -> Path | None:
    return next((place for place in (folder, folder / "data") if arkit_splits(place)), None)


def arkit_splits(place: Path) -> Mapping[str, str]:
    faces = place / ARKIT_FOLDER
    return {split: split for split in SPLITS if next((faces / split).glob("*_speaker[12].npy"), None)}


def arkit_scan(place: Path, split: str, order: Order | None) -> Dataset:
    voices = next((base for base in (place, place / "DualTalk_Dataset") if (base / split).is_dir()), place)
    return _scanned("dualtalk_arkit", split, voices / split, place / ARKIT_FOLDER / split, ARKIT)


# --- either -----------------------------------------------------------------------------------------------------


def _scanned(layout: str, split: str, voices: Path, folder: Path, kind: Faces) -> Dataset:
    chats = sorted({file.stem.rsplit("_", 1)[0] for file in folder.glob(f"*_speaker[12]{kind.ending}")})
    voiced = next(voices.glob("*_speaker[12].wav"), None) is not None

    def clip(row: int, name: str) -> Clip:
        chat, listener = name.rsplit("_", 1)
        stems = [f"{chat}_{person}" for person in (*(one for one in PEOPLE if one != listener), listener)]
        faces = [folder / f"{stem}{kind.ending}" for stem in stems]
        sounds = [voices / f"{stem}.wav" for stem in stems] if voiced else []
        if not faces[1].is_file():
            raise ClipError.of("missing half", faces[1], "no such file")
        frames = frames_of(name, *(kind.frames(file) for file in faces if file.is_file()))
        if sounds and not sounds[0].is_file():
            raise ClipError.of("missing sound", sounds[0], "no such file")
        return Clip(name=name, frames=frames, row=row, read=partial(_read, name, faces, sounds, frames, kind))

    faced = [f"{chat}_{person}" for chat in chats for person in PEOPLE]
    if split in (DEMO, "."):  # one face a clip: the other direction is not missing, nobody made it
        faced = [stem for stem in faced if (folder / f"{stem}{kind.ending}").is_file()]
    clips, problems = collect(list(enumerate(faced)), clip)
    notes = () if voiced else (f"{voices}: no .wav files: these clips have no sound",)
    return Dataset(
        layout=layout,
        split=split,
        space=kind.space,
        fps=FPS,
        clips=clips,
        problems=tuple(dict.fromkeys(problems)),
        notes=notes,
        features=(),
        licence=LICENCE,
    )


def _read(name: str, faces: Sequence[Path], sounds: Sequence[Path], frames: int, kind: Faces) -> Dyad:
    listener = kind.rows(faces[1], frames, False)
    speaker = kind.rows(faces[0], frames, True) if faces[0].is_file() else np.full_like(listener, np.nan)
    voices = voices_of(sounds, frames, FPS)
    return replace(dyad(name, speaker, listener, kind.space, FPS, **voices), agent_audio=voices.get("own"))


LAYOUT: Final = Layout(
    name="dualtalk", about="DualTalk: {train,test,ood,demo}/<id>_speaker{1,2}.{wav,npz}", space="deca56", fps=FPS,
    order=None, root=root, splits=splits, scan=scan, held_out=0.1,
)  # fmt: skip
ARKIT_LAYOUT: Final = Layout(
    name="dualtalk_arkit",
    about="DualTalk in ARKit's shapes: ARKit_npy/{train,test,ood}/<id>_speaker{1,2}.npy beside its .wav",
    space="arkit58", fps=FPS, order=None, root=arkit_root, splits=arkit_splits, scan=arkit_scan, held_out=0.1,
)  # fmt: skip
