"""The states of a run, the arrows between them, and the presence of a person, which decides some of them.

    starting        torque comes on, joints ease in
    idle            no person is there: the head moves a little, and answers nothing
    listening       a person is there
    speaking        the robot's own voice is being played
    degraded        it continues without something: `why` names it
    halted          emergency stop, latched: `why` names every cause; ends when none is left
    stopping        it comes to rest
    stopped, fault  torque is off: as asked, or by an error that `why` names, or could not be confirmed off

A state is a value. The table of every arrow, its cause and its longest time is in docs/safety.md; `ARROWS` is the same
table, and no other arrow is ever taken.

A person is there while a face is seen or a voice was heard within `GONE_S`. The robot speaks while its own voice, as it
is being played, has sound, pauses between words included: neither a text nor the person's words end its turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, Literal

from sfms_robot.data import Names
from sfms_robot.frames import Doubles, SpeakerFrame
from sfms_robot.ports import Watched
from sfms_robot.signals import voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.signals.minimum_jerk import ease
from sfms_robot.signals.voice_activity import Ear

GONE_S: Final = 10.0  # neither seen nor heard for so long
LOST_S: Final = 0.5  # without sound or face from any source
TURN_GAP_S: Final = 0.6  # a pause between the robot's own words
SAYS_DB: Final = -45.0  # the played signal is clean: anything louder is speech
FADE_S: Final = 0.5  # of the listener's answer, when a person comes or goes
_NEVER_S: Final = -float("inf")

Activity = Literal["idle", "listening", "speaking"]
StateName = Literal[
    "starting", "idle", "listening", "speaking", "degraded", "halted", "stopping", "stopped", "fault"
]  # fmt: skip

RUNNING: Final = ("idle", "listening", "speaking", "degraded")
_MOVING: Final = ("starting", *RUNNING)
ARROWS: Final = frozenset(
    [(a, b) for a in _MOVING for b in RUNNING if a != b]
    + [(a, "halted") for a in _MOVING]
    + [("halted", "starting")]
    + [(a, "stopping") for a in (*_MOVING, "halted")]
    + [("stopping", "stopped"), ("stopping", "fault")]
)


@dataclass(frozen=True)
class RunState:
    """A state and since when [s, loop time].

    Attributes:
        why: the lost parts, the causes of a halt, or the error; empty otherwise.
        doing: its activity if nothing were lost.
    """

    name: StateName = "starting"
    since_s: float = 0.0
    why: Names = ()
    doing: Activity = "idle"

    def then(
        self,
        now_s: float,
        *,
        eased_in: bool = True,
        person: bool = False,
        speaking: bool = False,
        lost: Names = (),
        halted: Names = (),
        ending: bool = False,
    ) -> RunState:
        """Return the state at `now_s`; `since_s` changes with the name.

        Args:
            now_s: loop time.
            eased_in: every joint has been led from where it was found into the face.
            person: a person is there.
            speaking: the robot's own voice is being played.
            lost: sources, "listener" and joints that the run continues without.
            halted: causes of an emergency stop, while it is latched.
            ending: the run is on its way to rest.
        """
        if self.name in ("stopped", "fault"):
            return self
        doing: Activity = "speaking" if speaking else "listening" if person else "idle"
        name: StateName
        why: Names
        if ending or self.name == "stopping":
            name, why = "stopping", ()
        elif halted:
            name, why = "halted", halted
        elif self.name == "halted" or (self.name == "starting" and not eased_in):
            name, why = "starting", ()
        else:
            name, why = ("degraded", lost) if lost else (doing, ())
        return RunState(name, self.since_s if name == self.name else now_s, why, doing)

    def ended(self, now_s: float, error: str | None = None) -> RunState:
        """Return the state after torque went off; only after `stopping`."""
        return RunState("stopped" if error is None else "fault", now_s, () if error is None else (error,), self.doing)


@dataclass(frozen=True)
class Presence:
    """The memory of a person between frames of 40 ms.

    Attributes:
        ear: the person's voice activity.
        watched: their last sighting, and the last sound of the robot itself.
        heard_s: time of their last voice.
        sensed_s: time of the last input, silence included.
    """

    ear: Ear = field(default_factory=voice_activity.start)
    watched: Watched = Watched()
    heard_s: float = _NEVER_S
    sensed_s: float = _NEVER_S

    def after(self, frame: SpeakerFrame) -> Presence:
        """Return the presence one frame later. A frame without a face leaves the last sighting in place."""
        ear = voice_activity.step(energy_db(frame.audio), self.ear) if len(frame.audio) else self.ear
        watched = self.watched
        if frame.agent_audio is not None and energy_db(frame.agent_audio) > SAYS_DB:
            watched = replace(watched, said_s=frame.time_s)
        if frame.face is not None:
            watched = replace(watched, seen_s=frame.face.time_s, place_m=frame.place_m, attention=frame.attention)
        heard = len(frame.audio) > 0 and ear.active
        sensed = len(frame.audio) > 0 or frame.face is not None
        return Presence(
            ear, watched, frame.time_s if heard else self.heard_s, frame.time_s if sensed else self.sensed_s
        )

    def person(self, now_s: float) -> bool:
        """Return whether a person is there."""
        seen_s = _NEVER_S if self.watched.seen_s is None else self.watched.seen_s
        return now_s - max(seen_s, self.heard_s) <= GONE_S

    def answered(self, now_s: float) -> bool:
        """Return whether the plans of the listener show: a person is there and sensed, or the robot speaks."""
        return self.speaking(now_s) or (self.person(now_s) and now_s - self.sensed_s <= LOST_S)

    def speaking(self, now_s: float) -> bool:
        """Return whether the robot's own voice is being played."""
        return now_s - self.watched.said_s <= TURN_GAP_S


@dataclass(frozen=True)
class Fade:
    """The share of the listener's answer that shows: from `before` to `after`, from `since_s` on for `FADE_S`."""

    before: float = 0.0
    after: float = 0.0
    since_s: float = 0.0

    def at(self, times_s: Doubles) -> Doubles:
        """Return the share (N,) at (N,) instants."""
        return self.before + (self.after - self.before) * ease((times_s - self.since_s) / FADE_S)

    def toward(self, share: float, times_s: Doubles) -> Fade:
        """Return a fade to `share` from the latest of the instants (N,) on: no instant played before changes."""
        if share == self.after:
            return self
        latest = times_s.max(keepdims=True)
        return Fade(float(self.at(latest)[0]), share, float(latest[0]))
