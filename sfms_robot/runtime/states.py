"""The states of a run and the arrows between them.

    starting        torque comes on, joints ease in
    idle            no person is there: the head moves a little, and answers nothing
    listening       a person is there
    speaking        the robot's own voice is being played
    degraded        it continues without something: `why` names it
    halted          emergency stop, latched: `why` names every cause; ends when none is left
    stopping        it comes to rest
    stopped, fault  torque is off: as asked, or by an error that `why` names, or could not be confirmed off

One state after the other is a value (`RunState`); the facts of an instant are another (`Situation`).
The table of every arrow, its cause and its longest time is in docs/safety.md; `ARROWS` is the same table, and no other
arrow is ever taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

Activity = Literal["idle", "listening", "speaking"]
StateName = Literal[
    "starting", "idle", "listening", "speaking", "degraded", "halted", "stopping", "stopped", "fault"
]  # fmt: skip

_RUNNING: Final[tuple[StateName, ...]] = ("idle", "listening", "speaking", "degraded")
_MOVING: Final[tuple[StateName, ...]] = ("starting", *_RUNNING)
ARROWS: Final[frozenset[tuple[StateName, StateName]]] = frozenset(
    [(a, b) for a in _MOVING for b in _RUNNING if a != b]
    + [(a, "halted") for a in _MOVING]
    + [("halted", "starting")]
    + [(a, "stopping") for a in (*_MOVING, "halted")]
    + [("stopping", "stopped"), ("stopping", "fault")]
)


@dataclass(frozen=True)
class RunState:
    """A state and since when [s, loop time].

    Attributes:
        why: what is lost, what halts it, or the error; empty where nothing is to be said.
        doing: what it would be doing if nothing were lost.
    """

    name: StateName = "starting"
    since_s: float = 0.0
    why: tuple[str, ...] = ()
    doing: Activity = "idle"

    def ended(self, now_s: float, error: str | None = None) -> RunState:
        """Torque is off. Only after `stopping`."""
        return RunState("stopped" if error is None else "fault", now_s, () if error is None else (error,), self.doing)


@dataclass(frozen=True)
class Situation:
    """The facts of an instant.

    Attributes:
        eased_in: every joint has been led from where it was found into the face.
        person: a person is there.
        speaking: the robot's own voice is being played.
        lost: sources, "listener" and joints that the run continues without.
        halted: causes of an emergency stop, while it is latched.
        ending: the run is on its way to rest.
    """

    eased_in: bool = True
    person: bool = False
    speaking: bool = False
    lost: tuple[str, ...] = ()
    halted: tuple[str, ...] = ()
    ending: bool = False


def following(state: RunState, now: Situation, now_s: float) -> RunState:
    """The state at `now_s`; `since_s` moves when the name does."""
    if state.name in ("stopped", "fault"):
        return state
    doing: Activity = "speaking" if now.speaking else "listening" if now.person else "idle"
    name, why = _name(state, now, doing)
    if name == state.name:
        return state if (why, doing) == (state.why, state.doing) else replace(state, why=why, doing=doing)
    return RunState(name, now_s, why, doing)


def _name(state: RunState, now: Situation, doing: Activity) -> tuple[StateName, tuple[str, ...]]:
    if now.ending or state.name == "stopping":
        return "stopping", ()
    if now.halted:
        return "halted", now.halted
    if state.name == "halted" or (state.name == "starting" and not now.eased_in):
        return "starting", ()
    return ("degraded", now.lost) if now.lost else (doing, ())
