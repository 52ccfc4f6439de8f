"""What can be known of people's nods from the annotations themselves: the bar for a head that hears and sees.

A logistic hazard on who speaks, for how long, who looks, laughs and nods, and on his own nods before, fitted on
training people, asked at every instant of somebody else's meeting. It is told exactly what annotators saw, where a head
has a microphone and a camera. Once with his own speech, once fitted and asked without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from sfms_robot.frames import Doubles
from sfms_robot.lab.corpora.compose.ami import Person
from sfms_robot.lab.evaluation.listener_meetings import SHIFT_S
from sfms_robot.lab.learning.events.event_trainer import (
    FLOOR,
    GAZE,
    NOD,
    OTHERS,
    OWN_NODS,
    PHASE,
    Logistic,
    inputs,
    student,
    teach,
)
from sfms_robot.listeners.events.evidence import HEARD
from sfms_robot.listeners.events.model import STEP_FRAMES, STEP_S

_SILENT: Final = {
    **PHASE,
    **{name: knots for name, knots in FLOOR.items() if name != "floor_mine"},
    **OWN_NODS,
    **GAZE,
    **OTHERS,
}


@dataclass(frozen=True)
class ReferenceHazard:
    """Log-odds of a nod, of two fits: with his own speech, and without."""

    speaking: Logistic
    silent: Logistic

    @classmethod
    def of(cls, people: Sequence[Person]) -> Self:
        """Fitted on these people; some seconds for a hundred meetings."""
        rng = np.random.default_rng(0)
        with_voice = [student(person, rng) for person in people]
        without = [student(mute(person), rng) for person in people]
        return cls(teach(with_voice, "nod", NOD), teach(without, "nod", _SILENT))

    def scores(self, person: Person, frames: int) -> tuple[Doubles, Doubles, Doubles]:
        """(frames,) each: with his own speech, without it, and without it where the others are a minute off."""
        rng = np.random.default_rng(0)
        heard = student(person, rng).evidence
        alone = student(mute(person), rng).evidence
        other = alone.copy()
        other[:, : len(HEARD)] = np.roll(alone[:, : len(HEARD)], round(SHIFT_S / STEP_S), axis=0)
        return (
            _of_frames(self.speaking.log_odds(inputs(heard, NOD)), frames),
            _of_frames(self.silent.log_odds(inputs(alone, _SILENT)), frames),
            _of_frames(self.silent.log_odds(inputs(other, _SILENT)), frames),
        )


def mute(person: Person) -> Person:
    """Who never says a word; that he listens only where he was silent stays as it was."""
    words = {agent: spans for agent, spans in person.words.items() if agent != person.agent}
    return replace(person, words=words)


def _of_frames(steps: Doubles, frames: int) -> Doubles:
    """(M,) known as each step begins -> (frames,) known as each frame is over."""
    return np.asarray(steps[((np.arange(frames) + 1) // STEP_FRAMES).clip(0, len(steps) - 1)])
