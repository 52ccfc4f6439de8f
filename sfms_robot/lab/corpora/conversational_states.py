"""The agent's conversational state, one of seven (3.3), from voice activity, feedback and nods.

The paper annotated its data by hand and shows the result only in a figure; this rule is ours. Voice activity limits the
possible states; dialogue acts decide among them:

| agent | user | state |
|---|---|---|
| speaks | silent | speaking; giving feedback when it is an "mm-hm" into the other's pause |
| speaks | speaks | giving feedback if the agent's words are feedback, receiving if the user's are; else interrupted |
| silent | speaks | receiving feedback in the agent's turn; giving it while the agent nods; else listening |
| silent | silent | thinking when the agent spoke last and speaks next; else waiting |

Feedback does not take the floor: it is ignored when the last or next person to speak is determined. If there are no
dialogue acts, `short_answers` replaces them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config.listener import STATES
from sfms_robot.frames import FRAME_HZ, Bools
from sfms_robot.signals.events import runs

STATE: Final[Mapping[str, int]] = {name: index for index, name in enumerate(STATES)}
UNKNOWN: Final = -1
ANSWER_S: Final = 1.0  # if feedback was not annotated, shorter utterances in the other's turn count as it


def states_of_activity(agent: Bools, user: Bools) -> NDArray[np.int8]:
    """Return one state per frame (N,) from voice activity alone: short answers are feedback, nods are unknown."""
    return states_of(agent, user, short_answers(agent, user), short_answers(user, agent), np.zeros_like(agent))


def states_of(agent: Bools, user: Bools, agent_feedback: Bools, user_feedback: Bools, nods: Bools) -> NDArray[np.int8]:
    """Return one state per frame (N,); see the table of this module.

    The masks (N,) are: speech of each person, feedback of each (may reach beyond the speech), and nods of the agent.
    """
    told, answered = agent & agent_feedback, user & user_feedback
    floor = np.where(agent & ~told, 1, np.where(user & ~answered, -1, 0))
    own_turn = (_latest(floor) == 1) & (_latest(floor[::-1])[::-1] == 1)  # the agent had the floor last and has it next
    rules = (  # the first rule that applies decides
        (told, "giving_feedback"),
        (agent & answered, "receiving_feedback"),
        (agent & user, "interrupted"),
        (agent, "speaking"),
        (answered & own_turn, "receiving_feedback"),
        (user & nods, "giving_feedback"),
        (user, "listening"),
        (own_turn, "thinking"),
    )
    return np.select([rule for rule, _ in rules], [STATE[name] for _, name in rules], STATE["waiting"]).astype(np.int8)


def _latest(floor: NDArray[np.int_]) -> NDArray[np.int_]:
    """Return the newest value (N,) that is not 0, up to and with each frame; 0 before the first."""
    newest = np.maximum.accumulate(np.where(floor != 0, np.arange(len(floor)), -1))
    return np.where(newest >= 0, floor[newest], 0)


def short_answers(active: Bools, other: Bools) -> Bools:
    """Return a mask (N,) of utterances under 1 s with speech of the other up to 0.5 s before and up to 1 s after."""
    out = np.zeros(len(active), bool)
    for start, end in runs(active):
        before, after = other[max(0, start - FRAME_HZ // 2) : start + 1], other[end : end + FRAME_HZ]
        if end - start < ANSWER_S * FRAME_HZ and before.any() and after.any():
            out[start:end] = True
    return out
