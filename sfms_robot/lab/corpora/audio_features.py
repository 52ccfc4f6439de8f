"""Features of sound that are expensive to compute: once per recording, then read from disk.

An entry's name is the hash of the samples, the feature and its version, so nothing stale is ever read and files may be
renamed. Entries carry a checksum; one that is broken is computed again. Writing is atomic: several programs may share
a folder.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Floats
from sfms_robot.signals.mfcc import DIM as MFCC_DIM
from sfms_robot.signals.mfcc import mfcc78


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A feature computed from sound, frame by frame.

    Attributes:
        version: changes whenever the same samples give other rows: another algorithm, other weights.
        dim: numbers a frame.
        fps: frames a second.
        compute: (n,) mono 16 kHz -> (frames, dim).
    """

    name: str
    version: str
    dim: int
    fps: float
    compute: Callable[[Floats], Floats]


MFCC78: Final = Feature(name="mfcc", version="1", dim=MFCC_DIM, fps=FRAME_HZ, compute=mfcc78)


def wav2vec2_feature(folder: Path | str, fps: float = FRAME_HZ, device: str = "cpu", hop_frames: int = 1) -> Feature:
    """Return the feature of a wav2vec2 model folder; its version holds the hop and a hash of the model's files."""
    from sfms_robot.signals.wav2vec2 import FILES, Wav2Vec2  # needs torch

    model = Wav2Vec2(folder, device, hop_frames)
    digest = hashlib.sha256()
    for file in (model.folder / name for name in FILES):
        if file.is_file():
            with file.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())
    version = f"1 hop {hop_frames} {digest.hexdigest()[:16]}"
    return Feature(
        name="wav2vec2", version=version, dim=model.dim, fps=fps, compute=partial(model.of_recording, fps=fps)
    )


def cached(samples: Floats, feature: Feature, folder: Path) -> Floats:
    """Return rows (frames, dim) from `folder`, or compute and keep them. Raises ConfigError if it is read-only."""
    file = entry(samples, feature, folder)
    found = _read(file, feature.dim)
    if found is not None:
        return found
    rows = np.asarray(feature.compute(samples), dtype=np.float32)
    if rows.ndim != 2 or rows.shape[1] != feature.dim:
        raise ValueError(f"feature {feature.name} gave shape {rows.shape}, expected (frames, {feature.dim})")
    try:
        _write(file, rows)
    except OSError as error:
        raise ConfigError(f"{folder}: features cannot be kept here: {error.strerror or error}") from error
    return rows


def entry(samples: Floats, feature: Feature, folder: Path) -> Path:
    """Return the file in which the rows of these samples are kept."""
    identity = f"{feature.name}\0{feature.version}\0{feature.fps:g}\0{samples.dtype.str}\0"
    key = hashlib.sha256(identity.encode() + np.ascontiguousarray(samples).tobytes()).hexdigest()
    return folder / feature.name / key[:2] / f"{key[2:34]}.npz"


def _read(file: Path, dim: int) -> Floats | None:
    """Return the rows if their checksum holds, else None."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            rows = np.asarray(arrays["rows"])
    except (OSError, ValueError, KeyError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error):
        return None
    return rows if rows.ndim == 2 and rows.shape[1] == dim and rows.dtype == np.float32 else None


def _write(file: Path, rows: Floats) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f"{file.stem}.{os.getpid()}.part")
    try:
        with part.open("wb") as stream:
            np.savez(stream, rows=rows)
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)
