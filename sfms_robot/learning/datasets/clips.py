"""One conversation seen from one listener, as arrays, and how a set of them is kept on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES, MOTION_DIM, Floats


@dataclass(frozen=True)
class Dyad:
    """N frames of 40 ms: what the speaker does, what the listener did.

    Attributes:
        name: unique, tells the origin (meeting, listener).
        audio: (N * 640,) speaker's voice, 16 kHz mono.
        speaker: (N, 58) speaker's motion; a row of NaN where the face is not known.
        listener: (N, 58) listener's motion: what is to be learned.
        listening: (N,) True where somebody else spoke in the last 2 s and the listener is silent.
    """

    name: str
    audio: Floats
    speaker: Floats
    listener: Floats
    listening: NDArray[np.bool_]

    def __post_init__(self) -> None:
        frames = len(self.listener)
        for key, shape in (
            ("audio", (frames * FRAME_SAMPLES,)),
            ("speaker", (frames, MOTION_DIM)),
            ("listener", (frames, MOTION_DIM)),
            ("listening", (frames,)),
        ):
            if getattr(self, key).shape != shape:
                raise ValueError(f"{self.name}: {key} has shape {getattr(self, key).shape}, expected {shape}")
        if not np.isfinite(self.listener).all() or not np.isfinite(self.audio).all():
            raise ValueError(f"{self.name}: listener and audio must be finite")


def save(folder: Path, dyads: Sequence[Dyad]) -> None:
    """One NAME.npz per dyad: audio as int16, motion as float16 (3 decimals are more than a servo shows)."""
    folder.mkdir(parents=True, exist_ok=True)
    for dyad in dyads:
        np.savez_compressed(
            folder / f"{dyad.name}.npz",
            audio=np.round(dyad.audio * 32767).astype(np.int16),
            speaker=dyad.speaker.astype(np.float16),
            listener=dyad.listener.astype(np.float16),
            listening=dyad.listening,
        )


def load(folder: Path) -> list[Dyad]:
    """Every dyad in a folder, by name. Raises ConfigError when there is none or one is broken."""
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise ConfigError(f"{folder}: no dyads (*.npz) here; `sfms-robot data compose` makes them")
    return [_read(file) for file in files]


def _read(file: Path) -> Dyad:
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return Dyad(
                file.stem,
                arrays["audio"].astype(np.float32) / 32767,
                arrays["speaker"].astype(np.float32),
                arrays["listener"].astype(np.float32),
                arrays["listening"].astype(bool),
            )
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{file}: not a dyad: {error}") from error
