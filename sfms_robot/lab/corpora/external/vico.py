"""ViCo, as two projects prepare it: at 30 fps, without its waveforms.

`dim` (Boese0601/Dyadic-Interaction-Modeling @ 9fc92f72): `vico_processed_30fps/<id>.pkl`, a dict of `audio` (T, 768),
`video_speaker` and `video_listener` (T, 56), pose first; `RLD_data.csv` tells ids (second column) and splits (last).
`vico` (dc3ea9f/vico_challenge_baseline @ 16424c07): `features/audio_feats/<uuid>.npy` (T, 45),
`features/video_feats/<uuid>.{speaker,listener}.bin`, torch-saved dicts with `angle.exp.trans` (T, 73) of
Deep3DFaceRecon, which drives no head here. `metadata/data.csv` lists the uuids.

A pickle cannot be read in parts: each file is read once for its length, and again when asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Floats
from sfms_robot.lab.corpora.clips import WIDTHS, Dyad
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order, guarded
from sfms_robot.lab.corpora.reading import (
    collect,
    dyad,
    frames_of,
    npy,
    numbers,
    pose_last,
    table,
    torch_load,
    track,
    unpickle,
)

FPS: Final = 30.0
LIST: Final = "RLD_data.csv"
SPLIT_NAMES: Final = {"train": "train", "valid": "validation", "val": "validation", "test": "test", "ood": "ood"}
ROLES: Final = ("speaker", "listener")


def _splits(table: Mapping[str, str]) -> Mapping[str, str]:
    return {SPLIT_NAMES.get(theirs, theirs): theirs for theirs in sorted(set(table.values()))}


# --- dim --------------------------------------------------------------------------------------------------------


def dim_root(folder: Path) -> Path | None:
    places = (folder, folder / "vico_processed_30fps", folder / "data" / "vico_processed_30fps")
    return next((place for place in places if next(place.glob("*.pkl"), None)), None)


def _listed(place: Path) -> dict[str, str]:
    """Return the split of every id; without the list all are train. Raises ConfigError for an invalid list."""
    ids = sorted(file.stem for file in place.glob("*.pkl"))
    file = next((base / LIST for base in (place, place.parent) if (base / LIST).is_file()), None)
    if file is None:
        return dict.fromkeys(ids, "train")
    rows = table(file)[1:]
    if not rows or any(len(row) < 5 for row in rows):
        raise ConfigError(f"{file}: expected attitude, audio, listener, speaker, ..., split in every line")
    return {Path(row[1]).stem: row[-1].strip() for row in rows}


def dim_splits(place: Path) -> Mapping[str, str]:
    return _splits(_listed(place))


def dim_scan(place: Path, split: str, order: Order | None) -> Dataset:
    table = _listed(place)
    ids = [name for name, theirs in table.items() if theirs == split]

    def clip(row: int, name: str) -> Clip:
        file = place / f"{name}.pkl"
        if not file.is_file():
            raise ClipError.of("missing half", file, "no such file")
        arrays = guarded(str(file), lambda: unpickle(file))
        faces = [_shape(file, arrays, f"video_{role}", WIDTHS["deca56"]) for role in ROLES]
        frames = frames_of(name, *faces)
        read = partial(_dim_read, name, file, frames, order != "exp-first")
        return Clip(name=name, frames=frames, row=row, read=read, features={"hubert": partial(_hubert, file, frames)})

    clips, problems = collect(list(enumerate(ids)), clip)
    unlisted = sorted({file.stem for file in place.glob("*.pkl")} - set(table))
    notes = [f"{len(unlisted)} files are not in {LIST}: {', '.join(unlisted[:3])}"] if unlisted else []
    if not any((base / LIST).is_file() for base in (place, place.parent)):
        notes.append(f"{place}: no {LIST} there or above: all clips count as train")
    return Dataset(
        layout="dim", split=split, space="deca56", fps=FPS, clips=clips, problems=problems, notes=tuple(notes)
    )


def _shape(file: Path, arrays: Any, key: str, width: int) -> tuple[int, ...]:
    if not isinstance(arrays, dict) or key not in arrays:
        raise ClipError.of("missing half", file, f"has no {key}")
    shape = guarded(str(file), lambda: numbers(arrays, key)).shape
    if len(shape) < 2 or shape[-1] != width:
        raise ClipError.of("wrong dims", file, f"{key} has shape {shape}, expected (T, {width})")
    return shape


def _dim_read(name: str, file: Path, frames: int, pose_first: bool) -> Dyad:
    arrays, width = unpickle(file), WIDTHS["deca56"]
    speaker, listener = (
        track(f"{file} {role}", pose_last(numbers(arrays, f"video_{role}"), pose_first), frames, width, gaps=gaps)
        for role, gaps in zip(ROLES, (True, False), strict=True)
    )
    return dyad(name, speaker, listener, "deca56", FPS)


def _hubert(file: Path, frames: int) -> Floats:
    rows = numbers(unpickle(file), "audio")
    return track(f"{file} audio", rows, frames, rows.shape[-1])


DIM: Final = Layout(
    name="dim", about=f"DIM's ViCo: vico_processed_30fps/<id>.pkl and {LIST}", space="deca56", fps=FPS,
    order="pose-first", root=dim_root, splits=dim_splits, scan=dim_scan, held_out=0.1, features=("hubert",),
)  # fmt: skip


# --- the challenge's baseline -----------------------------------------------------------------------------------


def vico_root(folder: Path) -> Path | None:
    for place in (folder, folder / "data"):
        if (place / "features" / "video_feats").is_dir():
            return place
    return None


def _uuids(place: Path) -> dict[str, str]:
    """Return the split of every uuid; those without one are train. Raises ConfigError for an invalid list."""
    file = place / "metadata" / "data.csv"
    if not file.is_file():
        found = sorted({path.name.split(".")[0] for path in (place / "features" / "video_feats").glob("*.*.bin")})
        return dict.fromkeys(found, "train")
    header, *lines = table(file) or [[]]
    if "uuid" not in header:
        raise ConfigError(f"{file}: has no column uuid ({', '.join(header) or 'no rows'})")
    rows = [dict(zip(header, line, strict=False)) for line in lines]
    return {row["uuid"]: row.get("data_split") or row.get("split") or "train" for row in rows if row.get("uuid")}


def vico_splits(place: Path) -> Mapping[str, str]:
    return _splits(_uuids(place))


def vico_scan(place: Path, split: str, order: Order | None) -> Dataset:
    videos, sounds = place / "features" / "video_feats", place / "features" / "audio_feats"
    width = WIDTHS["deep3d73"]

    def clip(row: int, name: str) -> Clip:
        files = [videos / f"{name}.{role}.bin" for role in ROLES]
        for file in files:
            if not file.is_file():
                raise ClipError.of("missing half", file, "no such file")
        frames = frames_of(name, *(_shape(file, torch_load(file), "angle.exp.trans", width) for file in files))
        features = {"mfcc45": partial(_mfcc45, sounds / f"{name}.npy", frames)}
        return Clip(name=name, frames=frames, row=row, read=partial(_vico_read, name, files, frames), features=features)

    ids = [name for name, theirs in _uuids(place).items() if theirs == split]
    clips, problems = collect(list(enumerate(ids)), clip)
    return Dataset(layout="vico", split=split, space="deep3d73", fps=FPS, clips=clips, problems=problems)


def _vico_read(name: str, files: list[Path], frames: int) -> Dyad:
    speaker, listener = (
        track(str(file), numbers(torch_load(file), "angle.exp.trans"), frames, WIDTHS["deep3d73"], gaps=gaps)
        for file, gaps in zip(files, (True, False), strict=True)
    )
    return dyad(name, speaker, listener, "deep3d73", FPS)


def _mfcc45(file: Path, frames: int) -> Floats:
    if not file.is_file():
        raise ClipError.of("missing feature", file, "no such file")
    return track(str(file), np.asarray(npy(file)), frames, 45)


VICO: Final = Layout(
    name="vico", about="ViCo challenge baseline: features/{audio_feats,video_feats}", space="deep3d73", fps=FPS,
    order=None, root=vico_root, splits=vico_splits, scan=vico_scan, held_out=0.1, features=("mfcc45",),
)  # fmt: skip
