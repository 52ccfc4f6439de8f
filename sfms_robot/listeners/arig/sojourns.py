"""Conversational states of a stream, drawn: which comes next, and for how long (`modules` has the table).

A semi-Markov process: how long a state lasts is drawn from durations of the data, which comes next from the model's
answer. Feedback that is seen, a nod or a smile in the other's turn, lies on top: the events decide it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config.listener import EVENT_STATES, STATES
from sfms_robot.frames import Doubles, Floats
from sfms_robot.signals import control

FIRST: Final = STATES.index("waiting")  # of a stream: nobody has spoken yet
LISTENING: Final = STATES.index("listening")
FEEDBACK: Final = STATES.index("giving_feedback")
NODDING: Final = EVENT_STATES.index("giving_feedback_nod")
SMILING: Final = EVENT_STATES.index("giving_feedback_smile")
CONTROL_ROWS: Final = 2  # of events, that are told: of the frame before and of the frame
QUANTILES: Final = 33  # of a state's durations that are kept
_ACTIVE: Final = {kind: control.COLUMNS.index(f"{kind}.active") for kind in ("nod", "smile", "laugh")}


@dataclass(frozen=True)
class Sojourn:
    """One of `STATES`, and for how many frames more it is to last."""

    state: int
    left: int


def with_feedback(states: NDArray[Any], rows: Floats) -> NDArray[Any]:
    """States (...) of `STATES` and the control rows (..., K) of their frames -> states of `EVENT_STATES`.

    Who nods, laughs or smiles while he listens gives feedback by it; other states, and unknown ones, stay as they are.
    """
    nods = rows[..., _ACTIVE["nod"]] > 0
    smiles = (rows[..., _ACTIVE["smile"]] > 0) | (rows[..., _ACTIVE["laugh"]] > 0)
    seen = np.where(nods, NODDING, np.where(smiles, SMILING, states))
    return np.where((states == LISTENING) | (states == FEEDBACK), seen, states)


def draw_sojourn(
    durations: Floats, possible: Floats, logits: Floats, voiced: tuple[bool, bool], before: Sojourn, uniforms: Doubles
) -> Sojourn:
    """The state of a frame.

    A state lasts as long as was drawn when it began, but ends at once where the voices say that it is over. Then comes
    another by the model's answer, of those that the voices leave; the same again where they leave no other.

    Args:
        durations, possible: of `modules.StateUnderstanding`.
        logits: (S,) of the frame.
        voiced: speech of agent and user, as the model is told it.
        before: that of the frame before.
        uniforms: (2,) in 0..1: which state, and for how long.
    """
    may = possible[int(voiced[0]), int(voiced[1])] > 0  # (7,), an array of its own
    if before.left > 0 and may[before.state]:
        return Sojourn(before.state, before.left - 1)
    may[before.state] &= not may.sum() > 1
    scores = np.where(may, logits[: len(STATES)].astype(np.float64), -np.inf)
    chances = np.exp(scores - scores.max()).cumsum()
    state = min(int((chances <= uniforms[0] * chances[-1]).sum()), len(STATES) - 1)
    place = float(uniforms[1]) * (QUANTILES - 1)
    low, high = durations[state, int(place)], durations[state, min(int(place) + 1, QUANTILES - 1)]
    return Sojourn(state, max(0, round(float(low + (place % 1) * (high - low))) - 1))
