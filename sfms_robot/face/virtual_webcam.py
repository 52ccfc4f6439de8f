"""The virtual human as a webcam would see it: pictures whose face is known, to try what reads faces from pictures."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.face.drawing import BACKGROUND, add_head, add_renderer, load_vtk, look, open_window
from sfms_robot.face.human import load_human
from sfms_robot.frames import Floats

PLACE_M: Final = (0.6, 0.0, 0.0)  # arm's length, in the middle of the picture
ANGLE_DEG: Final = 45.0  # across the picture's height: a common webcam
SIZE_PX: Final = (640, 480)
_EYES_M: Final = (0.09, 0.0, 0.032)  # of the head at rest


class VirtualWebcam:
    """Takes pictures of one person who looks straight ahead at rest. Raises MissingExtra without vtk."""

    def __init__(self, size_px: tuple[int, int] = SIZE_PX, angle_deg: float = ANGLE_DEG) -> None:
        self._vtk = load_vtk()
        self._window, self._angle_deg = open_window(self._vtk, size_px), angle_deg
        self._human = load_human()

    def picture(self, motion: Floats, place_m: tuple[float, float, float] = PLACE_M) -> NDArray[np.uint8]:
        """(H, W, 3) red, green, blue, not mirrored.

        motion: (58,) of the person. place_m: the eyes at rest, from the camera: x out of its lens, y to its left, z up;
        the lens looks straight along its x, and the person along the same line towards it.
        """
        vtk = self._vtk
        renderer = add_renderer(vtk, self._window, (0, 0, 1, 1), BACKGROUND)
        add_head(vtk, renderer, self._human, motion)
        # The person looks the other way: their left is the camera's right.
        away, left, up = place_m
        lens = (_EYES_M[0] + away, _EYES_M[1] + left, _EYES_M[2] - up)
        look(renderer, lens, (lens[0] - 1.0, lens[1], lens[2]), self._angle_deg)
        self._window.Render()
        image = vtk.WindowToImageFilter()
        image.SetInput(self._window)
        image.ReadFrontBufferOff()
        image.Update()
        self._window.RemoveRenderer(renderer)
        wide, high = self._window.GetSize()
        flat = vtk.arrays.vtk_to_numpy(image.GetOutput().GetPointData().GetScalars())
        return np.ascontiguousarray(flat.reshape(high, wide, 3)[::-1])
