"""How gentle a joint is, and what happens when its servo reports a fault: `safety` and `faults` of a head's file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StrictInt, model_validator

from sfms_robot.config.base import Finite, Model, Name, Positive

FaultPolicy = Literal["hold", "limp", "reduce", "reboot_and_ease_in"]
MEASURED_FAULTS = ("input voltage", "overheating")  # those a threshold may be given for


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
        halt: in an emergency stop, once the joint stands: torque off, or kept. By default joints of the neck, which
            bear its weight, keep it.
        warm_C, hot_C: temperature from which the joint moves half as far, and from which it stays at rest.
        registers: raw values written before torque comes on: gains, profiles and the like (`register_rules`).
        stored: raw values that have to be stored in the servo; compared before torque comes on, never written.
    """

    current_limit_mA: Positive | None = None
    torque_limit_percent: Annotated[float, Field(gt=0, le=100)] | None = None
    on_fault: FaultPolicy = "limp"
    pinch: LoadRule | None = None
    strain: LoadRule | None = None
    stop: Literal["release", "hold"] = "release"
    halt: Literal["release", "hold"] | None = None
    warm_C: Positive = 60.0
    hot_C: Positive = 67.0
    registers: dict[Name, StrictInt] = Field(default_factory=dict)
    stored: dict[Name, StrictInt] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _hot_is_warmer(self) -> Safety:
        if self.hot_C <= self.warm_C:
            raise ValueError(f"hot_C: {self.hot_C:g} is not above warm_C ({self.warm_C:g})")
        return self

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
