"""One joint of a head: which servo moves it, how far and fast it may go, and what it follows."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sfms_robot.config.base import Finite, Model, Name, Positive
from sfms_robot.config.mapping import Expression
from sfms_robot.config.safety_rules import Safety

Lag = Annotated[float, Field(ge=0, le=500, allow_inf_nan=False)]  # ms; a plan's horizon is 320


class LimitClass(Model):
    """How fast a class of joints may move, in degrees."""

    speed_deg_s: Positive
    acceleration_deg_s2: Positive
    jerk_deg_s3: Positive


class Joint(Model):
    """One joint: where it sits on a bus, how far and fast it may go, and what drives it.

    Ticks = zero_ticks + sign * ratio * angle / (angle per tick of the servo). `drive` is in units of the range
    (-1 = min, 0 = rest, +1 = max) when `unit` is "range", in radians when it is "rad".

    With `mirror_of` the joint takes over whatever it does not give itself from its twin on the other side, with the
    drive (and for `mirror_sense: opposite` the range) turned round; `sign` then differs when the sense is the same.
    """

    bus: Name
    id: Annotated[int, Field(ge=0, le=252)]
    model: str
    zero_ticks: int
    sign: Literal[1, -1] = 1
    ratio: Positive = 1.0
    min_deg: Finite
    rest_deg: Finite = 0.0
    max_deg: Finite
    limits: Name
    lag_ms: Lag = 0.0
    unit: Literal["range", "rad"] = "range"
    drive: Expression | None = None
    mirror_of: Name | None = None
    mirror_sense: Literal["same", "opposite"] = "same"
    safety: Safety | None = None  # over that of the head
    note: str = ""

    @model_validator(mode="after")
    def _ordered(self) -> Joint:
        if self.min_deg >= self.max_deg:
            raise ValueError(f"min_deg {self.min_deg:g} is not below max_deg {self.max_deg:g}: limits reversed")
        if not self.min_deg <= self.rest_deg <= self.max_deg:
            raise ValueError(f"rest_deg {self.rest_deg:g} is outside {self.min_deg:g}..{self.max_deg:g}")
        if self.mirror_of is not None and self.drive is not None:
            raise ValueError(f"has a drive and is mirror_of {self.mirror_of!r}: one of them")
        return self

    @property
    def min_rad(self) -> float:
        return math.radians(self.min_deg)

    @property
    def max_rad(self) -> float:
        return math.radians(self.max_deg)

    @property
    def rest_rad(self) -> float:
        return math.radians(self.rest_deg)


class JointDefaults(Model):
    """What every joint has that does not say otherwise."""

    bus: Name | None = None
    model: str | None = None
    zero_ticks: int | None = None
    ratio: Positive | None = None
    min_deg: Finite | None = None
    max_deg: Finite | None = None
    limits: Name | None = None
    lag_ms: Lag | None = None
    unit: Literal["range", "rad"] | None = None
