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


# --- Soft dynamic time warping (Cuturi and Blondel, ICML 2017): a DTW whose minima are soft, so that it has a gradient
#
# The predictor's loss takes it on the keyframe indicator (IV-D3, "binary soft dynamic time warping"): a keyframe that
# is
# expected one frame late costs less than one that is not expected at all. The paper gives neither smoothing nor weight.


def soft_dtw(cost: Tensor, gamma: float) -> Tensor:
    """Least summed cost of a path through cost (B, T, U), from corner to corner, with soft minima -> (B,).

    Steps (1, 0), (0, 1), (1, 1), full window. As `gamma` goes to 0 it becomes DTW; above 0 it lies below it. The paths
    are summed along anti-diagonals, so that the batch and each diagonal go at once.
    """
    if gamma <= 0:
        raise ValueError(f"gamma {gamma:g} must be above 0")
    b, rows, columns = cost.shape
    # One frame of infinity around the path sums; diagonal d holds cells (i, d - i) by i, shifted by that frame.
    far = torch.full((b, rows + 1), torch.inf, dtype=cost.dtype, device=cost.device)
    before, last = far, far
    row = torch.arange(rows, device=cost.device)
    for diagonal in range(rows + columns - 1):
        column = diagonal - row
        inside = (column >= 0) & (column < columns)
        here = cost[:, row, column.clamp(0, columns - 1)]  # (B, T)
        if diagonal:
            three = torch.stack([last[:, 1:], last[:, :-1], before[:, :-1]])  # from the left, above, both
            here = here + _soft_min(three, gamma)
        now = torch.where(inside, here, torch.inf)
        before, last = last, torch.cat([far[:, :1], now], dim=1)
    return last[:, rows]


def _soft_min(values: Tensor, gamma: float) -> Tensor:
    """Over the first dimension; infinite where all of them are, without a gradient that is not a number."""
    some = values.isfinite().any(0)
    safe = torch.where(some, values, 0.0)
    return torch.where(some, -gamma * torch.logsumexp(-safe / gamma, dim=0), torch.inf)


def keyframe_dtw(expected: Tensor, target: Tensor, gamma: float) -> Tensor:
    """Mean soft-DTW per frame between keyframe probabilities and indicators (B, H, G), each group a sequence."""
    p, y = (one.transpose(1, 2).flatten(0, 1) for one in (expected, target))  # (B G, H)
    cost = (p[:, :, None] - y[:, None, :]) ** 2
    return soft_dtw(cost, gamma).mean() / target.shape[1]
