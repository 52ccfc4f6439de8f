"""As few keyframes as a window needs (IV-B3): one model, a nested order, a tolerance.

The paper keeps k fixed because a learned threshold oscillates and a sparsity loss collapses. Neither is needed: the
nested order ranks the frames once, every prefix of it is a code, and how good a prefix is can simply be tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import nested_order
from sfms_robot.listeners.sfms.score import ConditionalScore


@dataclass(frozen=True)
class Prefixes:
    """What every number of keyframes costs a window.

    Attributes:
        order: (B, K, G) frames, the most wanted first.
        errors: (B, K, G) mean squared error, standardised, over a group's channels, with the first 1..K keyframes.
    """

    order: Tensor
    errors: Tensor

    def masks(self, k: Tensor, frames: int) -> Tensor:
        """Mask (B, frames, G) of the first k (B, G) keyframes."""
        most = self.order.shape[1]
        wanted = torch.arange(most, device=k.device)[:, None] < k[:, None]  # (B, K, G)
        blank = torch.zeros(k.shape[0], frames, k.shape[1], device=k.device)
        return blank.scatter_add(1, self.order, wanted.float())


@torch.no_grad()
def prefixes(tokenizer: Tokenizer, motion: Tensor, most: int) -> Prefixes:
    """Try 1..`most` keyframes on motion (B, T, C), standardised.

    Raises ValueError when the tokenizer has no conditional scores (placement learned or nested).
    """
    if not isinstance(tokenizer.score, ConditionalScore):
        raise ValueError("adaptive keyframes need a tokenizer with placement learned or nested")
    member = tokenizer.member
    order = nested_order(motion, most, member, tokenizer.score)
    tried = Prefixes(order, motion.new_empty(0))
    codes = tokenizer.quantizer.encode(motion)
    errors = []
    for k in range(1, most + 1):
        counts = torch.full((len(motion), len(member)), k, device=motion.device)
        restored = tokenizer.inpaint(codes, tried.masks(counts, motion.shape[1]))
        errors.append(((restored - motion) ** 2).mean(1) @ member.T / member.sum(1))
    return Prefixes(order, torch.stack(errors, dim=1))


def fewest(errors: Tensor, tolerance: float) -> Tensor:
    """Smallest k (...) whose error (..., K along dim 1) is within `tolerance`; K where none is."""
    good = errors <= tolerance
    first = good.long().argmax(1) + 1
    return torch.where(good.any(1), first, errors.shape[1])


@torch.no_grad()
def encode_adaptive(
    tokenizer: Tokenizer, motion: Tensor, tolerance: float, most: int = 12, per_group: bool = True
) -> tuple[Tensor, Tensor]:
    """Mask (B, T, G) with the fewest keyframes that keep the error within `tolerance`, and how many (B, G).

    Args:
        tolerance: mean squared error in standardised units, of each group (`per_group`), else of the whole window with
            one number for all its groups.
        most: keyframes of a group whose error stays above the tolerance whatever is tried.
    """
    tried = prefixes(tokenizer, motion, most)
    errors = tried.errors
    if not per_group:
        share = tokenizer.member.sum(1) / tokenizer.member.sum()
        errors = (errors @ share)[..., None].expand_as(errors)
    k = fewest(errors, tolerance)
    return tried.masks(k, motion.shape[1]), k
