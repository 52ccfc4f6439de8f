"""Whole recorded faces at 25 fps, on which tokenizers are trained and compared without a data set of the user's own.

`build` reads them from a folder of recordings, `save` and `load` keep them in one file, `sim/listeners/takes.npz`.
Nothing is done to them but resampling: resting faces differ from person to person, and a tokenizer has to cope. Held
out are whole takes of both recording systems, and the second half of a third.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, MOTION_DIM
from sfms_robot.signals.tracks import Take, face_stretches, read_track, resample, stretches

TRAIN: Final = "train"
HELD_OUT: Final = "held_out"
STEP: Final = 2e-4  # resolution on disk: a hundredth of what `tables.scales` takes for stillness
_WHOLE: Final = {
    "livelinkface_alexdjulin": ("S07-001", "alex_rom_3", "facial"),
    "faces_mediapipe_liveportrait": ("d0", "d3", "d6", "d19"),
}
_WHOLE_HELD_OUT: Final = {"livelinkface_alexdjulin": ("apfel",), "faces_mediapipe_liveportrait": ("d12", "d18")}
_HALVED: Final = ("livelinkface_alexdjulin", "alex_rom_4")


def build(data: Path) -> Iterator[tuple[str, Take]]:
    """(split, take) from a folder of recordings. Raises ConfigError naming the file that is missing or broken."""
    for split, folders in ((TRAIN, _WHOLE), (HELD_OUT, _WHOLE_HELD_OUT)):
        for folder, names in folders.items():
            for name in names:
                yield from ((split, take) for take in face_stretches(data / folder / f"{name}.csv.gz", name))
    folder, name = _HALVED
    motion = resample(read_track(data / folder / f"{name}.csv.gz"), FRAME_HZ).motion
    middle = len(motion) // 2
    yield from ((TRAIN, take) for take in stretches(motion[:middle], name))
    yield from ((HELD_OUT, take) for take in stretches(motion[middle:], name))


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
