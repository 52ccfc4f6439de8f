"""Progressive motion prediction (3.4): coarse motion from sound, fine motion from context and state, continuity.

The outcome z conditions the sampler of the final motion (`diffusion`, or `codes` in the discrete ablation).
"""

from __future__ import annotations

import torch
from torch import Tensor

from sfms_robot.listeners.arig.parts import CrossAttention, LayerNorm, Part


class Progressive(Part):
    """Three looks: at the agent's last sounds, at (cis-token, state, sound of now), at its last motions.

    What happens (`events`, beyond the paper) is one token more of the second.
    """

    def __init__(
        self, width: int, hidden: int, heads: int, sounds: int, motions: int, states: bool, events: bool = False
    ) -> None:
        super().__init__()
        self.coarse = CrossAttention(width, hidden, heads, sounds)
        self.fine = CrossAttention(width, hidden, heads, 2 + states + events)
        self.temporal = CrossAttention(width, hidden, heads, motions)
        self.norm = LayerNorm(width)

    def forward(
        self,
        last: Tensor,
        sound_keys: Tensor,
        motion_keys: Tensor,
        sound: Tensor,
        cis: Tensor,
        state: Tensor | None,
        events: Tensor | None = None,
    ) -> Tensor:
        """`coarse` motion, then `refine`: everything of the frame to be made, N of them.

        `last` (N, D) is the embedded motion of the frame before: the query of the coarse motion. `sound_keys`
        (N, 3, 2D) are `coarse.keys` of the agent's sounds, the newest that of the frame itself. The rest: `refine`.
        """
        return self.refine(self.coarse(last, sound_keys), motion_keys, sound, cis, state, events)

    def refine(
        self,
        outline: Tensor,
        motion_keys: Tensor,
        sound: Tensor,
        cis: Tensor,
        state: Tensor | None,
        events: Tensor | None = None,
    ) -> Tensor:
        """Fine motion.

        Args:
            outline: (N, D) coarse motion.
            motion_keys: (N, 5, 2D) `temporal.keys` of the agent's motions before the frame.
            sound: (N, D) embedded sound of the agent in the frame itself.
            cis: (N, D).
            state: (N, D) feature, or None without state guidance.
            events: (N, D) embedded control rows, or None without events.

        Returns:
            z (N, D).
        """
        tokens = [token for token in (cis, state, sound, events) if token is not None]
        x = self.fine(outline, self.fine.keys(torch.stack(tokens, dim=1)))
        out: Tensor = self.norm(self.temporal(x, motion_keys))
        return out
