"""Conversation states understanding (3.3): which of seven states the agent is in, and a feature of it.

Voice activity alone tells four patterns; which state a pattern means depends on the conversation (figure 3):

| agent | user | states |
|---|---|---|
| speaks | silent | speaking |
| speaks | speaks | receiving feedback, interrupted |
| silent | speaks | listening, giving feedback |
| silent | silent | thinking (its own pause), waiting (the other's) |

The figure itself is not in the text at hand; giving feedback, where it is a word and not a nod, is speech of both.

The paper's stream goes on from its most probable state. A listener with events departs from it twice. Feedback that is
seen, a nod or a smile in the other's turn, has states of its own, and the events decide them (`with_feedback`). The
other states are drawn, a semi-Markov process: how long one stays is drawn from durations of the data, which state comes
next from the model's answer (`StateUnderstanding.draw`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor, nn

from sfms_robot.config.arig import EVENT_STATES, STATES
from sfms_robot.listeners.arig.parts import CrossAttention, LayerNorm, Linear, Part
from sfms_robot.signals import control

FIRST: Final = STATES.index("waiting")  # of a stream: nobody has spoken yet
LISTENING: Final = STATES.index("listening")
FEEDBACK: Final = STATES.index("giving_feedback")
NODDING: Final = EVENT_STATES.index("giving_feedback_nod")
SMILING: Final = EVENT_STATES.index("giving_feedback_smile")
QUANTILES: Final = 33  # of a state's durations that are kept
_ACTIVE: Final = {kind: control.COLUMNS.index(f"{kind}.active") for kind in ("nod", "smile", "laugh")}


@dataclass(frozen=True)
class Sojourn:
    """One of `STATES`, and for how many frames more it is to last."""

    state: int
    left: int


def with_feedback(states: Tensor, rows: Tensor) -> Tensor:
    """States (...) of `STATES` and the control rows (..., K) of their frames -> states of `EVENT_STATES`.

    Who nods, laughs or smiles while he listens gives feedback by it; other states, and unknown ones, stay as they are.
    """
    nods = rows[..., _ACTIVE["nod"]] > 0
    smiles = (rows[..., _ACTIVE["smile"]] > 0) | (rows[..., _ACTIVE["laugh"]] > 0)
    seen = torch.where(nods, NODDING, torch.where(smiles, SMILING, states))
    return torch.where((states == LISTENING) | (states == FEEDBACK), seen, states)


class StateUnderstanding(Part):
    """The previous state asks voice activity and cis-token what the state is now.

    With events its states are `EVENT_STATES`, and it also has what is known of them from the data: `durations` (7, 33),
    quantiles of how many frames each of `STATES` lasts, and `possible` (2, 2, 7), 1 for those that there are while
    agent and user are silent or speak.
    """

    durations: Tensor
    possible: Tensor

    def __init__(self, width: int, hidden: int, heads: int, events: bool = False) -> None:
        super().__init__()
        states = len(EVENT_STATES if events else STATES)
        if events:
            self.register_buffer("durations", torch.ones(len(STATES), QUANTILES))
            self.register_buffer("possible", torch.ones(2, 2, len(STATES)))
        self.previous = nn.Embedding(states, width)
        self.voices = nn.Parameter(torch.randn(2, 2, width) * 0.02)  # track, silent or speaking
        self.look = CrossAttention(width, hidden, heads, slots=3)
        self.norm = LayerNorm(width)
        self.classify = Linear(width, states)

    def condition(self, cis: Tensor, voiced: Tensor) -> Tensor:
        """cis (N, D), voiced (N, 2) bool: agent now, user one frame before -> keys (N, 3, 2D)."""
        told = torch.where(voiced[..., None], self.voices[:, 1], self.voices[:, 0])  # (N, 2, D)
        return self.look.keys(torch.cat([told, cis[:, None]], dim=1))

    def forward(self, keys: Tensor, previous: Tensor) -> tuple[Tensor, Tensor]:
        """`condition` (N, 3, 2D) and previous states (N,) -> state feature (N, D) and logits (N, S) of S states."""
        feature = self.norm(self.look(self.previous(previous), keys))
        return feature, self.classify(feature)

    def roll(self, keys: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        """Every frame's own answer becomes the next one's question: as a stream runs.

        keys (B, T, 3, 2D), first (B,) -> features (B, T, D), logits (B, T, S).
        """
        features, logits, state = [], [], first
        for frame in keys.unbind(dim=1):
            feature, scores = self(frame, state)
            state = scores.argmax(-1)
            features.append(feature)
            logits.append(scores)
        return torch.stack(features, dim=1), torch.stack(logits, dim=1)

    def draw(self, logits: Tensor, voiced: tuple[bool, bool], before: Sojourn, uniforms: Tensor) -> Sojourn:
        """The state of a frame.

        A state lasts as long as was drawn when it began, but ends at once where the voices say that it is over. Then
        comes another by the model's answer, of those that the voices leave; the same again where they leave no other.

        Args:
            logits: (S,) of the frame.
            voiced: speech of agent and user, as the model is told it.
            before: that of the frame before.
            uniforms: (2,) in 0..1: which state, and for how long.
        """
        possible = self.possible[int(voiced[0]), int(voiced[1])] > 0  # (7,)
        if before.left > 0 and possible[before.state]:
            return Sojourn(before.state, before.left - 1)
        possible[before.state] &= not bool(possible.sum() > 1)
        chances = logits[: len(STATES)].double().masked_fill(~possible, -torch.inf).softmax(-1).cumsum(-1)
        state = int((chances <= uniforms[0] * chances[-1]).sum().clamp(max=len(STATES) - 1))
        place = float(uniforms[1]) * (QUANTILES - 1)
        low, high = self.durations[state, int(place)], self.durations[state, min(int(place) + 1, QUANTILES - 1)]
        return Sojourn(state, max(0, round(float(low + (place % 1) * (high - low))) - 1))
