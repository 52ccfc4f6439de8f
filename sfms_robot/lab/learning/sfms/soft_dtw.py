"""Soft dynamic time warping (Cuturi and Blondel, ICML 2017): a DTW whose minima are soft, so that it has a gradient.

The predictor's loss takes it on the keyframe indicator (IV-D3, "binary soft dynamic time warping"): a keyframe that is
expected one frame late costs less than one that is not expected at all. The paper gives neither smoothing nor weight.
"""

from __future__ import annotations

import torch
from torch import Tensor


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
