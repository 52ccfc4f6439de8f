"""Sizes and durations of a listener's events, for composed dyads, the event model and its teacher.

Sizes of nods, shakes and tilts are degrees from peak to peak; sizes of facial events are shares of full closure or
pull. Sizes of annotated nods are unknown, so the sizes here are those of the recorded heads from which composed dyads
are made. Looks aside are those of 14 people who listened to another person without a table between them (Dembinsky et
al., ETRA 2024, github psyberlab/eye-gaze-during-conversation-dataset e156145, Apache-2.0): more than 5 degrees away
from the other's face, for 0.86 s on average.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from sfms_robot.frames import Doubles

NOD_DEG: Final = (2.2, 5.0, 12.0)  # least, habit, most
NOD_SPREAD: Final = 0.35  # deviation of the size's logarithm, from nod to nod
HABIT_SPREAD: Final = 0.2  # relative deviation of the habit, from person to person
SWINGS_HZ: Final = (1.8, 3.0)  # swings, there and back, a second in a person's nods
MOST_SWINGS: Final = 4
SWING_S: Final = (0.3, 0.66)
# Duration of a swing [s], and the degrees that recorded nods reach in it on a neck with 1600 deg/s^2 (median).
SWING_REACH: Final = ((0.3, 0.34, 0.38, 0.42, 0.5), (5.4, 6.9, 7.4, 9.1, 12.0))
SHAKE: Final = 0.8  # of a nod's size
TILT_DEG: Final = (2.0, 6.0)
LAUGH: Final = (0.5, 0.9)
LAUGH_LONGER_S: Final = (0.8, 1.8)  # by which the smile of a laugh is longer than its sound
SMILE: Final = (0.3, 0.6)
SMILE_S: Final = (2.0, 0.4, 1.0, 6.0)  # duration of a smile: median, deviation of its logarithm, least, most
# Others' smiles, and smiles that return them. A rule, not data: shares and times have the size that studies of people
# who smile at one another report. A smile that is seen is answered, so a person who smiles more gets more answers.
SMILES_A_MINUTE: Final = (0.2, 1.5)  # rate of another person's smiles, distributed evenly over its logarithm
THEIR_SMILE: Final = (0.4, 0.9)
RETURNED: Final = 0.45  # share of others' smiles that are returned
RETURN_S: Final = (0.7, 0.3, 0.4, 1.2)  # from their onset to ours: median, deviation of its logarithm, least, most
RETURN_SIZE: Final = 0.6  # share of their size
RETURN_ENDS_S: Final = 0.5  # from the end of theirs to the end of ours
# Shares of others' laughs, own "mm-hm" and own nods that a smile follows.
SMILES_AFTER: Final[Mapping[str, float]] = {"laugh": 0.6, "mm_hm": 0.18, "nod": 0.06}
MM_HM: Final = (0.25, 0.45)
BROW_RAISE: Final = (0.2, 0.5)
BROW_STRETCH: Final = (0.7, 1.3)  # factor of the recorded length
SLIGHT_BLINKS: Final = 0.15  # share of blinks that do not close the eye
BLINK: Final = ((0.55, 0.8), (0.85, 1.0))  # slight ones, others
ASIDE_MEAN_S, ASIDE_LEAST_S = 0.86, 0.16
ASIDE_DEG: Final = ((0.0, 0.25, 0.5, 0.75, 0.9, 1.0), (5.5, 6.9, 10.3, 13.9, 17.9, 20.0))  # quantiles
SIDEWAYS, UP = 0.75, 0.75  # shares of looks away: more sideways than vertical; up, not down


def smile_s(rng: np.random.Generator) -> float:
    """Return a random duration of a smile [s]."""
    return _log_normal(SMILE_S, rng)


def others_smiles(duration_s: float, rng: np.random.Generator) -> Doubles:
    """Return smiles (K, 3) of another person: start, end [s], size."""
    least, most = np.log(SMILES_A_MINUTE)
    count = rng.poisson(math.exp(rng.uniform(least, most)) * duration_s / 60)
    start_s = np.sort(rng.uniform(0, duration_s, count))
    smiles = [(start, start + smile_s(rng), rng.uniform(*THEIR_SMILE)) for start in start_s.tolist()]
    apart = [one for one, before in zip(smiles, [(0.0, -1.0, 0.0), *smiles], strict=False) if one[0] > before[1] + 1.0]
    return np.array(apart, np.float64).reshape(-1, 3)


def returned(smiles: Doubles, rng: np.random.Generator) -> Doubles:
    """Return the smiles (L, 3) that answer those of another person (K, 3): start, end [s], size."""
    begins = smiles[:, 0] + [_log_normal(RETURN_S, rng) for _ in smiles]
    answers = np.stack([begins, smiles[:, 1] + RETURN_ENDS_S, RETURN_SIZE * smiles[:, 2]], axis=1)
    return answers[rng.random(len(smiles)) < RETURNED]


def _log_normal(shape: tuple[float, float, float, float], rng: np.random.Generator) -> float:
    median_s, deviation, least_s, most_s = shape
    return float(np.clip(median_s * np.exp(rng.normal(0, deviation)), least_s, most_s))


def swings(length_s: float, pace_hz: float) -> tuple[int, float]:
    """Return the number of swings, there and back, in about `length_s`, and the duration [s] of all of them."""
    count = int(min(max(round(length_s * pace_hz), 1), MOST_SWINGS))
    return count, count * min(max(length_s / count, SWING_S[0]), SWING_S[1])


def swing_reach_rad(swing_s: float) -> float:
    """Return the peak-to-peak size that a head reaches in a swing of that duration."""
    return math.radians(float(np.interp(swing_s, *SWING_REACH)))


def aside(angle_rad: float, side: float, up: float) -> tuple[float, float]:
    """Return (yaw, pitch) of a look aside by `angle_rad`, equally to either side; `side` and `up`: random in 0..1."""
    share = 2 * side % 1.0
    steep = 45.0 * (share / SIDEWAYS if share < SIDEWAYS else 1 + (share - SIDEWAYS) / (1 - SIDEWAYS))
    yaw = math.copysign(math.cos(math.radians(steep)), 0.5 - side)
    return angle_rad * yaw, angle_rad * math.copysign(math.sin(math.radians(steep)), up - UP)  # pitch + is down


def aside_rad(share: float) -> float:
    """Return the angle of a look aside; `share` is random in 0..1."""
    return math.radians(float(np.interp(share, *ASIDE_DEG)))


def aside_s(share: float) -> float:
    """Return the duration of a look aside; `share` is random in 0..1, below 1."""
    return ASIDE_LEAST_S - (ASIDE_MEAN_S - ASIDE_LEAST_S) * math.log1p(-share)
