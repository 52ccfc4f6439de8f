"""Is somebody there, and does the robot speak? From what its source gives, one frame of 40 ms after the other.

Somebody is there while a face is seen or a voice was heard within `GONE_S`. The robot speaks while its own voice, as it
is being played, has sound, pauses between words included: neither a text nor what the person says ends its turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import SpeakerFrame
from sfms_robot.signals import voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.signals.voice_activity import Ear

GONE_S: Final = 10.0  # neither seen nor heard for so long
LOST_S: Final = 0.5  # without sound or face from any source
TURN_GAP_S: Final = 0.6  # a pause between the robot's own words
SAYS_DB: Final = -55.0  # what is played is clean: anything louder is speech

_NEVER_S: Final = -float("inf")


@dataclass(frozen=True)
class Presence:
    """What is remembered between frames.

    Attributes:
        ear: the person's voice activity.
        person_s, spoke_s: when the person was last seen or heard, and the robot last made a sound.
        sensed_s: when anything last came, silence included.
        attention: of the newest frame, see `Sighting`.
    """

    ear: Ear
    person_s: float = _NEVER_S
    spoke_s: float = _NEVER_S
    sensed_s: float = _NEVER_S
    attention: float | None = None

    @classmethod
    def start(cls) -> Presence:
        return cls(voice_activity.start())

    def after(self, frame: SpeakerFrame) -> Presence:
        """One frame later."""
        ear = voice_activity.step(energy_db(frame.audio), self.ear) if len(frame.audio) else self.ear
        there = frame.face is not None or (len(frame.audio) > 0 and ear.active)
        says = frame.agent_audio is not None and len(frame.agent_audio) > 0 and _sounds(frame)
        return Presence(
            ear,
            frame.time_s if there else self.person_s,
            frame.time_s if says else self.spoke_s,
            frame.time_s if len(frame.audio) or frame.face is not None else self.sensed_s,
            frame.attention,
        )

    def person(self, now_s: float) -> bool:
        return now_s - self.person_s <= GONE_S

    def answered(self, now_s: float) -> bool:
        """Whether what the listener plans is to show: somebody is there, or is spoken to, and can be sensed."""
        return self.speaking(now_s) or (self.person(now_s) and now_s - self.sensed_s <= LOST_S)

    def speaking(self, now_s: float) -> bool:
        return now_s - self.spoke_s <= TURN_GAP_S


def _sounds(frame: SpeakerFrame) -> bool:
    assert frame.agent_audio is not None
    return energy_db(np.asarray(frame.agent_audio, np.float32)) > SAYS_DB
