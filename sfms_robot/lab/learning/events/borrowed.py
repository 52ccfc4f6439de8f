"""Hazards that the meetings alone cannot teach: blinks, of which nobody noted one, and looks away across no table.

Blinks come at recorded intervals, more often at the cues that composed dyads use. How speech makes people look away
is learned in the meetings, where slides and papers draw eyes for minutes; how often and for how long is that of 14
people who listened to one another with no table between them (`event_shapes`), and of the same people speaking.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from sfms_robot.frames import Doubles, Floats
from sfms_robot.lab.learning.events import logistic
from sfms_robot.lab.learning.events.event_trainer import Groups, Student, hazard, inputs
from sfms_robot.listeners.events.evidence import AT, EVIDENCE
from sfms_robot.listeners.events.model import STEP_S, Hazard, HazardBank

AT_PERSON_S: Final = 16.3  # mean seconds near the other's face, listening
AT_PERSON_SPEAKING_S: Final = 1.47
BLINKS: Final[Groups] = {"blink_s": (0.0, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8)}
BLINK_CUES: Final = {"silence_s": {0.0: 0.0, 0.12: 1.0, 0.4: 0.6, 0.8: 0.0}, "shift_s": {0.0: 1.5, 0.3: 1.0, 0.6: 0.0}}


def blink_hazard(gaps: Sequence[Floats]) -> Hazard:
    """From recorded seconds between blinks."""
    every = np.concatenate([np.asarray(gap, np.float64) for gap in gaps])
    since = [np.arange(1, max(2, round(gap / STEP_S) + 1)) * STEP_S for gap in every.tolist()]
    rows = np.full((sum(map(len, since)), len(EVIDENCE)), np.nan)
    rows[:, AT["blink_s"]] = np.concatenate(since)
    happens = np.concatenate([np.r_[np.zeros(len(steps) - 1), 1.0] for steps in since])
    learned = logistic.fit(inputs(rows, BLINKS), happens, np.ones(len(happens)), ridge=1.0)
    told = "recorded intervals; cues as in composed dyads"
    found = hazard(learned, BLINKS, told, 60.0 / float(every.mean()))
    return found.model_copy(update={"weights": {**found.weights, **BLINK_CUES}})


def look_away_hazard(found: Hazard, students: Iterable[Student]) -> Hazard:
    """`found` in the meetings, brought to how often people look away from one another."""
    weights = {name: weight for name, weight in found.weights.items() if name not in ("at_person_s", "own_voice_s")}
    more = round(float(np.log(AT_PERSON_S / AT_PERSON_SPEAKING_S)), 3)
    weights["own_voice_s"] = {0.0: more, 0.5: round(more / 2, 3), 1.0: 0.0}
    told = "gaze shifts away from a speaker, AMI; how often: 14 people listening, ETRA 2024"
    away = found.model_copy(update={"weights": weights, "learned_from": told})
    return at_rate(away, "gaze_shift", students, 60.0 / AT_PERSON_S)


def at_rate(given: Hazard, kind: str, students: Iterable[Student], per_minute: float) -> Hazard:
    """The same with the intercept that gives so many a minute, in the steps of others in which it may happen."""
    rows = np.concatenate(
        [one.evidence[one.lessons[kind].may & (one.evidence[:, AT["own_voice_s"]] > 1.0)] for one in students
         if kind in one.lessons]
    )  # fmt: skip
    bank = HazardBank({kind: given})
    odds = np.concatenate([bank.log_odds(bank.contributions(part))[:, 0] for part in _parts(rows)])
    low, high = -20.0, 20.0
    for _ in range(50):
        middle = (low + high) / 2
        mean = float((1 / (1 + np.exp(-(odds + middle)))).mean()) * 60 / STEP_S
        low, high = (middle, high) if mean < per_minute else (low, middle)
    update = {"intercept": round(given.intercept + low, 3), "per_minute": round(per_minute, 3)}
    return given.model_copy(update=update)


def _parts(rows: Doubles) -> list[Doubles]:
    return np.array_split(rows, max(1, len(rows) // 4096))
