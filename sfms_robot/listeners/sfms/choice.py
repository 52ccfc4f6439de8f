"""Keyframes chosen one after another by conditional scores, and each chosen anew once all are there.

Algorithm 1 of the paper with one change: its lines 9 and 10 take the frame just chosen out of the same scores; here the
scores are asked again at each of the k steps. Two uses of one network: told how many keyframes are to come it spends
them as a whole (`learned`), not told it makes every prefix of the order a good code (`nested`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sfms_robot.listeners.sfms.exact import mask_cost
from sfms_robot.listeners.sfms.score import ConditionalScore, Tracks


@dataclass(frozen=True)
class Choice:
    """Keyframes of N tracks.

    Attributes:
        mask: (N, T), k ones each.
        order: (N, K) frames, first chosen first; -1 behind a track's own k.
    """

    mask: Tensor
    order: Tensor


@torch.no_grad()
def choose(score: ConditionalScore, track: Tracks, k: Tensor, *, told: bool = True) -> Choice:
    """k (N,) keyframes of each track, one at a time, the highest score each time.

    `told`: whether the scores know how many are to come.
    """
    n, t, _ = track.curves.shape
    mask = track.curves.new_zeros(n, t)
    order = torch.full((n, int(k.max())), -1, device=mask.device)
    for step in range(order.shape[1]):
        wanted = step < k
        remaining = torch.where(wanted, k - step, 1) if told else torch.zeros_like(k)
        picked = score(track, mask, remaining).argmax(1)
        mask = torch.where(wanted[:, None], mask.scatter(1, picked[:, None], 1.0), mask)
        order[:, step] = torch.where(wanted, picked, -1)
    return Choice(mask, order)


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
