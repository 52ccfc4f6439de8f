"""Commands on a run from any thread: the scale of each region of its head, rates of events, faces, halt and end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from threading import RLock
from typing import TYPE_CHECKING, Final

from sfms_robot.app.options import RunOptions, values_by_name
from sfms_robot.config import Calmness, Head, parse
from sfms_robot.errors import InputError
from sfms_robot.ports import Document, Facts
from sfms_robot.retarget.channel_mapping import ChannelMapping
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.retarget.puppet import Puppet
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.safety import Interrupt

if TYPE_CHECKING:
    from sfms_robot.sources.net_person import PageVisitor
    from sfms_robot.sources.push import Spoken

STEP: Final = 0.1  # change of intensity by one key press
MOST: Final = 2.0


@dataclass(eq=False)
class Knob:
    """The `intensity` and `style` of one region, 0..2; 1 changes nothing. A new value holds from the next tick on.

    Setting raises InputError for a value outside 0..2.
    """

    _knobs: LiveKnobs
    _region: str

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
    """The knobs of a head's regions by name. May be set from any thread.

    Args:
        intensity, style: of `--intensity REGION=V` and `--style REGION=V`; they replace values of the head's file.

    Raises ConfigError for an unknown region or a value outside 0..2.

    Attributes:
        values: region -> value, for "intensity" and for "style".
        now: the knobs that the loop reads at every tick.
    """

    def __init__(self, head: Head, intensity: Sequence[str] = (), style: Sequence[str] = ()) -> None:
        self._face = ChannelMapping(head)
        self._lock = RLock()
        self.values = {
            kind: {name: float(getattr(region, kind)) for name, region in head.regions.items()}
            for kind in ("intensity", "style")
        }
        self.turn(values_by_name("--intensity", intensity), values_by_name("--style", style))

    def turn(self, intensity: Mapping[str, float], style: Mapping[str, float]) -> None:
        """Set values of regions. Raises InputError, changing nothing, for an unknown region or a value outside 0..2."""
        given = {"intensity": intensity, "style": style}
        with self._lock:
            values = {kind: {**self.values[kind], **regions} for kind, regions in given.items()}
            self.values, self.now = values, self._face.knobs(**values)

    def turn_all(self, by: float) -> None:
        """Change the intensity of every region by `by`, within 0..2."""
        with self._lock:
            now = self.values["intensity"].items()
            self.turn({name: round(min(max(at + by, 0.0), MOST), 3) for name, at in now}, {})

    def __getitem__(self, region: str) -> Knob:
        """Return the knob of a region. Raises InputError for an unknown region."""
        if region not in self.values["style"]:
            raise InputError(f"{region!r} is not a region of this head ({', '.join(self) or 'none'})")
        return Knob(self, region)

    def __iter__(self) -> Iterator[str]:
        return iter(self.values["style"])

    def __len__(self) -> int:
        return len(self.values["style"])


# --- commands on a run from other threads -----------------------------------------------------------------------------


class RunControls:
    """Commands on a run from any thread: a page, a fleet, keys, a program. Motion stays under the head's limits.

    Attributes:
        interrupt: ends the run.
        halt: emergency stop.
        knobs: scale of each region.
        puppet: faces that replace the listener's plan for a while.
        calmness: rates of events.
        set_rates: sets the rates of the listener; None: the listener has not begun, or time is virtual.
        visitor: the person in front of a page. speech: the speech that a program lets the robot say.
        document: returns the status of the run; an empty one before it begins.
    """

    def __init__(self, head: Head, options: RunOptions) -> None:
        self.interrupt, self.halt = Interrupt(), HaltLatch()
        self.knobs = LiveKnobs(head, options.intensity, options.style)
        self.puppet = Puppet(head.life.gaze, frozenset(HeadRetargeter(head).blind_channels))
        self.calmness = options.calmness or Calmness()
        self.set_rates: Callable[[Calmness], None] | None = None
        self.document: Document = dict
        self.visitor: PageVisitor | None = None
        self.speech: Spoken | None = None

    def calm(self, rates: Facts) -> None:
        """Set rates of events per minute; the others stay. Raises ConfigError for an unknown kind or a bad rate."""
        self.calmness = parse(Calmness, {**self.calmness.model_dump(), **rates}, "calm")
        if self.set_rates is not None:
            self.set_rates(self.calmness)

    def release(self) -> None:
        """Switch torque off at once, as a second Ctrl-C does; this also ends the run."""
        self.interrupt.ask()
        self.interrupt.ask()
