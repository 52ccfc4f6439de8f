"""How long and how large: durations as people had them, the rest as composed dyads have it (`corpora.compose.acting`).

Sizes of annotated nods were measured by nobody. Looks aside are those of 14 people listening to somebody (Dembinsky et
al., ETRA 2024, github psyberlab/eye-gaze-during-conversation-dataset e156145, Apache-2.0): beyond 5 degrees of the
other's face for 0.86 s in the mean.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from sfms_robot.corpora.compose.motions import Motions
from sfms_robot.frames import FRAME_S, Doubles
from sfms_robot.learning.events.event_trainer import Student
from sfms_robot.listeners.events.hazards import Shape

STEPS: Final = 20  # between quantiles
LONGEST_S: Final = 6.0  # of a nod
NOD_DEG: Final = (2.2, 5.0, 12.0)  # least, habit, most
NOD_SPREAD: Final = 0.35  # of the logarithm, from nod to nod
HABIT_SPREAD: Final = 0.2  # from person to person
SWINGS_HZ: Final = (1.8, 3.0)
SHAKE: Final = 0.8  # of a nod's size
ASIDE_MEAN_S, ASIDE_LEAST_S = 0.86, 0.16
ASIDE_DEG: Final = ((0.0, 0.25, 0.5, 0.75, 0.9, 1.0), (5.5, 6.9, 10.3, 13.9, 17.9, 20.0))
_SHARES: Final = np.linspace(0, 1, STEPS + 1)
_INNER: Final = np.clip(_SHARES, 0.01, 0.99)  # a tail has no end


def shapes(students: Sequence[Student], motions: Motions) -> dict[str, Shape]:
    """Of every kind, durations from these people."""
    nod_deg = np.clip(NOD_DEG[1] * np.exp(NOD_SPREAD * _normal(_INNER)), NOD_DEG[0], NOD_DEG[2])
    nod_deg[[0, -1]] = NOD_DEG[0], NOD_DEG[2]
    habit = tuple(_rounded(np.clip(1 + HABIT_SPREAD * _normal(_INNER), 0.4, 1.6)))
    rng = np.random.default_rng(0)
    laughs = _lengths(one.person.others_laughs for one in students)
    smiles = np.r_[laughs, _lengths(one.person.mm_hms for one in students)]
    return {
        "nod": Shape(
            duration_s=_quantiles(_lengths(one.person.nods for one in students).clip(0.2, LONGEST_S)),
            size=tuple(_rounded(nod_deg)),
            habit=habit,
            swings_hz=SWINGS_HZ,
        ),
        "shake": Shape(
            duration_s=_quantiles(_lengths(one.person.shakes for one in students).clip(0.2, LONGEST_S)),
            size=tuple(_rounded(SHAKE * nod_deg)),
            habit=habit,
            swings_hz=SWINGS_HZ,
        ),
        "tilt": Shape(
            duration_s=_quantiles(_lengths(one.person.tilts for one in students).clip(0, LONGEST_S) + 12 * FRAME_S),
            size=(2.0, 6.0),
        ),
        "laugh": Shape(
            duration_s=_quantiles(_lengths(one.person.laughs for one in students).clip(0, LONGEST_S) + 0.8),
            size=(0.5, 0.9),
        ),
        "smile": Shape(
            duration_s=_quantiles(smiles.clip(0, LONGEST_S) + rng.uniform(0.8, 1.8, len(smiles))), size=(0.2, 0.6)
        ),
        "mm_hm": Shape(duration_s=_quantiles(_lengths(one.person.mm_hms for one in students)), size=(0.25, 0.45)),
        "brow_raise": Shape(
            duration_s=_quantiles(np.outer(_recorded(motions.brows), (0.7, 1.0, 1.3)).ravel()), size=(0.2, 0.5)
        ),
        "blink": Shape(
            duration_s=_quantiles(_recorded(motions.blinks)),
            size=tuple(_rounded(np.interp(_SHARES, (0, 0.15, 0.15, 1), (0.55, 0.8, 0.85, 1.0)))),
        ),
        "gaze_shift": Shape(
            duration_s=tuple(_rounded(ASIDE_LEAST_S - (ASIDE_MEAN_S - ASIDE_LEAST_S) * np.log(1 - _INNER))),
            size=tuple(_rounded(np.interp(_SHARES, *ASIDE_DEG))),
        ),
    }


def _lengths(spans: Iterable[Doubles]) -> Doubles:
    every = np.concatenate(list(spans))
    return np.asarray(every[:, 1] - every[:, 0], np.float64)


def _recorded(curves: Sequence[np.typing.NDArray[np.float32]]) -> Doubles:
    return np.array([len(curve) for curve in curves]) * FRAME_S


def _quantiles(values: Doubles) -> tuple[float, ...]:
    return tuple(_rounded(np.quantile(values, _SHARES)))


def _rounded(values: Doubles) -> list[float]:
    return [round(float(value), 3) for value in values]


def _normal(shares: Doubles) -> Doubles:
    from scipy import special

    return np.asarray(special.ndtri(shares), np.float64)
