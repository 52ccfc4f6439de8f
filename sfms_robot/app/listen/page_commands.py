"""What visitors of the page ask of a run, done: through the limits, as everything is.

Called in the page's thread. What a visitor asks for wrongly is raised as RobotError, and told to that visitor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfms_robot.app.listen.knobs import KNOB_KINDS, LiveKnobs
from sfms_robot.config import Calmness, parse
from sfms_robot.errors import InputError
from sfms_robot.frames import MOTION_DIM
from sfms_robot.retarget.puppet import Puppet
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.sources.browser import Visitor
from sfms_robot.viewer.visitor_commands import Command

BY_PAGE: Final = "page"  # a cause, and its door


def _both(**values: float) -> dict[str, float]:
    """Return the values of pairs of channels, left and right."""
    return {f"{name}{side}": value for name, value in values.items() for side in ("Left", "Right")}


# Faces by name, for buttons of a page: channels of `frames.CHANNELS`, everything else is left to the listener.
NAMED_EXPRESSIONS: Final[Mapping[str, Mapping[str, float]]] = {
    "smile": _both(mouthSmile=0.8, cheekSquint=0.4, eyeSquint=0.2),
    "laugh": {**_both(mouthSmile=1.0, cheekSquint=0.8, eyeSquint=0.5), "jawOpen": 0.35, "pitch": -0.08},
    "surprise": {**_both(browOuterUp=0.9, eyeWide=0.9), "browInnerUp": 0.9, "jawOpen": 0.4},
    "doubt": {"browDownLeft": 0.6, "browOuterUpRight": 0.8, "mouthLeft": 0.4, "roll": 0.12},
    "frown": _both(browDown=0.9, eyeSquint=0.3, mouthFrown=0.3),
    "sad": {**_both(mouthFrown=0.8), "browInnerUp": 0.8, "mouthShrugLower": 0.4, "pitch": 0.15},
    "disgust": _both(noseSneer=0.9, mouthUpperUp=0.6, browDown=0.5, eyeSquint=0.4),
    "kiss": {"mouthPucker": 0.9, "mouthFunnel": 0.2},
    "wink": {"eyeBlinkLeft": 1.0, "cheekSquintLeft": 0.6, "mouthSmileLeft": 0.5},
    "eyes closed": _both(eyeBlink=1.0),
}


@dataclass
class Reach:
    """What a page may reach of a run that goes on.

    Attributes:
        calm: sets how often the listener does what.
        record: begins a recording, or ends it.
        release: torque off at once, as a second Ctrl-C does; the run ends with it.
    """

    halt: HaltLatch
    puppet: Puppet
    knobs: LiveKnobs
    calmness: Calmness
    calm: Callable[[Calmness], None]
    record: Callable[[bool], None]
    release: Callable[[], None]


class PageCommands:
    """`page_process.Asked` of a page, whatever runs behind it.

    Args:
        choose: another listener, speaker or seed, by the command's name.
        feeds: what a visitor, by number, is going to bring of the person.
        person: who takes it.

    Attributes:
        reach: the run that goes on; None: there is none.
    """

    def __init__(
        self, choose: Callable[[str, Any], None], feeds: Callable[[int, list[str]], None], person: Visitor
    ) -> None:
        self.reach: Reach | None = None
        self._choose, self._feeds, self._person = choose, feeds, person

    def command(self, visitor: int, command: Command) -> None:
        values = command.values
        if command.name in ("listener", "speaker"):
            self._choose(command.name, values["name"])
        elif command.name == "seed":
            self._choose(command.name, values["seed"])
        elif command.name == "source":
            self._feeds(visitor, values["feeds"])
        elif self.reach is None:
            raise InputError(f"{command.name}: no run is on")
        else:
            _DO[command.name](self.reach, values)

    def person(self, visitor: int, message: bytes) -> None:
        self._person.received(visitor, message)

    def left(self, visitor: int) -> None:
        self._person.gone(visitor)


def _express(reach: Reach, name: str, seconds: float) -> None:
    if name not in NAMED_EXPRESSIONS:
        raise InputError(f"expression {name!r} is not there ({', '.join(NAMED_EXPRESSIONS)})")
    reach.puppet.show(NAMED_EXPRESSIONS[name], seconds)


def _turn(reach: Reach, values: Mapping[str, Mapping[str, float]]) -> None:
    for kind in KNOB_KINDS:
        for region, value in values[kind].items():
            setattr(reach.knobs[region], kind, value)


def _calm(reach: Reach, rates: Mapping[str, float | None]) -> None:
    reach.calmness = parse(Calmness, {**reach.calmness.model_dump(), **rates}, "calm")
    reach.calm(reach.calmness)


_DO: Final[Mapping[str, Callable[[Reach, Mapping[str, Any]], None]]] = {
    "halt": lambda reach, values: reach.halt.close(BY_PAGE, BY_PAGE),
    "resume": lambda reach, values: reach.halt.resume(BY_PAGE),
    "release": lambda reach, values: reach.release(),
    "neutral": lambda reach, values: reach.puppet.show(np.zeros(MOTION_DIM, np.float32), values["seconds"]),
    "show": lambda reach, values: reach.puppet.show(values["channels"], values["seconds"]),
    "expression": lambda reach, values: _express(reach, values["name"], values["seconds"]),
    "look_at": lambda reach, values: reach.puppet.look_at(**values),
    "knobs": lambda reach, values: _turn(reach, values),
    "calm": lambda reach, values: _calm(reach, values["rates"]),
    "record": lambda reach, values: reach.record(values["on"]),
}
