"""Facial action units (FACS: Ekman, Friesen and Hager 2002) -> ARKit blendshapes, one unit to the shapes that name it.

A unit has one intensity for both sides of the face, so left and right come out alike. What no unit stands for stays
0, and what has no shape of its own is left out; both are listed here, and told by `data check` and `data convert`.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfms_robot.frames import BLENDSHAPES, Doubles, Floats
from sfms_robot.signals.face_tables import SHAPES_OF_UNIT

# The 24 columns of `FAUValue` of Seamless Interaction. The data set does not say their order; this is the one that
# software written for it uses, and `lab.corpora.external.seamless` holds it against the key points of the files.
FAU_VALUE: Final = (1, 2, 4, 5, 6, 7, 9, 10, 12, 13, 14, 15, 16, 17, 18, 20, 22, 23, 24, 25, 26, 28, 30, 43)
FULL: Final = 2.0  # the intensity at which its columns saturate: shown as 1
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
