"""Those who look on. One that raises is detached and named once: looking on never ends a run."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from sfms_robot.frames import Plan, Reading, SpeakerFrame
from sfms_robot.ports import Observer, Tick
from sfms_robot.runtime.states import RunState
from sfms_robot.signals.audio import energy_db

log = logging.getLogger(__name__)


class Observers:
    """Hands what happens to every `ports.Observer`, in order.

    Attributes:
        detached: name of each that raised, and what.
    """

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._attached = list(observers)
        self.detached: dict[str, str] = {}

    def tick(self, seen: Tick) -> None:
        self._each(lambda observer: observer.tick(seen))

    def heard(self, frame: SpeakerFrame) -> None:
        self._each(lambda observer: observer.heard(frame))

    def planned(self, plan: Plan) -> None:
        self._each(lambda observer: observer.planned(plan))

    def _each(self, tell: Callable[[Observer], None]) -> None:
        for observer in tuple(self._attached):
            try:
                tell(observer)
            except Exception as error:
                self._attached.remove(observer)
                name = type(observer).__name__
                self.detached[name] = f"{type(error).__name__}: {error}"
                log.warning("%s raised and is detached: %s", name, self.detached[name], exc_info=True)


# --- Status of a run --------------------------------------------------------------------------------------------------
#
# The state of a run at this moment, as one document: for the terminal's panel, `--status` and the page. An observer
# that keeps the newest of everything; the document is put together on request, in the requesting thread. The loop
# pays for three assignments a tick.

_DIGITS: Final = 4
_SAID: Final[Mapping[str, str]] = {
    "starting": "joints are led into the face",
    "idle": "nobody is seen or heard: the listener's answers are not shown",
    "halted": "halted: nothing is followed until every cause is cleared",
    "stopping": "the head comes to rest",
}


class RunStatus:
    """`ports.Observer`.

    Args:
        joints: names, in the order of `Tick.goals_rad`.
        facts: what never changes, such as head and port.
        figures: what else the document holds, asked for every time.
    """

    def __init__(
        self,
        joints: Sequence[str],
        facts: Mapping[str, Any],
        figures: Callable[[], Mapping[str, Any]] | None = None,
    ) -> None:
        self._joints = tuple(joints)
        self._facts = dict(facts)
        self._figures = figures
        self._tick: Tick | None = None
        self._ended: dict[str, Any] = {}
        self._frame: SpeakerFrame | None = None
        self._planned_s: float | None = None

    def tick(self, seen: Tick) -> None:
        self._tick = seen

    def heard(self, frame: SpeakerFrame) -> None:
        self._frame = frame

    def planned(self, plan: Plan) -> None:
        self._planned_s = plan.made_at_s

    def ended(self, state: RunState) -> None:
        """Show the last state of the run from now on: torque is off, or could not be confirmed off."""
        self._ended = {"state": state.name, "why": list(state.why)}

    def close(self) -> None:
        """Nothing is open."""

    def document(self) -> dict[str, Any]:
        """What `--status` serves. From any thread; JSON has no inf and no NaN: null."""
        seen, frame = self._tick, self._frame
        document: dict[str, Any] = {
            "version": 1,
            **self._facts,
            "state": "starting",
            "why": [],
            "torque_unconfirmed": [],
            "time_s": 0.0,
        }
        if seen is not None:
            document |= {"state": seen.state, "why": list(seen.why), "time_s": _number(seen.time_s)}
            document |= _servos(seen, self._joints)
        document |= self._ended
        document["note"] = _note(document["state"], document["why"])
        document["person"] = _person(frame)
        document["planned_s"] = self._planned_s
        return document | dict(self._figures() if self._figures else {})


def _note(state: str, why: list[str]) -> str | None:
    """Why something is not followed, in words; None where all is."""
    if state == "degraded":
        return f"goes on without {', '.join(why)}"
    if state == "fault":
        return "; ".join(why)
    return _SAID.get(state)


def _person(frame: SpeakerFrame | None) -> dict[str, Any]:
    """What the newest frame holds of the person, and of the robot's own voice."""
    if frame is None:
        return {"voice_db": None, "seen": False, "attention": None, "own_voice_db": None}
    return {
        "voice_db": round(energy_db(frame.audio), 1) if len(frame.audio) else None,
        "seen": frame.face is not None,
        "attention": None if frame.attention is None else _number(frame.attention),
        "own_voice_db": None if frame.agent_audio is None else round(energy_db(frame.agent_audio), 1),
    }


def _servos(seen: Tick, names: Sequence[str]) -> dict[str, Any]:
    """Joints, faults by name, and the hottest servo."""
    joints = {
        joint: _joint(goal_rad, seen.readings[joint])
        for joint, goal_rad in zip(names, seen.goals_rad.tolist(), strict=True)
        if joint in seen.readings
    }
    warmth = {joint: reading.extra.get("temperature_C", math.nan) for joint, reading in seen.readings.items()}
    known = {joint: degrees for joint, degrees in warmth.items() if math.isfinite(degrees)}
    hottest = max(known, key=lambda joint: known[joint], default=None)
    return {
        "joints": joints,
        "faults": {joint: reading.fault for joint, reading in seen.readings.items() if reading.fault},
        "hottest": None if hottest is None else {"joint": hottest, "temperature_C": _number(known[hottest])},
    }


def _joint(goal_rad: float, reading: Reading) -> dict[str, Any]:
    present = None if reading.position_rad is None else _number(reading.position_rad)
    extra = {name: _number(value) for name, value in reading.extra.items()}
    return {"goal_rad": _number(goal_rad), "present_rad": present, "age_s": _number(reading.age_s), **extra}


def _number(value: float) -> float | None:
    return round(float(value), _DIGITS) if math.isfinite(value) else None
