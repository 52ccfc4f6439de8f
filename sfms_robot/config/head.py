"""A head: joints, the servos that move them, how far and fast they may go, and what drives them."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from sfms_robot.config.base import Finite, Model, Name, NonNegative, Positive, find, load
from sfms_robot.frames import CHANNEL_INDEX


class Bus(Model):
    """One named bus of a head."""

    family: Literal["dynamixel"]
    baud: Annotated[int, Field(gt=0)]
    rate_hz: Positive = 100.0


class LimitClass(Model):
    """How fast a class of joints may move, in degrees."""

    speed_deg_s: Positive
    acceleration_deg_s2: Positive
    jerk_deg_s3: Positive


class Expression(Model):
    """A node of a joint's drive: one channel, or a sum, maximum or mean of nodes; then x gain + offset, clamped.

    A bare channel name stands for `{channel: NAME}`.
    """

    channel: str | None = None
    sum: tuple[Expression, ...] | None = None
    max: tuple[Expression, ...] | None = None
    mean: tuple[Expression, ...] | None = None
    gain: Finite = 1.0
    offset: Finite = 0.0
    clamp: tuple[Finite, Finite] | None = None

    @model_validator(mode="before")
    @classmethod
    def _bare_name(cls, value: Any) -> Any:
        return {"channel": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _one_kind(self) -> Expression:
        kinds = [k for k in ("channel", "sum", "max", "mean") if getattr(self, k) is not None]
        if len(kinds) != 1:
            raise ValueError(f"needs exactly one of channel, sum, max, mean; has {', '.join(kinds) or 'none'}")
        if self.channel is not None and self.channel not in CHANNEL_INDEX:
            raise ValueError(f"{self.channel!r} is not a channel ({', '.join(CHANNEL_INDEX)})")
        for kind in ("sum", "max", "mean"):
            if getattr(self, kind) == ():
                raise ValueError(f"{kind} is empty")
        if self.clamp is not None and self.clamp[0] >= self.clamp[1]:
            raise ValueError(f"clamp {list(self.clamp)} is reversed or empty")
        return self

    def channels(self) -> set[str]:
        """Every channel below this node."""
        if self.channel is not None:
            return {self.channel}
        return set().union(*(node.channels() for node in self.sum or self.max or self.mean or ()))


class Joint(Model):
    """One joint: where it sits on a bus, how far and fast it may go, and what drives it.

    Ticks = zero_ticks + sign * ratio * angle / (angle per tick of the servo). `drive` is in units of the range
    (-1 = min, 0 = rest, +1 = max) when `unit` is "range", in radians when it is "rad".
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
    lag_ms: NonNegative = 0.0
    unit: Literal["range", "rad"] = "range"
    drive: Expression | None = None
    note: str = ""

    @model_validator(mode="after")
    def _ordered(self) -> Joint:
        if self.min_deg >= self.max_deg:
            raise ValueError(f"min_deg {self.min_deg:g} is not below max_deg {self.max_deg:g}: limits reversed")
        if not self.min_deg <= self.rest_deg <= self.max_deg:
            raise ValueError(f"rest_deg {self.rest_deg:g} is outside {self.min_deg:g}..{self.max_deg:g}")
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


class Head(Model):
    """A head: `configs/heads/NAME/head.yaml`."""

    name: Name
    description: str
    buses: Annotated[dict[Name, Bus], Field(min_length=1)]
    limits: dict[Name, LimitClass]
    joints: Annotated[dict[Name, Joint], Field(min_length=1)]

    @model_validator(mode="after")
    def _consistent(self) -> Head:
        seen: dict[tuple[str, int], str] = {}
        for name, joint in self.joints.items():
            if joint.bus not in self.buses:
                raise ValueError(
                    f"joints.{name}.bus = {joint.bus!r} is not a bus of this head ({', '.join(self.buses)})"
                )
            if joint.limits not in self.limits:
                raise ValueError(
                    f"joints.{name}.limits = {joint.limits!r} is not a limit class ({', '.join(self.limits)})"
                )
            other = seen.setdefault((joint.bus, joint.id), name)
            if other != name:
                raise ValueError(f"joints.{name}.id = {joint.id} is used twice on bus {joint.bus!r} (also by {other})")
        return self

    def limit(self, joint: str) -> LimitClass:
        return self.limits[self.joints[joint].limits]


def load_head(name: str) -> Head:
    """A head by shipped name or folder."""
    return load(Head, find("heads", name, "head.yaml") / "head.yaml")
