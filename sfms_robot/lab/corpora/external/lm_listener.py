"""lm-listener (Ng et al., ICCV 2023; sanjayss34/lm-listener @ 53ce4ecc): segments of any length at 30 fps, EMOCA.

`{subject}/segments_{train,val,test}.pth`: torch-pickled lists of dicts with `p0_exp` (T, 50), `p0_pose` (T, 6), the
same for p1; p0 listens, p1 speaks. It ships no sound (some files carry `hubert_feat`). A pickle cannot be read in
parts: the motion of one split is held in memory, its shape, detail and words are not.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.frames import Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order, Problem, guarded
from sfms_robot.lab.corpora.reading import dyad, frames_of, numbers, torch_load, track

FPS: Final = 30.0
WIDTH: Final = 56
SPLITS: Final = {"train": "train", "validation": "val", "test": "test"}
LISTENER, SPEAKER = "p0", "p1"


def _holds(folder: Path) -> bool:
    return next(folder.glob("segments_*.pth"), None) is not None


def root(folder: Path) -> Path | None:
    for place in (folder, folder / "dataset"):
        if place.is_dir() and (_holds(place) or any(_holds(sub) for sub in place.iterdir() if sub.is_dir())):
            return place
    return None


def _subjects(place: Path) -> list[Path]:
    """Folders with segments; one that joins others (trevorconanstephen) gives way to those."""
    if _holds(place):
        return [place]
    parts = [sub for sub in sorted(place.iterdir()) if sub.is_dir() and _holds(sub)]
    return [part for part in parts if not any(other != part and other.name in part.name for other in parts)]


def splits(place: Path) -> Mapping[str, str]:
    return {
        ours: theirs
        for ours, theirs in SPLITS.items()
        if any((subject / f"segments_{theirs}.pth").is_file() for subject in _subjects(place))
    }


def scan(place: Path, split: str, order: Order | None) -> Dataset:
    clips: list[Clip] = []
    problems: list[Problem] = []
    for subject in _subjects(place):
        file = subject / f"segments_{split}.pth"
        try:
            segments = torch_load(file) if file.is_file() else []
            if not isinstance(segments, list):
                raise ClipError.of("unreadable", file, "no list of segments")
        except ClipError as error:
            problems.append(error.problem)
            continue
        for index, segment in enumerate(segments):
            name = f"{subject.name}_{split}_{index:05d}"
            try:
                clips.append(_clip(name, len(clips) + len(problems), segment))
            except ClipError as error:
                problems.append(error.problem)
    return Dataset("lm_listener", split, "deca56", FPS, tuple(clips), tuple(problems))


def _clip(name: str, row: int, segment: Any) -> Clip:
    if not isinstance(segment, dict):
        raise ClipError.of("unreadable", name, "no dict")
    if missing := [f"{who}_{part}" for who in (LISTENER, SPEAKER) for part in ("exp", "pose")
                   if f"{who}_{part}" not in segment]:  # fmt: skip
        raise ClipError.of("missing half", name, f"has no {', '.join(missing)}")
    faces = {who: guarded(name, partial(_face, segment, who)) for who in (LISTENER, SPEAKER)}
    frames = frames_of(name, *(face.shape for face in faces.values()))
    features = {}
    if "hubert_feat" in segment:
        rows = guarded(name, lambda: np.asarray(numbers(segment, "hubert_feat"), np.float32))
        features["hubert"] = partial(track, f"{name} hubert_feat", rows, frames, rows.shape[-1])
    return Clip(name, frames, row, partial(_read, name, frames, faces[SPEAKER], faces[LISTENER]), features)


def _face(segment: Mapping[str, Any], who: str) -> Floats:
    parts = [numbers(segment, f"{who}_{part}") for part in ("exp", "pose")]
    if [part.shape[-1] for part in parts] != [50, 6]:
        raise ClipError.of("wrong dims", who, f"exp {parts[0].shape} and pose {parts[1].shape}, expected 50 and 6")
    return np.concatenate(parts, axis=-1).astype(np.float32)


def _read(name: str, frames: int, speaker: Floats, listener: Floats) -> Dyad:
    return dyad(
        name,
        track(f"{name} speaker", speaker, frames, WIDTH, gaps=True),
        track(f"{name} listener", listener, frames, WIDTH),
        "deca56",
        FPS,
    )


LAYOUT: Final = Layout(
    "lm_listener", "lm-listener: {subject}/segments_{train,val,test}.pth", "deca56", FPS, None, root, splits, scan,
    features=("hubert",),
)  # fmt: skip
