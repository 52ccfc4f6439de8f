"""How soon one keyframe may follow another: no channel moves faster than it ever did in the training motion.

Frames are drawn one at a time from probabilities that never quite reach zero; without this rule two codes far apart
may end up in neighbouring frames, which no head can follow and no face does.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.quantizer import indices_to_codes


class Reach:
    """Frames needed from each code to each other one, per group, V = codes of the largest group."""

    @torch.no_grad()
    def __init__(self, model: SfmsModel) -> None:
        quantizer = model.tokenizer.quantizer
        sizes = quantizer.levels.prod(-1).long()
        indices = torch.arange(int(sizes.max()))[:, None] % sizes  # (V, G)
        motion = quantizer.decoder(indices_to_codes(indices, quantizer.levels)[None])[0]  # (V, G, C)
        self.needed = torch.zeros(len(sizes), len(indices), len(indices))
        for group, size in enumerate(sizes.tolist()):
            for channel in quantizer.member[group].nonzero()[:, 0].tolist():
                value = motion[:, group, channel]
                frames = (value[:, None] - value[None, :]).abs() / model.motion_speed[channel]
                self.needed[group] = torch.maximum(self.needed[group], frames)
            self.needed[group, :, size:] = torch.inf

    def allowed(self, last: Tensor, gap: Tensor) -> Tensor:
        """Tokens (G,) of the last keyframes (0: none) and frames (G,) since -> (G, V + 1) bool; class 0 always is."""
        groups = torch.arange(len(last))
        reachable = self.needed[groups, (last - 1).clamp(min=0)] <= gap[:, None]
        reachable = reachable | (last == 0)[:, None]
        return torch.cat([torch.ones(len(last), 1, dtype=torch.bool), reachable], dim=1)
