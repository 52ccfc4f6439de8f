"""What MediaPipe's Face Landmarker tells of a face, in this project's words.

It gives 52 blendshapes by name, `_neutral` among them and `tongueOut` not, left and right the person's own in a picture
that is not mirrored, and a matrix face -> camera: x to the picture's right, y up, z towards the viewer, centimetres.
With x forward = z, y left = x, z up = y its rotation is our Rz(yaw) Ry(pitch) Rx(roll), signs included.

The distance is what a lens of 63 degrees across the picture's height would make of the face's size, and the face is
taken to be of average size. So it is relative: a lens of 45 degrees makes people come out about a third too near.
Sideways and up are not affected, since there the lens cancels out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import BLENDSHAPES, Floats

# Between the eyes, in the axes and centimetres of the matrix: mean of the corners of both eyes (points 33, 133, 362 and
# 263) in `canonical_face_model.obj` of google-ai-edge/mediapipe.
_EYES_CM: Final = (0.0, 2.62, 3.47, 1.0)


@dataclass(frozen=True)
class SeenFace:
    """One face in one picture.

    Attributes:
        motion: (58,) pose in the person's axes (x forward, from the lens on, so negative), blendshapes.
        place_m: (3,) between the eyes, from the camera: x out of its lens, y to its left, z up.
    """

    motion: Floats
    place_m: Floats


def seen_face(matrix: NDArray[np.floating], shapes: Mapping[str, float]) -> SeenFace:
    """`matrix` (4, 4) face -> camera; `shapes` by MediaPipe's names, those it does not give are 0."""
    roll = math.atan2(matrix[1, 0], matrix[1, 1])
    pitch = math.asin(min(1.0, max(-1.0, -float(matrix[1, 2]))))
    yaw = math.atan2(matrix[0, 2], matrix[2, 2])
    right_m, up_m, near_m = matrix[:3, 3] / 100.0
    pose = (roll, pitch, yaw, near_m, right_m, up_m)
    eyes_m = (matrix @ np.array(_EYES_CM))[:3] / 100.0
    return SeenFace(
        np.array([*pose, *(shapes.get(name, 0.0) for name in BLENDSHAPES)], dtype=np.float32),
        np.array([-eyes_m[2], -eyes_m[0], eyes_m[1]], dtype=np.float32),
    )
