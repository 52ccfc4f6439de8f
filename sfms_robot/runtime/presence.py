"""Is somebody there, and does the robot speak? From what its source gives, one frame of 40 ms after the other.

Somebody is there while a face is seen or a voice was heard within `GONE_S`. The robot speaks while its own voice, as it
is being played, has sound, pauses between words included: neither a text nor what the person says ends its turn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from sfms_robot.frames import Doubles, SpeakerFrame
from sfms_robot.ports import Watched
from sfms_robot.signals import voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.signals.minimum_jerk import ease
from sfms_robot.signals.voice_activity import Ear

GONE_S: Final = 10.0  # neither seen nor heard for so long
LOST_S: Final = 0.5  # without sound or face from any source
TURN_GAP_S: Final = 0.6  # a pause between the robot's own words
SAYS_DB: Final = -45.0  # what is played is clean: anything louder is speech

_NEVER_S: Final = -float("inf")


@dataclass(frozen=True)
class Presence:
    """What is remembered between frames.

    Attributes:
        ear: the person's voice activity.
        watched: where they were seen, and when the robot last made a sound.
        heard_s: when their voice was last heard.
        sensed_s: when anything last came, silence included.
    """

    ear: Ear
    watched: Watched = Watched()
    heard_s: float = _NEVER_S
    sensed_s: float = _NEVER_S

    @classmethod
    def start(cls) -> Presence:
        return cls(voice_activity.start())

    def after(self, frame: SpeakerFrame) -> Presence:
        """One frame later. A frame without a face leaves the person where they were seen."""
        ear = voice_activity.step(energy_db(frame.audio), self.ear) if len(frame.audio) else self.ear
        watched = self.watched
        if frame.agent_audio is not None and energy_db(frame.agent_audio) > SAYS_DB:
            watched = replace(watched, said_s=frame.time_s)
        if frame.face is not None:
            seen_s = frame.face.time_s
            watched = replace(watched, seen_s=seen_s, place_m=frame.place_m, attention=frame.attention)
        heard = len(frame.audio) > 0 and ear.active
        sensed = len(frame.audio) > 0 or frame.face is not None
        return Presence(
            ear, watched, frame.time_s if heard else self.heard_s, frame.time_s if sensed else self.sensed_s
        )

    def person(self, now_s: float) -> bool:
        """Whether somebody is there."""
        seen_s = _NEVER_S if self.watched.seen_s is None else self.watched.seen_s
        return now_s - max(seen_s, self.heard_s) <= GONE_S

    def answered(self, now_s: float) -> bool:
        """Whether what the listener plans is to show: somebody is there, or is spoken to, and can be sensed."""
        return self.speaking(now_s) or (self.person(now_s) and now_s - self.sensed_s <= LOST_S)

    def speaking(self, now_s: float) -> bool:
        """Whether the robot's own voice is being played."""
        return now_s - self.watched.said_s <= TURN_GAP_S


# --- Fade -------------------------------------------------------------------------------------------------------------
#
# How much of the listener's answer shows: all of it while a person is there, none without.

FADE_S: Final = 0.5


@dataclass(frozen=True)
class Fade:
    """A share that goes smoothly from `before` to `after`, from `since_s` on for `FADE_S`."""

    before: float = 0.0
    after: float = 0.0
    since_s: float = 0.0

    def at(self, times_s: Doubles) -> Doubles:
        """(N,) at (N,) instants."""
        share: Doubles = self.before + (self.after - self.before) * ease((times_s - self.since_s) / FADE_S)
        return share

    def toward(self, share: float, times_s: Doubles) -> Fade:
        """Goes to `share`, beginning at the latest of the instants (N,): none that was played before changes."""
        if share == self.after:
            return self
        latest = times_s.max(keepdims=True)
        return Fade(float(self.at(latest)[0]), share, float(latest[0]))
