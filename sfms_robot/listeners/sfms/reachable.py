"""How soon one keyframe may follow another: no channel moves faster than it ever did in the training motion.

Frames are drawn one at a time from probabilities that never quite reach zero; without this rule two codes far apart
may end up in neighbouring frames, which no head can follow and no face does.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sfms_robot.listeners.sfms.model import SfmsModel


class Reach:
    """Frames needed from each token to each other one, per group, V = codes of the largest group."""

    @torch.no_grad()
    def __init__(self, model: SfmsModel) -> None:
        quantizer = model.tokenizer.quantizer
        sizes = quantizer.levels.prod(-1).long()
        indices = torch.arange(int(sizes.max()))[:, None] % sizes  # (V, G)
        motion = quantizer.decode(quantizer.codes(indices)[None])[0]  # (V, C)
        # By token: class 0 may always follow, and anything may follow class 0, which is no keyframe yet.
        self.needed = torch.zeros(len(sizes), 1 + len(indices), 1 + len(indices))
        for group, size in enumerate(sizes.tolist()):
            needed = self.needed[group, 1:, 1:]
            for channel in quantizer.member[group].nonzero()[:, 0].tolist():
                value = motion[:, channel]
                frames = (value[:, None] - value[None, :]).abs_().div_(model.motion_speed[channel])
                torch.maximum(needed, frames, out=needed)
            self.needed[group, :, 1 + size :] = torch.inf
        self._groups = torch.arange(len(sizes))

    def too_soon(self, last: Tensor, gap: Tensor) -> Tensor:
        """Tokens (..., G) of the last keyframes (0: none), frames since -> classes (..., G, V + 1) out of reach."""
        return self.needed[self._groups, last] > gap[..., None]
