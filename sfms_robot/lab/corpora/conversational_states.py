"""Which of the seven conversational states (3.3) the agent is in, from who speaks, what is feedback, and nods.

The paper annotated its data by hand and shows the result in a figure alone; this rule is ours. Voice activity decides
what is possible; dialogue acts decide the rest:

| agent | user | state |
|---|---|---|
| speaks | silent | speaking; giving feedback when it is an "mm-hm" into the other's pause |
| speaks | speaks | giving feedback when the agent's words are; receiving it when the user's are; else interrupted |
| silent | speaks | receiving feedback in the agent's turn; giving it while he nods; else listening |
| silent | silent | thinking when the agent spoke last and speaks next; else waiting |

Feedback does not take the floor: who spoke last or speaks next leaves it out. Where no dialogue acts are at hand,
`short_answers` stands in for them.
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
ANSWER_S: Final = 1.0  # shorter utterances in the other's turn are feedback, where nobody annotated it


def states_of_activity(agent: Bools, user: Bools) -> NDArray[np.int8]:
    """Return one state per frame (N,) from voice activity alone: short answers are feedback, and no nods are known."""
    return states_of(agent, user, short_answers(agent, user), short_answers(user, agent), np.zeros_like(agent))


def states_of(agent: Bools, user: Bools, agent_feedback: Bools, user_feedback: Bools, nods: Bools) -> NDArray[np.int8]:
    """Return one state per frame (N,); see the table of this module.

    Per frame (N,): who speaks, which of it is feedback (may reach beyond the speech), and whether the agent nods.
    """
    told, answered = agent & agent_feedback, user & user_feedback
    floor = np.where(agent & ~told, 1, np.where(user & ~answered, -1, 0))
    own_turn = (_latest(floor) == 1) & (_latest(floor[::-1])[::-1] == 1)  # the agent had the floor, and has it next
    rules = (  # the first that holds
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
    """Return utterances (N,) under a second that begin in the other's speech before the other continues."""
    out = np.zeros(len(active), bool)
    for start, end in runs(active):
        before, after = other[max(0, start - FRAME_HZ // 2) : start + 1], other[end : end + FRAME_HZ]
        if end - start < ANSWER_S * FRAME_HZ and before.any() and after.any():
            out[start:end] = True
    return out
