"""Whole recorded faces at 25 fps: what tokenizers are trained and compared on where nobody brought a dataset.

`build` reads them from a folder of recordings, `save` and `load` keep them in one file, `sim/listeners/takes.npz`.
Nothing is done to them but resampling: resting faces differ from person to person, and a tokenizer has to cope. Held
out are whole takes of both recording systems, and the second half of a third.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, MOTION_DIM, Floats
from sfms_robot.signals.tracks import read_track, resample

TRAIN: Final = "train"
HELD_OUT: Final = "held_out"
STEP: Final = 2e-4  # resolution on disk: a hundredth of what `tables.scales` takes for stillness
_WHOLE: Final = {
    "livelinkface_alexdjulin": ("S07-001", "alex_rom_3", "facial"),
    "faces_mediapipe_liveportrait": ("d0", "d3", "d6", "d19"),
}
_WHOLE_HELD_OUT: Final = {"livelinkface_alexdjulin": ("apfel",), "faces_mediapipe_liveportrait": ("d12", "d18")}
_HALVED: Final = ("livelinkface_alexdjulin", "alex_rom_4")


@dataclass(frozen=True)
class Take:
    """A stretch in which a face was seen all the time. `motion` (N, 58) at 25 fps, radians, metres, 0..1."""

    name: str
    motion: Floats


def build(data: Path) -> Iterator[tuple[str, Take]]:
    """(split, take) from a folder of recordings. Raises ConfigError naming the file that is missing or broken."""
    for split, folders in ((TRAIN, _WHOLE), (HELD_OUT, _WHOLE_HELD_OUT)):
        for folder, names in folders.items():
            for name in names:
                yield from ((split, take) for take in face_stretches(data / folder / f"{name}.csv.gz", name))
    folder, name = _HALVED
    motion = resample(read_track(data / folder / f"{name}.csv.gz"), FRAME_HZ).motion
    middle = len(motion) // 2
    yield from ((TRAIN, take) for take in _stretches(motion[:middle], name))
    yield from ((HELD_OUT, take) for take in _stretches(motion[middle:], name))


def face_stretches(file: Path, name: str) -> list[Take]:
    """The stretches of a face track in which a face was seen. Raises ConfigError."""
    return _stretches(resample(read_track(file), FRAME_HZ).motion, name)


def folder_takes(folder: Path) -> list[Take]:
    """Every face track (CSV, CSV.gz) below `folder`. Raises ConfigError when there is none or one cannot be read."""
    files = sorted([*folder.rglob("*.csv"), *folder.rglob("*.csv.gz")])
    if not files:
        raise ConfigError(f"--data {str(folder)!r}: no face tracks (*.csv, *.csv.gz) below it")
    return [take for file in files for take in face_stretches(file, str(file.relative_to(folder)))]


def save(file: Path, takes: Iterable[tuple[str, Take]]) -> None:
    """Write (split, take) pairs as differences from frame to frame, which are small numbers."""
    arrays: dict[str, NDArray[np.int16]] = {}
    for split, take in takes:
        part = sum(key.startswith(f"{split}/{take.name}/") for key in arrays)
        whole = np.round(take.motion / STEP).astype(np.int16)
        arrays[f"{split}/{take.name}/{part}"] = np.ascontiguousarray(np.diff(whole, axis=0, prepend=np.int16(0)).T)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load(file: Path) -> dict[str, list[Take]]:
    """Takes by split. Raises ConfigError when the file is not what `save` wrote."""
    found: dict[str, list[Take]] = {TRAIN: [], HELD_OUT: []}
    try:
        with np.load(file, allow_pickle=False) as arrays:
            for key in arrays:
                split, name, _ = key.split("/")
                steps = arrays[key]
                if steps.ndim != 2 or len(steps) != MOTION_DIM:
                    raise ValueError(f"{key} has shape {steps.shape}")
                found[split].append(Take(name, (steps.cumsum(axis=1).T * STEP).astype(np.float32)))
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{file}: not a file of recorded takes: {error}") from error
    return found


def _stretches(motion: Floats, name: str) -> list[Take]:
    known = np.isfinite(motion).all(axis=1)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [Take(name, motion[first:last]) for first, last in zip(ends[::2], ends[1::2], strict=True)]
