"""`--intensity` and `--style` REGION=V -> the knobs of a head; `--calmness` KIND=V -> what it does how often."""

from __future__ import annotations

from collections.abc import Sequence

from sfms_robot.config import Calmness, parse
from sfms_robot.errors import ConfigError
from sfms_robot.retarget.channel_mapping import Knobs
from sfms_robot.retarget.head_retargeter import HeadRetargeter


def turned(retargeter: HeadRetargeter, intensity: Sequence[str] = (), style: Sequence[str] = ()) -> Knobs:
    """Knobs over those of the head's file. Raises ConfigError for an unknown region or a value outside 0..2."""
    return retargeter.mapping.knobs(_values("--intensity", intensity), _values("--style", style))


def calmed(per_minute: Sequence[str] = (), addressed: str = "sense") -> Calmness:
    """What `--calmness` and `--addressed` ask for. Raises ConfigError for an unknown kind or a rate that cannot be."""
    asked = _values("--calmness", per_minute, "KIND=EVENTS A MINUTE")
    return parse(Calmness, {**asked, "addressed": addressed}, "--calmness")


def _values(option: str, given: Sequence[str], form: str = "REGION=VALUE with a value from 0 to 2") -> dict[str, float]:
    values = {}
    for text in given:
        region, _, value = text.partition("=")
        try:
            values[region] = float(value)
        except ValueError:
            raise ConfigError(f"{option} {text!r} is not {form}") from None
    return values
