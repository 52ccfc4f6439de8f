"""Facial action units (FACS: Ekman, Friesen and Hager 2002) -> ARKit blendshapes, one unit to the shapes that name it.

A unit has one intensity for both sides of the face, so left and right come out alike. What no unit stands for stays
0, and what has no shape of its own is left out; both are listed here, and told by `data check` and `data convert`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from sfms_robot.frames import BLENDSHAPES, Doubles, Floats

# The 24 columns of `FAUValue` of Seamless Interaction. The data set does not say their order; this is the one that
# software written for it uses, and `lab.corpora.external.seamless` holds it against the key points of the files.
FAU_VALUE: Final = (1, 2, 4, 5, 6, 7, 9, 10, 12, 13, 14, 15, 16, 17, 18, 20, 22, 23, 24, 25, 26, 28, 30, 43)
FULL: Final = 2.0  # the intensity at which its columns saturate: shown as 1


def _both(name: str) -> tuple[str, str]:
    return f"{name}Left", f"{name}Right"


# FACS's name of the unit beside Apple's description of the shape.
SHAPES_OF_UNIT: Final[Mapping[int, tuple[str, ...]]] = {
    1: ("browInnerUp",),  # inner brow raiser
    2: _both("browOuterUp"),  # outer brow raiser
    4: _both("browDown"),  # brow lowerer
    5: _both("eyeWide"),  # upper lid raiser
    6: _both("cheekSquint"),  # cheek raiser
    7: _both("eyeSquint"),  # lid tightener
    9: _both("noseSneer"),  # nose wrinkler
    10: _both("mouthUpperUp"),  # upper lip raiser
    12: _both("mouthSmile"),  # lip corner puller
    13: ("cheekPuff",),  # cheek puffer
    14: _both("mouthDimple"),  # dimpler
    15: _both("mouthFrown"),  # lip corner depressor
    16: _both("mouthLowerDown"),  # lower lip depressor
    17: ("mouthShrugLower",),  # chin raiser
    18: ("mouthPucker",),  # lip pucker
    20: _both("mouthStretch"),  # lip stretcher
    22: ("mouthFunnel",),  # lip funneler
    24: _both("mouthPress"),  # lip pressor
    26: ("jawOpen",),  # jaw drop
    28: ("mouthRollLower", "mouthRollUpper"),  # lip suck
    43: _both("eyeBlink"),  # eyes closed
}
# 23 (lip tightener) and 25 (lips part) have no shape of their own, 30 (jaw sideways) does not tell the side.
WITHOUT_SHAPE: Final = tuple(unit for unit in FAU_VALUE if unit not in SHAPES_OF_UNIT)
WITHOUT_UNIT: Final = tuple(
    shape for shape in BLENDSHAPES if not any(shape in shapes for shapes in SHAPES_OF_UNIT.values())
)
_PLACES: Final = [
    (column, [BLENDSHAPES.index(shape) for shape in SHAPES_OF_UNIT[unit]])
    for column, unit in enumerate(FAU_VALUE)
    if unit in SHAPES_OF_UNIT
]


def blendshapes_of(intensities: Floats | Doubles) -> Floats:
    """Return blendshapes (N, 52) within 0..1 of intensities (N, 24) in the order of `FAU_VALUE`.

    Raises ValueError for another width."""
    if intensities.ndim != 2 or intensities.shape[1] != len(FAU_VALUE):
        raise ValueError(f"action units are {intensities.shape}, not (N, {len(FAU_VALUE)})")
    out = np.zeros((len(intensities), len(BLENDSHAPES)), np.float32)
    for column, places in _PLACES:
        out[:, places] = np.clip(intensities[:, column] / FULL, 0.0, 1.0)[:, None]
    return out
