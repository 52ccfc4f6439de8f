"""Joints of a head: the servo and bus of each joint, its range and limits, its safety, and the drive that it follows.

A drive is an `Expression`: one channel, one shared expression, or a sum, maximum, minimum, mean or product of
expressions. The value of a node then passes, in this order, its dead band, curve, gain, offset and clamp. Couplings and
regions apply to the results, in joint units: -1 = min, 0 = rest, +1 = max where the joint's `unit` is "range", radians
from rest where it is "rad".
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, PositiveInt, StrictInt, ValidationInfo, WithJsonSchema, model_validator

from sfms_robot.config.base import Finite, Model, Name, NonNegative, Positive, Problems
from sfms_robot.config.firmware import model_name
from sfms_robot.errors import did_you_mean, not_one_of
from sfms_robot.frames import CHANNEL_INDEX
from sfms_robot.plugins import plugins

GROUPS: Final = ("sum", "max", "min", "mean", "product")
KINDS: Final = ("channel", "use", *GROUPS)
MOST_FACTORS: Final = 4
SMALLEST_STEP: Final = 1e-6  # smallest distance between two x of a curve
BUS_FAMILIES: Final = ("dynamixel2", "dynamixel1", "feetech", "maestro", "ssc32")
BUS_GROUP: Final = "sfms_robot.buses"  # group of entry points with the families of other packages (`servo.families`)


def _channel(name: str) -> str:
    if name not in CHANNEL_INDEX:
        raise ValueError(not_one_of(name, "a channel", CHANNEL_INDEX))
    return name


Channel = Annotated[str, AfterValidator(_channel)]
ModelName = Annotated[str, AfterValidator(model_name)]
MeasuredFault = Annotated[str, Field(pattern="^(input voltage|overheating)$")]
Parts = Annotated[tuple["Expression", ...], Field(min_length=1)]
Gain = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]  # bounded, so that no drive can overflow
Knob = Annotated[float, Field(ge=0, le=2, allow_inf_nan=False)]
Lag = Annotated[float, Field(ge=0, le=500, allow_inf_nan=False)]  # ms; the horizon of a plan is 320 ms


class Expression(Model):
    """A node of a drive. A bare name stands for `{channel: NAME}`, or `{use: NAME}` for a shared expression.

    Attributes:
        channel, use, sum, max, min, mean, product: exactly one of these is given; a product has at most four factors.
        dead_band: values nearer to 0 than this become 0, and all others move nearer to 0 by this amount.
        curve: points (x, y) with rising x; a monotone cubic (PCHIP) between the points, constant beyond the outermost.
        gain: factor; `gain_up` and `gain_down` replace it for values above and below 0.
        offset: added after the gain.
        clamp: (low, high), limits of the result.
    """

    channel: Channel | None = None
    use: str | None = None
    sum: Parts | None = None
    max: Parts | None = None
    min: Parts | None = None
    mean: Parts | None = None
    product: Parts | None = Field(default=None, max_length=MOST_FACTORS)
    dead_band: NonNegative = 0.0
    curve: tuple[tuple[Gain, Gain], ...] | None = Field(default=None, min_length=2)
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

    def contradictions(self) -> Problems:
        kinds = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(kinds) != 1:
            yield f"needs exactly one of {', '.join(KINDS)}; has {', '.join(kinds) or 'none'}"
        if self.clamp is not None and self.clamp[0] >= self.clamp[1]:
            yield f"clamp {list(self.clamp)} is reversed or empty"
        for (before, _), (after, _) in pairwise(self.curve or ()):
            if after - before < SMALLEST_STEP:
                yield f"curve is not a function: x goes from {before:g} to {after:g}, it has to rise"

    @property
    def parts(self) -> tuple[Expression, ...]:
        """Nodes directly below this one; empty for a channel or a shared expression."""
        return self.sum or self.max or self.min or self.mean or self.product or ()

    @property
    def group(self) -> str | None:
        return next((kind for kind in GROUPS if getattr(self, kind) is not None), None)

    @property
    def gains(self) -> tuple[float, float]:
        """Factors below 0 and above 0."""
        down = self.gain if self.gain_down is None else self.gain_down
        return down, self.gain if self.gain_up is None else self.gain_up

    def nodes(self) -> Iterator[Expression]:
        """Yield this node and all nodes below it, without those of shared expressions."""
        yield self
        for part in self.parts:
            yield from part.nodes()

    def channels(self) -> set[str]:
        """Return every channel below this node, without those of shared expressions."""
        return {node.channel for node in self.nodes() if node.channel}


class Coupling(Model):
    """A bound on several joints, whatever their drives request: sum of weight x joint >= `at_least`, in joint units.

    `keep` holds the weights. If the sum would be less, the joints under `moving` give way, the first as far as its
    range allows, then the next.
    """

    keep: dict[Name, Gain] = Field(min_length=2)
    at_least: float = Field(le=0, ge=-1000)  # the sum is 0 at rest, which must be allowed
    moving: tuple[Name, ...] = Field(min_length=1)

    def contradictions(self) -> Problems:
        for name in self.moving:
            if not self.keep.get(name):
                yield f"moving: {name!r} has no weight under keep ({', '.join(self.keep)})"
        if len(set(self.moving)) != len(self.moving):
            yield f"moving {list(self.moving)} has a joint twice"


class Fold(Model):
    """A channel that has no joint, shown by the joint `into`: `gain` x channel is added to the drive of that joint."""

    channel: Channel
    into: Name
    gain: Gain


class Region(Model):
    """Joints with two common knobs, `intensity` and `style`, from 0 to 2; a run starts with the values given here.

    Attributes:
        joints: joints of the region; no joint may be in two regions.
        intensity: factor on the distance from rest; 0 is rest.
        style: amount of fine detail; 0 lets only large motions through, 2 doubles small motions.
    """

    joints: tuple[Name, ...] = Field(min_length=1)
    intensity: Knob = 1.0
    style: Knob = 1.0


class LoadRule(Model):
    """A load rule: the reaction of a joint to a present current above `current_mA` for `for_s` without a break."""

    current_mA: Positive
    for_s: Positive
    then: Literal["hold", "limp", "reduce"] = "limp"


class Safety(Model):
    """Force limits of a joint, and its reaction when its servo reports a fault.

    Attributes:
        current_limit_mA: limit of the servo's current, and thereby of its force; needs a servo with a current sensor.
        torque_limit_percent: limit in percent of the servo's full torque (its voltage, to be exact), for servos without
            a current sensor.
        on_fault: hold where the joint is, limp (torque off), reduce (half the force), or reboot and ease in again.
        pinch: load rule for something in the way. Default: limp after half a second above 60 % of the servo's own
            current limit.
        strain: load rule for a pose that needs force for long, which heats the servo and makes it hum. Off by default.
        stop: torque at the end of a run, once the joint is at rest: off (release) or kept (hold).
        halt: torque in an emergency stop, once the joint stands: off (release) or kept (hold). By default joints of the
            neck, which bear its weight, keep it.
        warm_C, hot_C: temperatures from which the joint moves half as far, and from which it stays at rest.
        registers: raw values written before torque comes on: gains, profiles and the like (`check.is_harmless`).
        stored: raw values that have to be stored in the servo; they are compared before torque comes on, never written.
    """

    current_limit_mA: Positive | None = None
    torque_limit_percent: float | None = Field(default=None, gt=0, le=100)
    on_fault: Literal["hold", "limp", "reduce", "reboot_and_ease_in"] = "limp"
    pinch: LoadRule | None = None
    strain: LoadRule | None = None
    stop: Literal["release", "hold"] = "release"
    halt: Literal["release", "hold"] | None = None
    warm_C: Positive = 60.0
    hot_C: Positive = 67.0
    registers: dict[Name, StrictInt] = {}
    stored: dict[Name, StrictInt] = {}

    def contradictions(self) -> Problems:
        if self.hot_C <= self.warm_C:
            yield f"hot_C: {self.hot_C:g} is not above warm_C ({self.warm_C:g})"

    def merged(self, other: Safety | None) -> Safety:
        """Return these settings, overridden by the keys that `other` sets explicitly."""
        return self if other is None else self.replaced(**{key: getattr(other, key) for key in other.model_fields_set})


class Threshold(Model):
    """Range of the measured value of a fault (V for voltage, degC for heat); the fault counts only outside min..max."""

    min: Finite | None = None
    max: Finite | None = None


class Faults(Model):
    """The servo faults that cause a reaction: all except those under `mask`, by the names in the firmware map."""

    mask: tuple[str, ...] = ()
    thresholds: dict[MeasuredFault, Threshold] = {}


class LimitClass(Model):
    """Limits of the motion of a class of joints, in degrees."""

    speed_deg_s: Positive
    acceleration_deg_s2: Positive
    jerk_deg_s3: Positive


class Joint(Model):
    """One joint: its servo on a bus, its range and limits, and its drive.

    Ticks = zero_ticks + sign * ratio * angle / (angle per tick of the servo). `drive` is in units of the range
    (-1 = min, 0 = rest, +1 = max) when `unit` is "range", in radians when it is "rad".

    With `mirror_of` the joint takes each value that it does not set itself from its twin on the other side, with left
    and right of the drive exchanged. `mirror_sense: same` reverses the sign; `opposite` negates drive and range.
    """

    bus: Name
    id: int = Field(ge=0, le=252)
    model: ModelName
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
    safety: Safety | None = None  # overrides the safety section of the head
    note: str = ""

    def contradictions(self) -> Problems:
        if self.min_deg >= self.max_deg:
            yield f"min_deg {self.min_deg:g} is not below max_deg {self.max_deg:g}: limits reversed"
        if not self.min_deg <= self.rest_deg <= self.max_deg:
            yield f"rest_deg {self.rest_deg:g} is outside {self.min_deg:g}..{self.max_deg:g}"
        if self.mirror_of is not None and self.drive is not None:
            yield f"has a drive and is mirror_of {self.mirror_of!r}: one of them"

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
    """Values for all joints that do not set them."""

    bus: Name | None = None
    model: ModelName | None = None
    zero_ticks: int | None = None
    ratio: Positive | None = None
    min_deg: Finite | None = None
    max_deg: Finite | None = None
    limits: Name | None = None
    lag_ms: Lag | None = None
    unit: Literal["range", "rad"] | None = None


def _family(name: str) -> str:
    if name in BUS_FAMILIES:
        return name
    known = [*BUS_FAMILIES, *plugins(BUS_GROUP)]
    if name not in known:
        raise ValueError(f"is not a family of buses ({', '.join(known)}){did_you_mean(name, known)}")
    return name


def _crc(crc: bool, info: ValidationInfo) -> bool:
    if crc and info.data.get("family") != "maestro":
        raise ValueError("expected false, as only a Maestro has this setting")
    return crc


class BusConfig(Model):
    """One named bus of a head.

    Attributes:
        read_deadline_ms: a servo that does not answer for this long counts as silent.
        fast_read: all servos answer a read in one packet; "auto" tries this at the start.
        watchdog_ms: time of the servos' own watchdog; 0 leaves it off.
        stagger_ms: pause between switching on the torque of one servo and of the next.
        reconnect_s: a bus without any answer for this long has failed.
        rs485: the direction of a half-duplex RS-485 driver chip is switched by the program through the RTS line (rts)
            or by the serial driver (kernel); None for adapters that switch it themselves.
        crc: true for a Maestro with "Enable CRC" on; every command then carries a CRC.
    """

    family: Annotated[str, AfterValidator(_family), WithJsonSchema({"enum": list(BUS_FAMILIES)})]
    baud: PositiveInt
    rate_hz: float = Field(default=100.0, gt=0, le=1000)
    read_deadline_ms: float = Field(default=3.0, gt=0, le=100)
    fast_read: Literal["auto", "on", "off"] = "auto"
    watchdog_ms: int = Field(default=200, ge=0, le=2540)
    stagger_ms: float = Field(default=5.0, ge=0, le=1000)
    reconnect_s: Positive = 30.0
    rs485: Literal["rts", "kernel"] | None = None
    crc: Annotated[bool, AfterValidator(_crc)] = False
