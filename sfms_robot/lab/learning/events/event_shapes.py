"""How long and how large: durations as people had them, the rest as composed dyads have it (`corpora.compose.acting`).

A smile takes as long as one that composing lays: from onset to offset of the recorded curve, held while it is seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, Doubles
from sfms_robot.lab.corpora.compose.acting import smile_s
from sfms_robot.lab.corpora.compose.splicing import held
from sfms_robot.lab.learning.events.event_trainer import Student
from sfms_robot.listeners.events.model import Shape
from sfms_robot.signals import event_sizes as sizes
from sfms_robot.signals.motion_primitives import Motions

STEPS: Final = 20  # between quantiles
LONGEST_S: Final = 6.0  # of a nod, of a laugh
DRAWN: Final = 400  # smiles
_SHARES: Final = np.linspace(0, 1, STEPS + 1)
_INNER: Final = np.clip(_SHARES, 0.01, 0.99)  # a tail has no end


def shapes(students: Sequence[Student], motions: Motions) -> dict[str, Shape]:
    """Of every kind, durations from these people."""
    least, usual, most = sizes.NOD_DEG
    nod_deg = np.clip(usual * np.exp(sizes.NOD_SPREAD * _normal(_INNER)), least, most)
    nod_deg[[0, -1]] = least, most
    habit = tuple(_rounded(np.clip(1 + sizes.HABIT_SPREAD * _normal(_INNER), 0.4, 1.6)))
    rng = np.random.default_rng(0)
    slight, whole = sizes.BLINK
    return {
        "nod": Shape(
            duration_s=_quantiles(_lengths(one.person.nods for one in students).clip(0.2, LONGEST_S)),
            size=tuple(_rounded(nod_deg)),
            habit=habit,
            swings_hz=sizes.SWINGS_HZ,
        ),
        "shake": Shape(
            duration_s=_quantiles(_lengths(one.person.shakes for one in students).clip(0.2, LONGEST_S)),
            size=tuple(_rounded(sizes.SHAKE * nod_deg)),
            habit=habit,
            swings_hz=sizes.SWINGS_HZ,
        ),
        "tilt": Shape(
            duration_s=_quantiles(_lengths(one.person.tilts for one in students).clip(0, LONGEST_S) + 12 * FRAME_S),
            size=sizes.TILT_DEG,
        ),
        "laugh": Shape(
            duration_s=_quantiles(_laughs_s(_lengths(one.person.laughs for one in students), motions, rng)),
            size=sizes.LAUGH,
        ),
        "smile": Shape(
            duration_s=_quantiles(_smiles_s([smile_s(rng) for _ in range(DRAWN)], motions, rng)), size=sizes.SMILE
        ),
        "mm_hm": Shape(duration_s=_quantiles(_lengths(one.person.mm_hms for one in students)), size=sizes.MM_HM),
        "brow_raise": Shape(
            duration_s=_quantiles(np.outer(_recorded(motions.brows), (*sizes.BROW_STRETCH, 1.0)).ravel()),
            size=sizes.BROW_RAISE,
        ),
        "blink": Shape(
            duration_s=_quantiles(_recorded(motions.blinks)),
            size=tuple(_rounded(np.interp(_SHARES, (0, *[sizes.SLIGHT_BLINKS] * 2, 1), (*slight, *whole)))),
        ),
        "gaze_shift": Shape(
            duration_s=tuple(_rounded(np.array([sizes.aside_s(share) for share in _INNER]))),
            size=tuple(_rounded(np.interp(_SHARES, *sizes.ASIDE_DEG))),
        ),
    }


def _laughs_s(heard_s: Doubles, motions: Motions, rng: np.random.Generator) -> Doubles:
    """From onset to offset, of laughs that were heard so long."""
    longer = rng.uniform(*sizes.LAUGH_LONGER_S, len(heard_s))
    return _smiles_s((heard_s.clip(0, LONGEST_S) + longer).tolist(), motions, rng)


def _smiles_s(seen_s: Sequence[float], motions: Motions, rng: np.random.Generator) -> Doubles:
    """Likewise, of smiles that are seen so long."""
    curves = [motions.smiles[int(rng.integers(len(motions.smiles)))] for _ in seen_s]
    return np.array(
        [len(held(curve, int(seen * FRAME_HZ))) * FRAME_S for curve, seen in zip(curves, seen_s, strict=True)]
    )


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
