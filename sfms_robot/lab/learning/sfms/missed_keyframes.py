"""Keyframes that a roll-out misses, and that training therefore has to miss now and then.

Teacher forcing never shows the predictor a face that should have come back and has not: a lid whose opening was not
drawn, a nod that has lost its last swing. In a roll-out that happens, and such a face would stay until some later
keyframe. So the last keyframes before the first frame to draw are left out now and then, and where what is then shown
is off by more than a keyframe costs, the right answer is one at once: the face as it is there.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sfms_robot.listeners.sfms.predictor import last_keyframes

MISSED_FRAMES = 6  # before the first to draw


def without_last_keyframes(
    tokens: Tensor,
    dense: Tensor,
    motion: Tensor,
    first: Tensor,
    member: Tensor,
    costs: Tensor,
    share: float,
    generator: torch.Generator,
) -> Tensor:
    """Tokens (B, T, G) of which a `share` of groups has missed its last keyframes and is put right in frame `first`.

    Args:
        tokens: what was meant; dense: (B, T, G) what each frame's keyframe would be.
        motion: (B, T, C) standardised; member: (G, C); costs: (G,) of a keyframe, in squared units of the motion.
        first: (B,) the first frame to draw, above 0.
    """
    b, t, groups = tokens.shape
    row, frame = torch.arange(b, device=tokens.device)[:, None], torch.arange(t, device=tokens.device)
    recent = (frame >= first[:, None] - MISSED_FRAMES) & (frame < first[:, None])
    chosen = torch.rand(b, 1, groups, generator=generator).to(tokens.device) < share
    left = torch.where(recent[..., None] & chosen, 0, tokens)
    last = last_keyframes(left).at[row[:, 0], first - 1][..., 0]  # (B, G)
    off = motion[row, last.clamp(min=0)] - motion[row[:, 0], first][:, None]  # (B, G, C)
    wrong = (last >= 0) & ((off**2 * member).sum(-1) > costs) & (left != tokens).any(1)
    left[row[:, 0], first] = dense[row[:, 0], first]
    return torch.where(wrong[:, None], left, tokens)
