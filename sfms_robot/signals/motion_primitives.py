"""Motion primitives: small pieces of recorded motion, as `sim/listeners/motions.npz` holds them.

A *primitive* is one nod cycle, one blink, one smile with everything that moves along, one brow raise, or a stretch of
idle face or head motion. They are cut from recordings by `scripts/cut_recordings.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Floats

STEP: Final = 1e-3  # resolution on disk
SPLITS: Final = ("train", "validation", "test")


Pieces = tuple[Floats, ...]


@dataclass(frozen=True, kw_only=True)
class Motions:
    """Primitives at 25 fps, each kind a tuple of arrays; blendshapes are differences from the person's neutral.

    Attributes:
        nods: (24,) one cycle down and back, normalised to 0..1 in time and height.
        shakes: (24,) the same of a head turn.
        sway: (N, 3) roll, pitch, yaw [rad] of an idle head, slow, mean 0.
        heads: (N, 6) pose of a person who talks, mean 0.
        blinks: (K, 52) peak 1.
        gaps: (M,) seconds from blink to blink.
        smiles: (K, 52) onset to offset, peak of mouthSmile 1.
        brows: (K, 52) a raise, peak 1.
        idle: (N, 52) the small motion of an idle face, without the eyes, mean 0.
        talk: (N, 52) a mouth that speaks.
        faces: (N, 52) face of a person who talks, without the mouth.
    """

    nods: Pieces
    shakes: Pieces
    sway: Pieces
    heads: Pieces
    blinks: Pieces
    gaps: Pieces
    smiles: Pieces
    brows: Pieces
    idle: Pieces
    talk: Pieces
    faces: Pieces


KINDS: Final = tuple(field.name for field in fields(Motions))


def read_motions(file: Path) -> dict[str, Motions]:
    """Read the motions of every split. Raises ConfigError for a file with other content."""
    pieces: dict[str, dict[str, list[Floats]]] = {split: {kind: [] for kind in KINDS} for split in SPLITS}
    try:
        with np.load(file, allow_pickle=False) as arrays:
            for key in arrays:
                split, kind, _ = key.split("/", 2)
                pieces[split][kind].append((arrays[key] * STEP).astype(np.float32))
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{file}: not a file of motion primitives: {error}") from error
    for split in SPLITS:
        for kind in KINDS:
            if not pieces[split][kind]:
                raise ConfigError(f"{file}: no {kind} for {split}")
    return {split: Motions(**{kind: tuple(found) for kind, found in pieces[split].items()}) for split in SPLITS}
