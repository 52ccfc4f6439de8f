"""A head: joints, the servos that move them, how far and fast they may go, and what drives them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr, model_validator

from sfms_robot.config.base import Finite, Model, Name, NonNegative, Positive, load
from sfms_robot.config.drives import expanded, problems
from sfms_robot.config.kinematics import Kinematics
from sfms_robot.config.kinematics import problems as neck_problems
from sfms_robot.config.life import Life
from sfms_robot.config.mapping import Coupling, Expression, Fold, Region
from sfms_robot.data import find

FaultPolicy = Literal["hold", "limp", "reduce", "reboot_and_ease_in"]
MEASURED_FAULTS = ("input voltage", "overheating")  # those a threshold may be given for


class Bus(Model):
    """One named bus of a head.

    `read_deadline_ms` is the silence that makes a servo silent. `fast_read`: all servos answer in one packet; "auto"
    tries it at start. `watchdog_ms` 0 leaves the servos' own watchdog off. `stagger_ms` lies between two servos whose
    torque comes on. A bus on which nobody answers for `reconnect_s` has failed. `rs485`: who switches the direction of
    a half-duplex RS-485 driver, the program by the RTS line (rts) or the driver (kernel); none for adapters that do.
    """

    family: Literal["dynamixel", "dynamixel1", "feetech", "maestro", "ssc32"]
    baud: Annotated[int, Field(gt=0)]
    rate_hz: Positive = 100.0
    read_deadline_ms: Positive = 3.0
    fast_read: Literal["auto", "on", "off"] = "auto"
    watchdog_ms: Annotated[int, Field(ge=0, le=2540)] = 200
    stagger_ms: NonNegative = 5.0
    reconnect_s: Positive = 30.0
    rs485: Literal["rts", "kernel"] | None = None

    @model_validator(mode="before")
    @classmethod
    def _yaml_switch(cls, value: Any) -> Any:
        """YAML reads a bare `on` and `off` as true and false."""
        if isinstance(value, dict) and isinstance(fast := value.get("fast_read"), bool):
            return {**value, "fast_read": "on" if fast else "off"}
        return value


class LoadRule(Model):
    """A present current above `current_mA` for `for_s` without a break, and what then happens to the joint."""

    current_mA: Positive
    for_s: Positive
    then: Literal["hold", "limp", "reduce"] = "limp"


class Safety(Model):
    """How gentle a joint is, and what happens when its servo reports a fault.

    Attributes:
        current_limit_mA: the servo never pushes harder; needs a servo with a current sensor.
        torque_limit_percent: of the servo's full torque (its voltage, to be exact); for those without such a sensor.
        on_fault: hold where it is, limp (torque off), reduce (half the force), or reboot and ease in again.
        pinch: something is in the way. By default 60 % of the servo's own current limit for half a second: limp.
        strain: a pose that takes force for long heats the servo and makes it sing. Off by default.
        stop: at the end of a run, once at rest: torque off, or kept.
        registers: raw values written before torque comes on, such as gains.
    """

    current_limit_mA: Positive | None = None
    torque_limit_percent: Annotated[float, Field(gt=0, le=100)] | None = None
    on_fault: FaultPolicy = "limp"
    pinch: LoadRule | None = None
    strain: LoadRule | None = None
    stop: Literal["release", "hold"] = "release"
    registers: dict[Name, int] = Field(default_factory=dict)

    def merged(self, other: Safety | None) -> Safety:
        """This, and over it what `other` gives explicitly."""
        return self if other is None else self.model_copy(update={k: getattr(other, k) for k in other.model_fields_set})


class Threshold(Model):
    """A fault counts only when what it is about lies outside min..max (V for voltage, degC for heat)."""

    min: Finite | None = None
    max: Finite | None = None


class Faults(Model):
    """Which of the servos' faults are acted upon, by the names in the firmware map."""

    mask: tuple[str, ...] = ()
    thresholds: dict[str, Threshold] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _measurable(self) -> Faults:
        for name in self.thresholds:
            if name not in MEASURED_FAULTS:
                raise ValueError(f"thresholds.{name} is about nothing that is measured ({', '.join(MEASURED_FAULTS)})")
        return self


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
    lag_ms: NonNegative = 0.0
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
    lag_ms: NonNegative | None = None
    unit: Literal["range", "rad"] | None = None


class Head(Model):
    """A head: `configs/heads/NAME/head.yaml`.

    `calibrate_first`: zeros and ranges differ from build to build, so that on real servos the head moves little and
    slowly until somebody has measured them.
    """

    name: Name
    description: str
    calibrate_first: bool = False
    buses: Annotated[dict[Name, Bus], Field(min_length=1)]
    limits: dict[Name, LimitClass]
    safety: Safety = Safety()
    faults: Faults = Faults()
    joint_defaults: JointDefaults = JointDefaults()
    joints: Annotated[dict[Name, Joint], Field(min_length=1)]
    expressions: dict[Name, Expression] = Field(default_factory=dict)
    couplings: tuple[Coupling, ...] = ()
    folds: tuple[Fold, ...] = ()
    regions: dict[Name, Region] = Field(default_factory=dict)
    kinematics: Kinematics | None = None
    life: Life = Life()
    _folder: Path | None = PrivateAttr(None)

    @property
    def folder(self) -> Path | None:
        """Where its file lies; None for a head that was made otherwise."""
        return self._folder

    @model_validator(mode="before")
    @classmethod
    def _expanded(cls, value: Any) -> Any:
        return expanded(value)

    @model_validator(mode="after")
    def _consistent(self) -> Head:
        found = wiring(self.joints, self.buses, self.limits)
        found += problems(self.joints, self.expressions, self.couplings, self.folds, self.regions)
        if self.kinematics is not None:
            found += neck_problems(self.kinematics, self.joints, self.folds)
        if found:
            more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
            raise ValueError(found[0] + more)
        return self

    def safety_of(self, joint: str) -> Safety:
        return self.safety.merged(self.joints[joint].safety)

    def limit(self, joint: str) -> LimitClass:
        return self.limits[self.joints[joint].limits]


def wiring(joints: Mapping[str, Joint | None], buses: Collection[str], limits: Collection[str]) -> list[str]:
    """Every joint that is on no bus, of no limit class, or on another's id, one line each."""
    found: list[str] = []
    seen: dict[tuple[str, int], str] = {}
    for name, joint in joints.items():
        if joint is None:
            continue
        if joint.bus not in buses:
            found.append(f"joints.{name}.bus = {joint.bus!r} is not a bus of this head ({', '.join(buses)})")
        if joint.limits not in limits:
            found.append(f"joints.{name}.limits = {joint.limits!r} is not a limit class ({', '.join(limits)})")
        other = seen.setdefault((joint.bus, joint.id), name)
        if other != name:
            found.append(f"joints.{name}.id = {joint.id} is used twice on bus {joint.bus!r} (also by {other})")
    return found


def load_head(name: str) -> Head:
    """A head by shipped name or folder."""
    folder = find("heads", name, "head.yaml")
    head = load(Head, folder / "head.yaml")
    head._folder = folder
    return head
