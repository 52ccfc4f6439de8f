"""Learning2Listen (Ng et al., CVPR 2022; evonneng/learning2listen @ a0825d58): clips of 64 frames at 30 fps, DECA.

`{subject}/{train,test}/p{0,1}_{list,speak}_{faces,audio,files}_clean_deca.npy`, p0 the left person. The listener
`p{o}_list_*` goes with the speaker `p{1-o}_speak_*`; o is 0 except for fallon. Faces are 50 expression | 3 head |
3 jaw | 128 detail; sound is four mel rows a frame. Files are memory-mapped; a clip is read when accessed.

Deviations: sound is returned as the natural log of power, whatever unit the file has, so that all data share one. The
reference splits 70/30 at random without a seed; here the share held out is the same every time.

lm-listener (Ng et al., ICCV 2023; sanjayss34/lm-listener @ 53ce4ecc): segments of any length at 30 fps, EMOCA.
`{subject}/segments_{train,val,test}.pth`: torch-pickled lists of dicts with `p0_exp` (T, 50), `p0_pose` (T, 6), the
same for p1; p0 listens, p1 speaks. It ships no sound (some files carry `hubert_feat`). A pickle cannot be read in
parts: the motion of one split is held in memory, its shape, detail and words are not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.frames import Doubles, Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import (
    WITH_VAL,
    Clip,
    ClipError,
    Found,
    Layout,
    attempt,
    dyad_of,
    frames_of,
    guarded,
    npy,
    numbers,
    torch_load,
    track,
)
from sfms_robot.signals.mel import FLOOR, LN_PER_DB, MEL_BINS, ROWS_PER_FRAME

FPS: Final = 30.0
SPACE: Final = "deca56"
WIDTH: Final = 56
UNUSED: Final = "devi2"  # in the data, but not used by the reference
HOST_IS_P1: Final = ("fallon",)
STD_EPS: Final = 1e-10


def _is_subject(folder: Path) -> bool:
    return any(next((folder / split).glob("p[01]_list_faces_*.npy"), None) for split in ("train", "test"))


def _subjects(place: Path) -> list[Path]:
    """Return `place` if it is a subject, or else all folders in it if one of them is a subject; else []."""
    found = [place] if _is_subject(place) else sorted(sub for sub in place.glob("*") if sub.is_dir())
    return found if any(map(_is_subject, found)) else []


def scan(place: Path, split: str) -> Iterator[Found]:
    for subject in _subjects(place):
        if subject != place and subject.name == UNUSED:
            yield f"{UNUSED} is left out, as the reference does: give its own folder to use it"
        elif (subject / split).is_dir():
            try:
                yield from _direction(subject.name, subject / split)
            except ClipError as error:
                yield error.problem


def _direction(subject: str, folder: Path) -> Iterator[Found]:
    """Yield the clips of one subject in which the host listens."""

    def file(person: int, role: str, kind: str) -> Path:
        return folder / f"p{person}_{role}_{kind}_clean_deca.npy"

    def filled(person: int) -> bool:
        return file(person, "list", "faces").is_file() and npy(file(person, "list", "faces")).size > 0

    host = int(subject in HOST_IS_P1)
    if not filled(host) and filled(1 - host):
        yield f"{folder}: p{host} never listens, p{1 - host} is taken"
        host = 1 - host
    faces = file(1 - host, "speak", "faces"), file(host, "list", "faces")
    sound = file(1 - host, "speak", "audio")
    shapes = [npy(one).shape for one in faces]
    for one, shape in zip(faces, shapes, strict=True):
        if len(shape) != 3 or shape[2] < WIDTH:
            raise ClipError("wrong dims", one, f"shape {shape}, expected (N, T, {WIDTH} or more)")
    count, frames = shapes[1][:2]
    if shapes[0][:2] != (count, frames):
        raise ClipError("lengths differ", folder, f"{shapes[1][:2]} listener clips beside {shapes[0][:2]} speaker's")
    decibels = False
    expected = (count, ROWS_PER_FRAME * frames, MEL_BINS)
    if not sound.is_file():
        yield f"{sound}: no such file: these clips have no sound"
    elif (shape := npy(sound).shape) != expected:
        raise ClipError("wrong dims", sound, f"shape {shape}, expected {expected}")
    else:
        decibels = bool(count) and float(np.nanmin(npy(sound)[:: max(1, count // 32)])) < 0

    def read(name: str, index: int) -> Dyad:
        pair = [(f"{one}[{index}]", npy(one)[index, :, :WIDTH]) for one in faces]
        mel = None
        if sound.is_file():
            rows = track(f"{sound}[{index}]", npy(sound)[index], ROWS_PER_FRAME * frames, MEL_BINS)
            mel = rows * np.float32(LN_PER_DB) if decibels else np.log(np.maximum(rows, 0) + np.float32(FLOOR))
        return dyad_of(name, pair, frames, SPACE, FPS, mel=mel)

    for index in range(count):
        name = f"{subject}_{folder.name}_p{host}_{index:05d}"
        yield Clip(name=name, frames=frames, read=partial(read, name, index))


def l2l_mean_std(x: ArrayLike) -> tuple[Doubles, Doubles]:
    """Return the mean and "std" (1, 1, D) of clips (N, T, D) that L2L standardises with.

    This "std" is the std over clips of the stds over time, which makes standardised errors several times larger than
    with the usual std.
    """
    clips = np.asarray(x, dtype=np.float64)
    if clips.ndim != 3:
        raise ValueError(f"clips are (N, T, D), got shape {clips.shape}")
    mean: Doubles = clips.mean(axis=1).mean(axis=0)[None, None]
    std: Doubles = clips.std(axis=1).std(axis=0)[None, None] + STD_EPS
    return mean, std


LAYOUT: Final = Layout(
    name="l2l", about="Learning2Listen: {subject}/{train,test}/p{0,1}_*_clean_deca.npy", space=SPACE, fps=FPS,
    splits=lambda place: {
        split: split for split in ("train", "test") if any((one / split).is_dir() for one in _subjects(place))
    },
    order="exp-first", scan=scan, held_out=0.3,
)  # fmt: skip


# --- lm-listener ----------------------------------------------------------------------------------------------------

PEOPLE: Final = ("p1", "p0")  # speaker, listener


def _segments(place: Path, split: str) -> list[Path]:
    """Return the files of a split, without those of a folder that joins other folders (trevorconanstephen)."""
    name = f"segments_{split}.pth"
    if next(place.glob("segments_*.pth"), None):
        return [file for file in [place / name] if file.is_file()]
    parts = sorted({file.parent for file in place.glob("*/segments_*.pth")})
    alone = [part for part in parts if not any(other != part and other.name in part.name for other in parts)]
    return [part / name for part in alone if (part / name).is_file()]


def lm_scan(place: Path, split: str) -> Iterator[Found]:
    for file in _segments(place, split):
        try:
            segments = torch_load(file)
            if not isinstance(segments, list):
                raise ClipError("unreadable", file, "no list of segments")
        except ClipError as error:
            yield error.problem
            continue
        name = f"{file.parent.name}_{split}"
        yield from attempt(((f"{name}_{index:05d}", one) for index, one in enumerate(segments)), _clip)


def _clip(named: tuple[str, Any]) -> Clip:
    name, segment = named
    if not isinstance(segment, dict):
        raise ClipError("unreadable", name, "no dict")
    keys = [f"{person}_{part}" for person in PEOPLE for part in ("exp", "pose")]
    if missing := [key for key in sorted(keys) if key not in segment]:
        raise ClipError("missing half", name, f"has no {', '.join(missing)}")
    faces = [(f"{name} {person}", guarded(name, partial(_face, name, segment, person))) for person in PEOPLE]
    frames = frames_of(name, *(rows.shape for _, rows in faces))
    features = {}
    if "hubert_feat" in segment:
        rows = guarded(name, lambda: np.asarray(numbers(segment, "hubert_feat"), np.float32))
        features["hubert"] = partial(track, f"{name} hubert_feat", rows, frames, rows.shape[-1])
    read = partial(dyad_of, name, faces, frames, SPACE, FPS)
    return Clip(name=name, frames=frames, read=read, features=features)


def _face(name: str, segment: Mapping[str, Any], person: str) -> Floats:
    exp, pose = (numbers(segment, f"{person}_{part}") for part in ("exp", "pose"))
    if (exp.shape[-1], pose.shape[-1]) != (50, 6):
        detail = f"exp {exp.shape} and pose {pose.shape}, expected 50 and 6"
        raise ClipError("wrong dims", f"{name} {person}", detail)
    return np.concatenate([exp, pose], axis=-1).astype(np.float32)


LM_LISTENER_LAYOUT: Final = Layout(
    name="lm_listener", about="lm-listener: {subject}/segments_{train,val,test}.pth", space=SPACE, fps=FPS,
    splits=lambda place: {ours: theirs for ours, theirs in WITH_VAL.items() if _segments(place, theirs)},
    scan=lm_scan, below=("", "dataset"),
)  # fmt: skip
