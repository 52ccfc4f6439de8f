"""Where the camera that sees people is mounted: the section `camera` of a head's file."""

from __future__ import annotations

from typing import Literal

from sfms_robot.config.base import Finite, Model

Triple = tuple[Finite, Finite, Finite]


class CameraMount(Model):
    """A camera and where it looks; axes are the head's, x forward, y left, z up.

    Attributes:
        on: `head` moves with the neck; `base` stays.
        at_m: its place, from the middle of the head at home.
        rpy_deg: how it is turned, roll, pitch (+ down) and yaw (+ left); zero looks ahead.
    """

    on: Literal["head", "base"]
    at_m: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)
