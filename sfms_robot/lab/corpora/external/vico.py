"""ViCo, as two projects prepare it: at 30 fps, without its waveforms.

`dim` (Boese0601/Dyadic-Interaction-Modeling @ 9fc92f72): `vico_processed_30fps/<id>.pkl`, a dict of `audio` (T, 768),
`video_speaker` and `video_listener` (T, 56), pose first; `RLD_data.csv` lists ids (second column) and splits (last).
`vico` (dc3ea9f/vico_challenge_baseline @ 16424c07): `features/audio_feats/<uuid>.npy` (T, 45),
`features/video_feats/<uuid>.{speaker,listener}.bin`, torch-saved dicts with `angle.exp.trans` (T, 73) of
Deep3DFaceRecon, which cannot drive a head here. `metadata/data.csv` lists the uuids.

A pickle cannot be read in parts: each file is read once for its length, and again when its clip is accessed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Floats
from sfms_robot.lab.corpora.clips import WIDTHS, Dyad
from sfms_robot.lab.corpora.collection import (
    OUR_NAMES,
    Clip,
    ClipError,
    Found,
    Layout,
    attempt,
    dyad_of,
    existing,
    frames_of,
    guarded,
    npy,
    numbers,
    table,
    torch_load,
    track,
    unpickle,
)

FPS: Final = 30.0
LIST: Final = "RLD_data.csv"
ROLES: Final = ("speaker", "listener")


def _splits(listed: Callable[[Path], Mapping[str, str]], place: Path) -> Mapping[str, str]:
    return {OUR_NAMES.get(theirs, theirs): theirs for theirs in sorted(set(listed(place).values()))}


def _rows(file: Path, load: Callable[[Path], Any], key: str) -> NDArray[Any]:
    """Return one array of a pickled dict. Raises ClipError."""
    arrays = guarded(existing(file), lambda: load(file))
    if not isinstance(arrays, dict) or key not in arrays:
        raise ClipError("missing half", file, f"has no {key}")
    return guarded(file, lambda: numbers(arrays, key))


def _frames(name: str, space: str, *tracks: tuple[Path, str, NDArray[Any]]) -> int:
    """Return the number of frames of tracks, given with file and key. Raises ClipError for another width."""
    for file, key, rows in tracks:
        if rows.ndim < 2 or rows.shape[-1] != WIDTHS[space]:
            raise ClipError("wrong dims", file, f"{key} has shape {rows.shape}, expected (T, {WIDTHS[space]})")
    return frames_of(name, *(rows.shape for _, _, rows in tracks))


# --- dim ------------------------------------------------------------------------------------------------------------


def _list_file(place: Path) -> Path | None:
    return next((base / LIST for base in (place, place.parent) if (base / LIST).is_file()), None)


def _listed(place: Path) -> dict[str, str]:
    """Return the split of every id; without a list all are train. Raises ConfigError for an invalid list."""
    ids = sorted(file.stem for file in place.glob("*.pkl"))
    file = _list_file(place)
    if file is None or not ids:
        return dict.fromkeys(ids, "train")
    rows = table(file)[1:]
    if not rows or any(len(row) < 5 for row in rows):
        raise ConfigError(f"{file}: expected attitude, audio, listener, speaker, ..., split in every line")
    return {Path(row[1]).stem: row[-1].strip() for row in rows}


def dim_scan(place: Path, split: str) -> Iterator[Found]:
    listed = _listed(place)
    if _list_file(place) is None:
        yield f"{place}: no {LIST} there or above: all clips count as train"
    elif unlisted := sorted({file.stem for file in place.glob("*.pkl")} - set(listed)):
        yield f"{len(unlisted)} files are not in {LIST}: {', '.join(unlisted[:3])}"

    def clip(name: str) -> Clip:
        file = place / f"{name}.pkl"
        keys = [f"video_{role}" for role in ROLES]
        frames = _frames(name, "deca56", *((file, key, _rows(file, unpickle, key)) for key in keys))

        def read() -> Dyad:
            pair = [(f"{file} {key}", _rows(file, unpickle, key)) for key in keys]
            return dyad_of(name, pair, frames, "deca56", FPS)

        def hubert() -> Floats:
            rows = numbers(unpickle(file), "audio")
            return track(f"{file} audio", rows, frames, rows.shape[-1])

        return Clip(name=name, frames=frames, read=read, features={"hubert": hubert})

    yield from attempt([name for name, theirs in listed.items() if theirs == split], clip)


DIM: Final = Layout(
    name="dim", about=f"DIM's ViCo: vico_processed_30fps/<id>.pkl and {LIST}", space="deca56", fps=FPS,
    order="pose-first", splits=partial(_splits, _listed), scan=dim_scan, held_out=0.1,
    below=("", "vico_processed_30fps", "data/vico_processed_30fps"),
)  # fmt: skip


# --- the challenge's baseline ---------------------------------------------------------------------------------------

_VECTORS: Final = "angle.exp.trans"


def _uuids(place: Path) -> dict[str, str]:
    """Return the split of every uuid; those without a split are train. Raises ConfigError for an invalid list."""
    videos, file = place / "features" / "video_feats", place / "metadata" / "data.csv"
    if not videos.is_dir() or not file.is_file():
        return dict.fromkeys(sorted({path.name.split(".")[0] for path in videos.glob("*.*.bin")}), "train")
    header, *lines = table(file) or [[]]
    if "uuid" not in header:
        raise ConfigError(f"{file}: has no column uuid ({', '.join(header) or 'no rows'})")
    rows = [dict(zip(header, line, strict=False)) for line in lines]
    return {row["uuid"]: row.get("data_split") or row.get("split") or "train" for row in rows if row.get("uuid")}


def vico_scan(place: Path, split: str) -> Iterator[Found]:
    def faces(name: str) -> list[tuple[Path, NDArray[Any]]]:
        files = [place / "features" / "video_feats" / f"{name}.{role}.bin" for role in ROLES]
        return [(file, _rows(file, torch_load, _VECTORS)) for file in files]

    def clip(name: str) -> Clip:
        frames = _frames(name, "deep3d73", *((file, _VECTORS, rows) for file, rows in faces(name)))
        sound = place / "features" / "audio_feats" / f"{name}.npy"
        return Clip(
            name=name,
            frames=frames,
            read=lambda: dyad_of(name, faces(name), frames, "deep3d73", FPS),
            features={"mfcc45": lambda: track(str(sound), npy(existing(sound, "missing feature")), frames, 45)},
        )

    yield from attempt([name for name, theirs in _uuids(place).items() if theirs == split], clip)


VICO: Final = Layout(
    name="vico", about="ViCo challenge baseline: features/{audio_feats,video_feats}", space="deep3d73", fps=FPS,
    splits=partial(_splits, _uuids), scan=vico_scan, held_out=0.1,
)  # fmt: skip
