"""The states of a run, the arrows between them, and the presence of a person, which decides some of them.

    starting        torque comes on, joints ease in
    idle            no person is there: the head moves a little and does not answer
    listening       a person is there
    speaking        the robot's own voice is being played
    degraded        the run continues without parts that `why` names
    halted          emergency stop, latched: `why` names every cause; ends when none is left
    stopping        the head comes to rest
    stopped         torque is off as requested
    fault           torque is off after an error that `why` names, or could not be confirmed off

A state is a value. The table of every arrow, its cause and its longest time is in docs/safety.md; `ARROWS` is the same
table, and no other arrow is ever taken.

A person is there if a face was seen or a voice was heard within the last `GONE_S`. The robot speaks while its own voice
has sound as it is being played, pauses between words included. A text, or the person's words, do not end its turn.
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

GONE_S: Final = 10.0  # a person neither seen nor heard for longer is gone
LOST_S: Final = 0.5  # longest time without sound or face from any source in which answers are shown
TURN_GAP_S: Final = 0.6  # longest pause between the robot's own words
SAYS_DB: Final = -45.0  # the played signal is clean: anything louder is speech
FADE_S: Final = 0.5  # fade of the listener's answer when a person comes or goes
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
    """A state of the run and the time at which it began [s, loop time].

    Attributes:
        why: the lost parts, the causes of a halt, or the error; empty otherwise.
        doing: the activity, regardless of lost parts.
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
        """Return the state at `now_s`; `since_s` changes when the name does.

        Args:
            now_s: loop time.
            eased_in: whether every joint has been led from where it was found into the face.
            person: whether a person is there.
            speaking: whether the robot's own voice is being played.
            lost: sources, "listener" and joints that the run continues without.
            halted: causes of an emergency stop, while it is latched.
            ending: whether the run is on its way to rest.
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
        heard_s: time of the person's last speech.
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
        """Return whether the listener's plans are shown: a person is there and sensed, or the robot speaks."""
        return self.speaking(now_s) or (self.person(now_s) and now_s - self.sensed_s <= LOST_S)

    def speaking(self, now_s: float) -> bool:
        """Return whether the robot's own voice is being played."""
        return now_s - self.watched.said_s <= TURN_GAP_S


@dataclass(frozen=True)
class Fade:
    """Share of the listener's answer that is shown: goes from `before` to `after` in `FADE_S`, from `since_s` on."""

    before: float = 0.0
    after: float = 0.0
    since_s: float = 0.0

    def at(self, times_s: Doubles) -> Doubles:
        """Return the share (N,) at (N,) instants."""
        return self.before + (self.after - self.before) * ease((times_s - self.since_s) / FADE_S)

    def toward(self, share: float, times_s: Doubles) -> Fade:
        """Return a fade to `share` from the latest of the instants (N,) on, so that no earlier instant changes."""
        if share == self.after:
            return self
        latest = times_s.max(keepdims=True)
        return Fade(float(self.at(latest)[0]), share, float(latest[0]))
