"""Which of two listeners people prefer: the trials of a blind comparison, and what their answers say.

A trial shows two clips of the same voice, left and right, and asks `QUESTIONS` about them. Who takes part sees every
pair of conditions with every voice once, in an order and with sides that are drawn for that person. Of a pair is told
how often the first was chosen of the two, with the exact (Clopper and Pearson) interval and the binomial test against
one half; of three and more conditions Bradley and Terry's strengths s too, by which i is chosen before j with a chance
of 1 / (1 + exp(s_j - s_i)). Their intervals draw the people anew, since answers of one person hang together; of one
person there is none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final

import numpy as np
from scipy.stats import binomtest

from sfms_robot.frames import Doubles
from sfms_robot.lab.evaluation.bootstrap import DRAWS, LEVEL

QUESTIONS: Final = {
    "person": "Which listens more like a person?",
    "attentive": "Which is more attentive?",
    "natural": "Which moves more naturally?",
    "in_time": "Which reacts more in time with the voice?",
}
NEITHER: Final = "neither"
_HALF: Final = 0.5  # of a win each way in every pair: strengths stay finite where one always wins
_STEPS: Final = 200


@dataclass(frozen=True)
class Trial:
    """Two conditions beside one another, by name, and the number of the voice that both hear."""

    number: int
    voice: int
    left: str
    right: str


@dataclass(frozen=True)
class Preference:
    """One answer: `chosen` is `left`, `right` (names of conditions) or NEITHER."""

    participant: str
    trial: int
    voice: int
    question: str
    left: str
    right: str
    chosen: str


def trials(conditions: Sequence[str], voices: int, seed: int, participant: str) -> list[Trial]:
    """Every pair with every voice, in this person's order and on this person's sides; the same for the same names."""
    digest = hashlib.sha256(f"{seed} {participant}".encode()).digest()
    rng = np.random.default_rng(list(digest[:8]))
    pairs = [(voice, *pair) for voice in range(voices) for pair in combinations(conditions, 2)]
    shown = []
    for number, place in enumerate(rng.permutation(len(pairs))):
        voice, one, other = pairs[int(place)]
        left, right = (one, other) if rng.random() < 0.5 else (other, one)
        shown.append(Trial(number, voice, left, right))
    return shown


def summary(answers: Sequence[Preference], seed: int = 0) -> dict[str, Any]:
    """Per question and pair of conditions: counts, share of the first, interval, p; strengths; how many answered."""
    conditions = sorted({name for answer in answers for name in (answer.left, answer.right)})
    rows, strengths = [], {}
    for question in QUESTIONS:
        asked = [answer for answer in answers if answer.question == question]
        rows += [_pair(question, first, second, asked) for first, second in combinations(conditions, 2)]
        if len(conditions) > 2 and asked:
            strengths[question] = _strengths(conditions, asked, seed)
    return {
        "participants": len({answer.participant for answer in answers}),
        "answers": len(answers),
        "conditions": conditions,
        "rows": [row for row in rows if row["answers"]],
        "bradley_terry": strengths,
        "sides": _sides(answers),
    }


def _pair(question: str, first: str, second: str, asked: Sequence[Preference]) -> dict[str, Any]:
    here = [answer for answer in asked if {answer.left, answer.right} == {first, second}]
    wins = [sum(answer.chosen == name for answer in here) for name in (first, second)]
    row: dict[str, Any] = {
        "question": question, "first": first, "second": second, "answers": len(here), "first_chosen": wins[0],
        "second_chosen": wins[1], "neither": len(here) - sum(wins), "share": None, "interval": None, "p": None,
    }  # fmt: skip
    if sum(wins):
        test = binomtest(wins[0], sum(wins), 0.5)
        low, high = test.proportion_ci(LEVEL, method="exact")
        row |= {"share": wins[0] / sum(wins), "interval": [float(low), float(high)], "p": float(test.pvalue)}
    return row


def _sides(answers: Sequence[Preference]) -> dict[str, int]:
    """How often each side was chosen: far from even, people did not look."""
    chosen = [answer for answer in answers if answer.chosen != NEITHER]
    left = sum(answer.chosen == answer.left for answer in chosen)
    return {"left": left, "right": len(chosen) - left}


def _strengths(conditions: Sequence[str], asked: Sequence[Preference], seed: int) -> dict[str, dict[str, Any]]:
    people = sorted({answer.participant for answer in asked})
    wins = np.zeros((len(people), len(conditions), len(conditions)))
    for answer in asked:
        one, other = conditions.index(answer.left), conditions.index(answer.right)
        person = people.index(answer.participant)
        if answer.chosen == NEITHER:
            wins[person, one, other] += 0.5
            wins[person, other, one] += 0.5
        else:
            better, worse = (one, other) if answer.chosen == answer.left else (other, one)
            wins[person, better, worse] += 1
    value = bradley_terry(wins.sum(axis=0))
    low = high = None
    if len(people) > 1:
        drawn = np.random.default_rng(seed).multinomial(len(people), np.full(len(people), 1 / len(people)), DRAWS)
        found = np.array([bradley_terry(np.tensordot(counts, wins, axes=1)) for counts in drawn])
        low, high = np.quantile(found, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return {
        name: {
            "strength": float(value[place]),
            "interval": None if low is None or high is None else [float(low[place]), float(high[place])],
        }
        for place, name in enumerate(conditions)
    }


def bradley_terry(wins: Doubles) -> Doubles:
    """Wins (K, K), row before column -> log strengths (K,) with mean 0, by Hunter's minorization (2004)."""
    padded = wins + _HALF * (1 - np.eye(len(wins)))
    met, won = padded + padded.T, padded.sum(axis=1)
    strength = np.ones(len(wins))
    for _ in range(_STEPS):
        strength = won / (met / (strength[:, None] + strength[None, :])).sum(axis=1)
        strength /= np.exp(np.log(strength).mean())
    return np.asarray(np.log(strength))
