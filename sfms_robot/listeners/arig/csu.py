"""Conversation states understanding (3.3): which of seven states the agent is in, and a feature of it.

Voice activity alone tells four patterns; which state a pattern means depends on the conversation (figure 3):

| agent | user | states |
|---|---|---|
| speaks | silent | speaking |
| speaks | speaks | receiving feedback, interrupted |
| silent | speaks | listening, giving feedback |
| silent | silent | thinking (its own pause), waiting (the other's) |

The figure itself is not in the text at hand; giving feedback, where it is a word and not a nod, is speech of both.

The paper's stream goes on from its most probable state. A listener with events departs from it twice, see `sojourns`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sfms_robot.config.arig import EVENT_STATES, STATES
from sfms_robot.listeners.arig.parts import CrossAttention, LayerNorm, Linear, Part
from sfms_robot.listeners.arig.sojourns import QUANTILES


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
