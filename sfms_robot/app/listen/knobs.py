"""The scale of each region of a head, set while it runs; `--intensity`, `--style` and `--calmness` of a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from threading import RLock
from typing import Final, get_args

from sfms_robot.config import Calmness, Head, parse
from sfms_robot.errors import ConfigError, InputError
from sfms_robot.frames import EVENT_KINDS
from sfms_robot.retarget.channel_mapping import ChannelMapping as Face
from sfms_robot.retarget.channel_mapping import Knobs

STEP: Final = 0.1  # of a key
MOST: Final = 2.0
ADDRESSED: Final[tuple[str, ...]] = get_args(Calmness.model_fields["addressed"].annotation)


class Knob:
    """The `intensity` and `style` of one region, 0..2; 1 changes nothing. A new value holds from the next tick on.

    Setting raises InputError for a value outside 0..2.
    """

    def __init__(self, knobs: LiveKnobs, region: str) -> None:
        self._knobs, self._region = knobs, region

    @property
    def intensity(self) -> float:
        """Scale of all motion: 0 nothing, 1 as mapped, 2 twice, within the range of every joint."""
        return self._knobs.values["intensity"][self._region]

    @intensity.setter
    def intensity(self, value: float) -> None:
        self._knobs.turn({self._region: value}, {})

    @property
    def style(self) -> float:
        """Scale of small motion: 0 it vanishes, 1 as mapped, 2 doubled; large motion is unchanged."""
        return self._knobs.values["style"][self._region]

    @style.setter
    def style(self, value: float) -> None:
        self._knobs.turn({}, {self._region: value})

    def __repr__(self) -> str:
        return f"Knob({self._region!r}, intensity={self.intensity:g}, style={self.style:g})"


class LiveKnobs:
    """The regions of a head by name. May be set from any thread.

    Attributes:
        values: region -> value, of "intensity" and of "style".
        now: what the loop reads at every tick.
    """

    def __init__(self, head: Head, intensity: Mapping[str, float], style: Mapping[str, float]) -> None:
        self._face = Face(head)
        self._lock = RLock()
        self.values: dict[str, dict[str, float]] = {
            kind: {name: float(getattr(region, kind)) for name, region in head.regions.items()}
            for kind in ("intensity", "style")
        }
        self.now: Knobs = self._face.knobs()
        self.turn(intensity, style)

    def turn(self, intensity: Mapping[str, float], style: Mapping[str, float]) -> None:
        """Set values of regions. Raises InputError, with nothing changed, for an unknown region or one outside 0..2."""
        given = {"intensity": intensity, "style": style}
        for kind, regions in given.items():
            for region, value in regions.items():
                self[region]
                if not 0 <= value <= MOST:
                    raise InputError(f"{kind} of {region} = {value:g} is not in 0..2")
        with self._lock:
            values = {kind: {**self.values[kind], **regions} for kind, regions in given.items()}
            self.values, self.now = values, self._face.knobs(**values)

    def turn_all(self, by: float) -> None:
        """Change the intensity of every region by `by`; none leaves 0..2."""
        with self._lock:
            now = self.values["intensity"].items()
            self.turn({name: round(min(max(at + by, 0.0), MOST), 3) for name, at in now}, {})

    def __getitem__(self, region: str) -> Knob:
        """Return a region. Raises InputError for a name that is not one."""
        if region not in self.values["style"]:
            raise InputError(f"{region!r} is not a region of this head ({', '.join(self) or 'none'})")
        return Knob(self, region)

    def __iter__(self) -> Iterator[str]:
        return iter(self.values["style"])

    def __len__(self) -> int:
        return len(self.values["style"])


def turned(head: Head, intensity: Sequence[str] = (), style: Sequence[str] = ()) -> LiveKnobs:
    """Return the knobs after `--intensity REGION=V` and `--style REGION=V`, which replace values of the head's file.

    Raises ConfigError for an unknown region or a value outside 0..2.
    """
    return LiveKnobs(head, _values("--intensity", intensity), _values("--style", style))


def calmed(per_minute: Sequence[str] = (), addressed: str = "sense") -> Calmness:
    """Return the rates of `--calmness` and `--addressed`. Raises ConfigError for an unknown kind or an invalid rate."""
    rates = _values("--calmness", per_minute, "KIND=EVENTS A MINUTE")
    if unknown := [kind for kind in rates if kind not in EVENT_KINDS]:
        raise ConfigError(f"--calmness {unknown[0]}: no kind of event ({', '.join(EVENT_KINDS)})")
    if addressed not in ADDRESSED:
        raise ConfigError(f"--addressed {addressed}: none of {', '.join(ADDRESSED)}")
    return parse(Calmness, {**rates, "addressed": addressed}, "--calmness")


def _values(option: str, given: Sequence[str], form: str = "REGION=VALUE with a value from 0 to 2") -> dict[str, float]:
    values = {}
    for text in given:
        region, _, value = text.partition("=")
        try:
            values[region] = float(value)
        except ValueError:
            raise ConfigError(f"{option} {text!r} is not {form}") from None
    return values
