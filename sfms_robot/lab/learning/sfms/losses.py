"""Losses of both phases, with the paper's equation numbers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F


def reconstruction(
    motion: Tensor, restored: Tensor, at_keyframes: Tensor, mask: Tensor, member: Tensor, velocity: float
) -> Tensor:
    """L2 + the first part of L2^Q of equation (13), and, beyond the paper, `velocity` times the error of the steps.

    The velocity term keeps movement between coarse codes from having corners. ||z^kf - z^kf^|| is taken in motion
    space: the error of the codes alone, at the keyframes. The stop-gradient terms of L2^Q are the codebook's
    (`Grid.commitment`, `Codebook.commitment`), since only it knows whether anything can move.

    Args:
        motion, restored, at_keyframes: (B, T, C); the last decoded from each frame's own code.
        mask: (B, T, G); member: (G, C).
    """
    weight = mask.detach() @ member  # (B, T, C)
    keyframes = ((motion - at_keyframes) ** 2 * weight).sum() / weight.sum().clamp(min=1.0)
    steps = F.mse_loss(restored.diff(dim=1), motion.diff(dim=1))
    return F.mse_loss(restored, motion) + keyframes + velocity * steps


def masking(relaxed: Tensor, best: Tensor) -> Tensor:
    """L1^mask of equation (13): relaxed k-hot (B, T, G) against the mask of the best reconstruction drawn."""
    return (relaxed - best.detach()).abs().sum(1).mean()


def next_tokens(
    logits: Sequence[Tensor],
    target: Tensor,
    counted: Tensor,
    transition_weight: float,
    group_weights: Sequence[float],
) -> Tensor:
    """Equation (14): weighted cross-entropy, class 0 weighing `transition_weight` and a keyframe 1; mean over groups.

    Args:
        logits: per group (B, H, V_g + 1).
        target: (B, H, G) classes.
        counted: (B, H) bool: frames that were to be predicted.
    """
    total = torch.zeros(())
    for group, values in enumerate(logits):
        truth = target[..., group][counted]
        weight = torch.where(truth == 0, transition_weight, 1.0)
        loss = F.cross_entropy(values[counted], truth, reduction="none")
        total = total + group_weights[group] * (loss * weight).sum() / weight.sum()
    return total / sum(group_weights)
