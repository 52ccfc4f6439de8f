"""REACT 2023 and 2024 (reactmultimodalchallenge/baseline_react2023 @ c5a8ff85, _react2024 @ 0c3ce587): 30 s at 25 fps.

`{train,val,test}.csv` list (speaker, listener) as `site/chat/person/clip`; below `{split}/` lie `3D_FV_files/*.npy`
(751 FaceVerse frames of 58), `Audio_files/*.wav` (44.1 kHz) and `Emotion/*.csv` (25 attributes a frame), one file per
clip. Metrics use 750 frames. Every pair is read in both directions: val and test as the reference doubles them, so that
a clip's `row` is its row in the appropriateness matrix; train because swapping roles at random is equivalent.

REACT 2025 and 2026 (MARS): sessions of any length at 30 fps,
`{train,val,test}/{coefficients,facial-attributes,audio,audio-features}/{speaker,listener}/session{n}/NAME`, the two
people of a dyad under one name. Roles are given, so pairs are read in one direction. All listeners of a session count
as appropriate.

Deviation: the references subtract a mean face or standardise on loading. Here motion is kept as in the files, which
the retargeting of `faceverse58` expects.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import (
    WITH_VAL,
    Clip,
    Found,
    Layout,
    attempt,
    dyad_of,
    existing,
    frames_of,
    guarded,
    npy,
    table,
    track,
    voices_of,
)

SPACE: Final = "faceverse58"
FPS, FPS_2025 = 25.0, 30.0
FRAMES: Final = 750
ATTRIBUTES: Final = 25  # 15 action units | valence, arousal | 8 expressions
FACES, SOUNDS, EMOTIONS = "3D_FV_files", "Audio_files", "Emotion"
FACES_2025: Final = "coefficients"
# The cleaned release names the two people of a chat P1 and P2 in the Emotion tree alone.
CLEANED: Final = dict.fromkeys(("Expert_video", "P25", "P41", "P45"), "P1") | dict.fromkeys(
    ("Novice_video", "P26", "P42", "P46"), "P2"
)
# feature: folder, role, width
FEATURES_2025: Final[Mapping[str, tuple[str, str, int]]] = {
    "attributes": ("facial-attributes", "listener", 25),
    "speaker_attributes": ("facial-attributes", "speaker", 25),
    "wav2vec2": ("audio-features", "speaker", 768),
}


def splits(faces: str, place: Path) -> Mapping[str, str]:
    """Return the splits that have a folder of faces."""
    return {ours: theirs for ours, theirs in WITH_VAL.items() if (place / theirs / faces).is_dir()}


def scan(place: Path, split: str) -> Iterator[Found]:
    pairs = _pairs(place / f"{split}.csv")
    folder = place / split
    heard = (folder / SOUNDS).is_dir()
    if not heard:
        yield f"{folder / SOUNDS}: no such folder: these clips have no sound"
    if not (folder / EMOTIONS).is_dir():
        yield f"{folder / EMOTIONS}: no such folder: no attributes, which the REACT metrics are defined on"

    def clip(pair: tuple[str, str]) -> Clip:
        faces, sounds = ([folder / kind / f"{person}{end}" for person in pair]
                         for kind, end in ((FACES, ".npy"), (SOUNDS, ".wav")))  # fmt: skip
        frames = min(FRAMES, frames_of(pair[1], *(npy(file).shape for file in faces), slack=1))
        voices = voices_of(*sounds) if heard else []
        name = pair[1].replace("/", "+")
        read = partial(_read, name, faces, voices, frames, FPS)
        people = zip(("speaker_attributes", "attributes"), pair, strict=True)
        features = {feature: partial(attributes, folder, person, frames) for feature, person in people}
        return Clip(name=name, frames=frames, read=read, features=features)

    yield from attempt(pairs + [(listener, speaker) for speaker, listener in pairs], clip)


def scan_2025(place: Path, split: str) -> Iterator[Found]:
    folder = place / split
    roles = [folder / FACES_2025 / role for role in ("speaker", "listener")]
    heard = (folder / "audio").is_dir()
    if not heard:
        yield f"{folder / 'audio'}: no such folder: these clips have no sound"

    def clip(path: str) -> Clip:
        faces = [role / f"{path}.npy" for role in roles]
        name = path.replace("/", "+")
        frames = frames_of(name, *(npy(file).shape for file in faces))
        voices = voices_of(*(folder / "audio" / role.name / f"{path}.wav" for role in roles)) if heard else []
        features = {
            feature: partial(_feature, folder / kind / role / f"{path}.npy", frames, width)
            for feature, (kind, role, width) in FEATURES_2025.items()
        }
        read = partial(_read, name, faces, voices, frames, FPS_2025)
        return Clip(name=name, frames=frames, read=read, features=features)

    names = {str(file.relative_to(role).with_suffix("")) for role in roles for file in role.rglob("*.npy")}
    yield from attempt(sorted(names), clip)


def _read(name: str, faces: Sequence[Path], voices: Sequence[Path], frames: int, fps: float) -> Dyad:
    return dyad_of(name, [(file, npy(file)) for file in faces], frames, SPACE, fps, voices=voices)


def _pairs(file: Path) -> list[tuple[str, str]]:
    """Return (speaker, listener) of every row. Raises ConfigError for a list that is missing or broken."""
    if not file.is_file():
        raise ConfigError(f"{file}: no such file: it lists which clips belong together")
    rows = table(file)[1:]
    if broken := [row for row in rows if len(row) < 3]:
        raise ConfigError(f"{file}: {','.join(broken[0])!r} holds no index, speaker and listener")
    return [(row[1].strip(), row[2].strip()) for row in rows]


def attributes(folder: Path, clip: str, frames: int) -> Floats:
    """Return the attributes (frames, 25) of one clip, as labelled by the challenge. Raises ClipError."""
    cleaned = "/".join(CLEANED.get(part, part) for part in clip.split("/"))
    files = [folder / EMOTIONS / f"{name}.csv" for name in (clip, cleaned)]
    file = next((file for file in files if file.is_file()), files[0])
    existing(file, "missing feature")
    rows = guarded(file, lambda: np.loadtxt(file, delimiter=",", skiprows=1, dtype=np.float32, ndmin=2))
    return track(str(file), rows, frames, ATTRIBUTES)


def _feature(file: Path, frames: int, width: int) -> Floats:
    """Return (frames, width), with the last row repeated if a feature ends up to two frames early. Raises ClipError."""
    values = npy(existing(file, "missing feature"))
    had = min(frames, frames_of(str(file), values.shape, (frames, width)))
    return np.pad(track(str(file), values, had, width), ((0, frames - had), (0, 0)), mode="edge")


LAYOUT: Final = Layout(
    name="react", about="REACT 2023/24: {train,val,test}/3D_FV_files and {split}.csv", space=SPACE, fps=FPS,
    order="exp-first", splits=partial(splits, FACES), scan=scan,
)  # fmt: skip
LAYOUT_2025: Final = Layout(
    name="react2025", about="REACT 2025/26: {train,val,test}/coefficients/{speaker,listener}/session{n}/NAME.npy",
    space=SPACE, fps=FPS_2025, order="exp-first", splits=partial(splits, FACES_2025), scan=scan_2025,
)  # fmt: skip
