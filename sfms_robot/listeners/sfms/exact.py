"""The best keyframes of a window by dynamic programming, alone or beside keyframes that are already chosen.

The error is that of linear interpolation between keyframes, held at both ends. `segments` knows the error of every
stretch between two keyframes from the Gram matrix of the frames; a mask's error is the sum along its keyframes, so the
best mask is a cheapest path, and the best mask through a given frame two of them that meet there.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Segments:
    """Squared errors of the stretches of N tracks of T frames.

    Attributes:
        inside: (N, T, T) between keyframes i < j; infinite where j <= i.
        before: (N, T) of holding j back to the start; after: (N, T) of holding i to the end.
    """

    inside: Tensor
    before: Tensor
    after: Tensor

    def bounded(self, max_gap: int) -> Segments:
        """No two keyframes, and no keyframe and end, more than `max_gap` frames apart."""
        t = self.before.shape[-1]
        frame = torch.arange(t, device=self.before.device)
        return Segments(
            self.inside.masked_fill(frame[None, :] - frame[:, None] > max_gap, torch.inf),
            self.before.masked_fill(frame > max_gap, torch.inf),
            self.after.masked_fill(t - 1 - frame > max_gap, torch.inf),
        )

    def through(self, chosen: Tensor) -> Segments:
        """Only stretches that pass over none of the `chosen` frames (N, T)."""
        seen = chosen.cumsum(-1)  # chosen frames up to and with t
        ahead = seen - chosen
        passed = ahead[:, None, :] - seen[:, :, None] > 0.5  # strictly between i and j
        return Segments(
            self.inside.masked_fill(passed, torch.inf),
            self.before.masked_fill(ahead > 0.5, torch.inf),
            self.after.masked_fill(seen[:, -1:] - seen > 0.5, torch.inf),
        )


def segments(gram: Tensor) -> Segments:
    """Errors of every stretch from the Gram matrix (N, T, T) of the frames.

    With w = (s - i) / (j - i) the frame between is (1 - w) x_i + w x_j, so its squared error is a sum of Gram entries
    weighted by 1, s and s^2; prefix sums over s make every stretch O(1).
    """
    t = gram.shape[-1]
    s = torch.arange(t, dtype=gram.dtype, device=gram.device)
    square = gram.diagonal(dim1=-2, dim2=-1)  # |x_s|^2, (N, T)
    p0, p1 = gram.cumsum(-2), (gram * s[:, None]).cumsum(-2)  # sums over frames s of <x_s, x_i> and s <x_s, x_i>
    norm = square.cumsum(-1)

    own0, own1 = p0.diagonal(dim1=-2, dim2=-1), p1.diagonal(dim1=-2, dim2=-1)  # at s = i
    # Sums over i < s <= j, as matrices (i, j); the interpolation error is zero at s = j, so j may be included.
    sum0_i = p0.transpose(-1, -2) - own0[..., :, None]  # of <x_s, x_i>
    sum1_i = p1.transpose(-1, -2) - own1[..., :, None]
    sum0_j = own0[..., None, :] - p0  # of <x_s, x_j>
    sum1_j = own1[..., None, :] - p1
    n = (s[None, :] - s[:, None]).clamp(min=1.0)  # j - i
    i = s[:, None]
    w_i = sum0_i - (sum1_i - i * sum0_i) / n  # sum of (1 - w) <x_s, x_i>
    w_j = (sum1_j - i * sum0_j) / n  # sum of w <x_s, x_j>
    ww = (n + 1) * (2 * n + 1) / (6 * n)  # sum of w^2 over s = i + 1 .. j
    w1w = (n + 1) / 2 - ww  # sum of w (1 - w)
    vv = n - (n + 1) + ww  # sum of (1 - w)^2
    error = norm[..., None, :] - norm[..., :, None] - 2 * w_i - 2 * w_j
    error = error + vv * square[..., :, None] + 2 * w1w * gram + ww * square[..., None, :]
    inside = error.clamp(min=0.0).masked_fill(s[None, :] <= s[:, None], torch.inf)

    total0 = p0[..., -1, :]  # sum over all s of <x_s, x_i>
    before = norm - 2 * own0 + (s + 1) * square
    after = norm[..., -1:] - norm - 2 * (total0 - own0) + (t - 1 - s) * square
    return Segments(inside, before.clamp(min=0.0), after.clamp(min=0.0))


def best_frames(cost: Segments, count: int) -> Tensor:
    """Frames (N, count) of the best `count` keyframes.

    best[j] = min_i best[i] + inside[i, j], `count` - 1 times; the way back from the cheapest end gives the frames.
    """
    best, parents = cost.before, []
    for _ in range(count - 1):
        best, parent = (best[:, :, None] + cost.inside).min(dim=1)
        parents.append(parent)
    path = [(best + cost.after).argmin(dim=1, keepdim=True)]
    for parent in reversed(parents):
        path.append(parent.gather(1, path[-1]))
    return torch.cat(path[::-1], dim=1)


def completion_errors(cost: Segments, chosen: Tensor, most: int) -> Tensor:
    """Error (N, most, T) of the best mask of 1..`most` keyframes that holds the `chosen` frames (N, T) and frame t.

    Infinite where that many keyframes cannot hold them all. What to choose next is what this makes smallest.
    """
    allowed = cost.through(chosen)
    ahead, behind = [allowed.before], [allowed.after]
    for _ in range(most - 1):
        ahead.append((ahead[-1][:, :, None] + allowed.inside).amin(dim=1))
        behind.append((allowed.inside + behind[-1][:, None, :]).amin(dim=2))
    forward, backward = torch.stack(ahead, 1), torch.stack(behind, 1)  # (N, most, T): m keyframes up to / from t
    totals = [(forward[:, :k] + backward[:, :k].flip(1)).amin(dim=1) for k in range(1, most + 1)]
    return torch.stack(totals, 1)


def mask_cost(cost: Segments, mask: Tensor) -> Tensor:
    """Error (N,) of a mask (N, T): the sum of its stretches. A mask without keyframes costs infinity."""
    key = mask > 0.5
    t = mask.shape[1]
    frame = torch.arange(t, device=mask.device).expand(mask.shape)
    last = torch.where(key, frame, -1).cummax(1).values
    previous = torch.cat([torch.full_like(last[:, :1], -1), last[:, :-1]], dim=1)
    between = cost.inside.gather(1, previous.clamp(min=0)[:, None])[:, 0]
    at_key = torch.where(previous >= 0, between, cost.before)
    behind = cost.after.gather(1, last[:, -1:].clamp(min=0))[:, 0]
    total = torch.where(key, at_key, 0.0).sum(1) + behind
    return total.masked_fill(~key.any(1), torch.inf)
