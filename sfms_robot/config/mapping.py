"""The language in which a head says what its joints follow.

A drive is an `Expression`: one channel, one shared expression, or a sum, maximum, minimum, mean or product of
expressions. The value of a node then goes through, in this order, its dead band, curve, gain, offset and clamp.
Couplings and regions speak of the results, in joint units: -1 = min, 0 = rest, +1 = max where the joint's `unit` is
"range", radians from rest where it is "rad".
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from sfms_robot.config.base import Finite, Model, Name, NonNegative
from sfms_robot.frames import CHANNEL_INDEX

GROUPS = ("sum", "max", "min", "mean", "product")
KINDS = ("channel", "use", *GROUPS)
MOST_FACTORS = 4
SMALLEST_STEP = 1e-6  # of a curve's x

Gain = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]  # bounded: no drive can overflow
Knob = Annotated[float, Field(ge=0, le=2, allow_inf_nan=False)]


class Expression(Model):
    """A node of a drive. A bare name stands for `{channel: NAME}`, or `{use: NAME}` for a shared expression.

    Attributes:
        channel, use, sum, max, min, mean, product: exactly one of these; a product has at most four factors.
        dead_band: values this near to 0 become 0, the others come nearer by as much.
        curve: points (x, y), x rising; between them a monotone cubic (PCHIP), beyond them the last y.
        gain: factor; `gain_up` and `gain_down` take its place above and below 0.
        offset: added after the gain.
        clamp: (low, high) of the result.
    """

    channel: str | None = None
    use: str | None = None
    sum: tuple[Expression, ...] | None = None
    max: tuple[Expression, ...] | None = None
    min: tuple[Expression, ...] | None = None
    mean: tuple[Expression, ...] | None = None
    product: tuple[Expression, ...] | None = None
    dead_band: NonNegative = 0.0
    curve: tuple[tuple[Gain, Gain], ...] | None = None
    gain: Gain = 1.0
    gain_up: Gain | None = None
    gain_down: Gain | None = None
    offset: Gain = 0.0
    clamp: tuple[Finite, Finite] | None = None

    @model_validator(mode="before")
    @classmethod
    def _bare_name(cls, value: Any) -> Any:
        if isinstance(value, str):
            return {"channel" if value in CHANNEL_INDEX else "use": value}
        return value

    @model_validator(mode="after")
    def _one_kind(self) -> Expression:
        kinds = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(kinds) != 1:
            raise ValueError(f"needs exactly one of {', '.join(KINDS)}; has {', '.join(kinds) or 'none'}")
        if self.channel is not None and self.channel not in CHANNEL_INDEX:
            raise ValueError(f"{self.channel!r} is not a channel ({', '.join(CHANNEL_INDEX)})")
        if kinds[0] in GROUPS and not self.parts:
            raise ValueError(f"{kinds[0]} is empty")
        if self.product is not None and len(self.product) > MOST_FACTORS:
            raise ValueError(f"product has {len(self.product)} factors, at most {MOST_FACTORS}")
        if self.clamp is not None and self.clamp[0] >= self.clamp[1]:
            raise ValueError(f"clamp {list(self.clamp)} is reversed or empty")
        return self

    @model_validator(mode="after")
    def _curve_is_a_function(self) -> Expression:
        points = self.curve
        if points is None:
            return self
        if len(points) < 2:
            raise ValueError(f"curve has {len(points)} point, needs at least 2")
        for (before, _), (after, _) in zip(points, points[1:], strict=False):
            if after - before < SMALLEST_STEP:
                raise ValueError(f"curve is not a function: x goes from {before:g} to {after:g}, it has to rise")
        return self

    @property
    def parts(self) -> tuple[Expression, ...]:
        """The nodes below; none for a channel or a shared expression."""
        return self.sum or self.max or self.min or self.mean or self.product or ()

    @property
    def group(self) -> str | None:
        return next((kind for kind in GROUPS if getattr(self, kind) is not None), None)

    @property
    def gains(self) -> tuple[float, float]:
        """Factor below 0 and above 0."""
        down = self.gain if self.gain_down is None else self.gain_down
        return down, self.gain if self.gain_up is None else self.gain_up

    def channels(self) -> set[str]:
        """Every channel below this node, shared expressions left out."""
        own = {self.channel} if self.channel else set[str]()
        return own.union(*(part.channels() for part in self.parts))


class Coupling(Model):
    """What joints owe each other, whatever their drives ask: sum of weight x joint >= at_least, in joint units.

    Where it would be less, the joints under `moving` give way, the first as far as its range goes, then the next.
    """

    keep: Annotated[dict[Name, Gain], Field(min_length=2)]
    at_least: Annotated[float, Field(le=0, ge=-1000)]  # at rest the sum is 0: rest has to be allowed
    moving: Annotated[tuple[Name, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _can_move(self) -> Coupling:
        for name in self.moving:
            if not self.keep.get(name):
                raise ValueError(f"moving: {name!r} has no weight under keep ({', '.join(self.keep)})")
        if len(set(self.moving)) != len(self.moving):
            raise ValueError(f"moving {list(self.moving)} has a joint twice")
        return self


class Fold(Model):
    """A channel whose own joint the head lacks, shown by another: `gain` x channel is added to that joint's drive."""

    channel: str
    into: Name
    gain: Gain

    @model_validator(mode="after")
    def _known(self) -> Fold:
        if self.channel not in CHANNEL_INDEX:
            raise ValueError(f"{self.channel!r} is not a channel ({', '.join(CHANNEL_INDEX)})")
        return self


class Region(Model):
    """Joints that are turned up and down together; both knobs run from 0 to 2 and start here.

    Attributes:
        joints: no joint is in two regions.
        intensity: how far from rest everything goes; 0 is rest.
        style: how much of the fine detail shows; 0 lets only large motions through, 2 doubles the small ones.
    """

    joints: Annotated[tuple[Name, ...], Field(min_length=1)]
    intensity: Knob = 1.0
    style: Knob = 1.0
