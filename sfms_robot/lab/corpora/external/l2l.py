"""Learning2Listen (Ng et al., CVPR 2022; evonneng/learning2listen @ a0825d58): clips of 64 frames at 30 fps, DECA.

`{subject}/{train,test}/p{0,1}_{list,speak}_{faces,audio,files}_clean_deca.npy`, p0 the left person. The listener
`p{o}_list_*` goes with the speaker `p{1-o}_speak_*`; o is 0 except for fallon. Faces are 50 expression | 3 head |
3 jaw | 128 detail; sound is four mel rows a frame. Files are mapped, a clip is read when asked for.

Deviations: sound is handed on as natural log of power, whatever the file holds, so that one unit serves all data. The
reference splits 70/30 at random without a seed; here the share held out is the same every time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.frames import Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order, Problem, guarded
from sfms_robot.lab.corpora.learning2listen import l2l_bilateral
from sfms_robot.lab.corpora.reading import dyad, frames_of, npy, numbers, pose_last, torch_load, track
from sfms_robot.signals.mel import FLOOR, LN_PER_DB, MEL_BINS, ROWS_PER_FRAME

FPS: Final = 30.0
WIDTH: Final = 56
UNUSED: Final = "devi2"  # there, and never used by the reference
HOST_IS_P1: Final = ("fallon",)


def _file(person: int, role: str, kind: str) -> str:
    return f"p{person}_{role}_{kind}_clean_deca.npy"


def _is_subject(folder: Path) -> bool:
    return any(next((folder / split).glob("p[01]_list_faces_*.npy"), None) for split in ("train", "test"))


def root(folder: Path) -> Path | None:
    for place in (folder, folder / "data"):
        if place.is_dir() and (_is_subject(place) or any(_is_subject(sub) for sub in place.iterdir() if sub.is_dir())):
            return place
    return None


def _subjects(place: Path) -> list[Path]:
    return [place] if _is_subject(place) else sorted(sub for sub in place.iterdir() if sub.is_dir())


def splits(place: Path) -> Mapping[str, str]:
    found = {split for subject in _subjects(place) for split in ("train", "test") if (subject / split).is_dir()}
    return {split: split for split in ("train", "test") if split in found}


def scan(place: Path, split: str, order: Order | None) -> Dataset:
    clips: list[Clip] = []
    problems: list[Problem] = []
    notes: list[str] = []
    for subject in _subjects(place):
        folder = subject / split
        if subject != place and subject.name == UNUSED:
            notes.append(f"{UNUSED} is left out, as the reference does: give its own folder to use it")
        elif folder.is_dir():
            try:
                clips += _direction(subject.name, folder, order == "pose-first", len(clips), notes)
            except ClipError as error:
                problems.append(error.problem)
    return Dataset(
        layout="l2l",
        split=split,
        space="deca56",
        fps=FPS,
        clips=tuple(clips),
        problems=tuple(problems),
        notes=tuple(notes),
    )


def _direction(subject: str, folder: Path, pose_first: bool, row: int, notes: list[str]) -> list[Clip]:
    """Clips of one subject, listened to by the host."""
    host = int(subject in HOST_IS_P1)
    if not _filled(folder / _file(host, "list", "faces")) and _filled(folder / _file(1 - host, "list", "faces")):
        notes.append(f"{folder}: p{host} never listens, p{1 - host} is taken")
        host = 1 - host
    listener, speaker = folder / _file(host, "list", "faces"), folder / _file(1 - host, "speak", "faces")
    sound = folder / _file(1 - host, "speak", "audio")
    shapes = [npy(file).shape for file in (listener, speaker)]
    for file, shape in zip((listener, speaker), shapes, strict=True):
        if len(shape) != 3 or shape[2] < WIDTH:
            raise ClipError.of("wrong dims", file, f"shape {shape}, expected (N, T, {WIDTH} or more)")
    count, frames = shapes[0][:2]
    if shapes[1][:2] != (count, frames):
        raise ClipError.of("lengths differ", folder, f"{shapes[0][:2]} listener clips beside {shapes[1][:2]} speaker's")
    decibels = False
    if not sound.is_file():
        notes.append(f"{sound}: no such file: these clips have no sound")
    elif (shape := npy(sound).shape) != (count, ROWS_PER_FRAME * frames, MEL_BINS):
        expected = (count, ROWS_PER_FRAME * frames, MEL_BINS)
        raise ClipError.of("wrong dims", sound, f"shape {shape}, expected {expected}")
    else:
        decibels = bool(count) and float(np.nanmin(npy(sound)[:: max(1, count // 32)])) < 0
    return [
        Clip(
            name=f"{subject}_{folder.name}_p{host}_{index:05d}",
            frames=frames,
            row=row + index,
            read=partial(_read, f"{subject}_{folder.name}_p{host}_{index:05d}", speaker, listener, sound, index,
            pose_first,
                    decibels),
        )
        for index in range(count)
    ]  # fmt: skip


def _filled(file: Path) -> bool:
    return file.is_file() and npy(file).size > 0


def _read(name: str, speaker: Path, listener: Path, sound: Path, index: int, pose_first: bool, decibels: bool) -> Dyad:
    faces = [npy(file)[index, :, :WIDTH] for file in (speaker, listener)]
    frames = len(faces[0])
    return dyad(
        name,
        track(f"{speaker}[{index}]", pose_last(faces[0], pose_first), frames, WIDTH, gaps=True),
        track(f"{listener}[{index}]", pose_last(faces[1], pose_first), frames, WIDTH),
        "deca56",
        FPS,
        mel=_log_mel(sound, index, frames, decibels) if sound.is_file() else None,
    )


def _log_mel(sound: Path, index: int, frames: int, decibels: bool) -> Floats:
    rows = track(f"{sound}[{index}]", npy(sound)[index], ROWS_PER_FRAME * frames, MEL_BINS)
    return rows * np.float32(LN_PER_DB) if decibels else np.log(np.maximum(rows, 0) + np.float32(FLOOR))


def smoothed(clip: Dyad) -> Dyad:
    """The faces of a dyad as L2L smooths them before anything else, its truth included. For `Dataset.map`."""
    speaker, listener = (np.asarray(l2l_bilateral(faces), np.float32) for faces in (clip.speaker, clip.listener))
    return replace(clip, speaker=speaker, listener=listener)


LAYOUT: Final = Layout(
    name="l2l", about="Learning2Listen: {subject}/{train,test}/p{0,1}_*_clean_deca.npy", space="deca56", fps=FPS,
    order="exp-first", root=root, splits=splits, scan=scan, held_out=0.3,
)  # fmt: skip


# --- lm-listener (Ng et al., ICCV 2023; sanjayss34/lm-listener @ 53ce4ecc): segments of any length at 30 fps, EMOCA
#
# `{subject}/segments_{train,val,test}.pth`: torch-pickled lists of dicts with `p0_exp` (T, 50), `p0_pose` (T, 6), the
# same for p1; p0 listens, p1 speaks. It ships no sound (some files carry `hubert_feat`). A pickle cannot be read in
# parts: the motion of one split is held in memory, its shape, detail and words are not.

SPLITS: Final = {"train": "train", "validation": "val", "test": "test"}
LISTENER, SPEAKER = "p0", "p1"


def _holds(folder: Path) -> bool:
    return next(folder.glob("segments_*.pth"), None) is not None


def lm_root(folder: Path) -> Path | None:
    for place in (folder, folder / "dataset"):
        if place.is_dir() and (_holds(place) or any(_holds(sub) for sub in place.iterdir() if sub.is_dir())):
            return place
    return None


def _lm_subjects(place: Path) -> list[Path]:
    """Folders with segments; one that joins others (trevorconanstephen) gives way to those."""
    if _holds(place):
        return [place]
    parts = [sub for sub in sorted(place.iterdir()) if sub.is_dir() and _holds(sub)]
    return [part for part in parts if not any(other != part and other.name in part.name for other in parts)]


def lm_splits(place: Path) -> Mapping[str, str]:
    return {
        ours: theirs
        for ours, theirs in SPLITS.items()
        if any((subject / f"segments_{theirs}.pth").is_file() for subject in _lm_subjects(place))
    }


def lm_scan(place: Path, split: str, order: Order | None) -> Dataset:
    clips: list[Clip] = []
    problems: list[Problem] = []
    for subject in _lm_subjects(place):
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
    return Dataset(
        layout="lm_listener", split=split, space="deca56", fps=FPS, clips=tuple(clips), problems=tuple(problems)
    )


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
    return Clip(
        name=name,
        frames=frames,
        row=row,
        read=partial(_lm_read, name, frames, faces[SPEAKER], faces[LISTENER]),
        features=features,
    )


def _face(segment: Mapping[str, Any], who: str) -> Floats:
    parts = [numbers(segment, f"{who}_{part}") for part in ("exp", "pose")]
    if [part.shape[-1] for part in parts] != [50, 6]:
        raise ClipError.of("wrong dims", who, f"exp {parts[0].shape} and pose {parts[1].shape}, expected 50 and 6")
    return np.concatenate(parts, axis=-1).astype(np.float32)


def _lm_read(name: str, frames: int, speaker: Floats, listener: Floats) -> Dyad:
    return dyad(
        name,
        track(f"{name} speaker", speaker, frames, WIDTH, gaps=True),
        track(f"{name} listener", listener, frames, WIDTH),
        "deca56",
        FPS,
    )


LM_LISTENER_LAYOUT: Final = Layout(
    name="lm_listener", about="lm-listener: {subject}/segments_{train,val,test}.pth", space="deca56", fps=FPS,
    order=None, root=lm_root, splits=lm_splits, scan=lm_scan, features=("hubert",),
)  # fmt: skip
