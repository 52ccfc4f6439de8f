"""Keyframes chosen one after another by conditional scores, and each chosen anew once all are there.

Algorithm 1 of the paper with one change: its lines 9 and 10 take the frame just chosen out of the same scores; here the
scores are asked again at each of the k steps, told how many keyframes are still to come.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sfms_robot.listeners.sfms.exact import mask_cost
from sfms_robot.listeners.sfms.score import ConditionalScore, Tracks


@torch.no_grad()
def choose(score: ConditionalScore, track: Tracks, k: Tensor) -> Tensor:
    """Mask (N, T) of k (N,) keyframes of each track, one at a time, the highest score each time."""
    n, t, _ = track.curves.shape
    mask = track.curves.new_zeros(n, t)
    for step in range(int(k.max())):
        wanted = step < k
        picked = score(track, mask, torch.where(wanted, k - step, 1)).argmax(1)
        mask = torch.where(wanted[:, None], mask.scatter(1, picked[:, None], 1.0), mask)
    return mask


@torch.no_grad()
def sweep(score: ConditionalScore, track: Tracks, mask: Tensor, together: int = 1) -> Tensor:
    """Take out `together` neighbouring keyframes of a mask (N, T) at a time, left to right, and choose them anew.

    A change is kept where it makes the error of linear interpolation smaller, so a sweep never makes a mask worse.
    """
    cost = mask_cost(track.cost, mask)
    frame = torch.arange(mask.shape[1], device=mask.device)
    most = int(mask.sum(1).max())
    for first in range(max(1, most - together + 1)):
        rank = mask.cumsum(1) * mask  # 1 for the leftmost keyframe
        out = (rank > first) & (rank <= first + together)
        redone, missing = mask * ~out, out.sum(1)
        for step in range(min(together, most)):
            remaining = missing - step
            best = score(track, redone, remaining.clamp(min=1)).argmax(1, keepdim=True)
            redone = redone + ((frame == best) & (remaining > 0)[:, None])
        new = mask_cost(track.cost, redone)
        better = new < cost
        mask = torch.where(better[:, None], redone, mask)
        cost = torch.where(better, new, cost)
    return mask
