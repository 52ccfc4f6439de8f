"""Straight lines between keyframes: the values on them, their errors, and the masks with the least error.

`Neighbours` are the keyframes before and after each frame; the inpainter interpolates between them, and so does every
error here: a line between two keyframes, held before the first and after the last. `Segments` are the squared errors
of all stretches between two keyframes. The error of a mask is the sum over its stretches, so the best mask is a
cheapest path, found by dynamic programming: of k keyframes (`best_frames`), of 1..K keyframes through given frames
(`completion_errors`), or of those that each save more error than they cost (`place_penalised`).

All of this is ours, because the quality of a learned placement (IV-B2) has to be measured; the paper compares with
even spacing alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

POSITION_BITS = 6  # distances to the neighbouring keyframes up to 63 frames, as binary digits


class Around(NamedTuple):
    """Keyframes in tokens (B, T, G), as `draw.around` finds them before a network sees the tokens.

    Attributes:
        before, after: (B, T, G) as for `Neighbours.at`.
        rows: (B, K) frames that hold a keyframe of any group, as rows of (B * T).
        seen: (B, K) which of `rows` count; the others fill up K.
        places: (B, T) place of each such frame in `rows`, as a row of (B * K); arbitrary for other frames.
    """

    before: Tensor
    after: Tensor
    rows: Tensor
    seen: Tensor
    places: Tensor


def nearest_keys(mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return the last keyframe at or before each frame of a mask (B, T, ...), -1 for none, and the next, T for none."""
    t = mask.shape[1]
    frame = torch.arange(t, device=mask.device).view(-1, *[1] * (mask.dim() - 2))
    before = torch.where(mask > 0.5, frame, -1).cummax(1).values
    return before, torch.where(mask > 0.5, frame, t).flip(1).cummin(1).values.flip(1)


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """For every frame and group, the keyframe before (or at) it and the keyframe after it.

    Before the first and after the last keyframe the nearest one is held.

    Attributes:
        frame: (T, 1) number of each frame.
        before, after: (B, T, G) frames of the two keyframes.
        has_before, has_after: (B, T, G) bool.
        ramp: a line to a keyframe begins at most this many frames before it, and the keyframe before is held until
            then; None: a line all the way, as in the paper. Ours, because a stream draws its keyframes a few frames
            ahead: a line that begins earlier would jump when its end is drawn.
    """

    frame: Tensor
    before: Tensor
    after: Tensor
    has_before: Tensor
    has_after: Tensor
    ramp: int | None = None

    @classmethod
    def in_mask(cls, mask: Tensor, ramp: int | None = None) -> Neighbours:
        """Return the neighbours in a mask (B, T, G)."""
        return cls.at(*nearest_keys(mask), ramp)

    @classmethod
    def at(cls, before: Tensor, after: Tensor, ramp: int | None = None) -> Neighbours:
        """Return neighbours from the keyframes (B, T, G) at or before each frame (-1: none) and at or after (T)."""
        t = before.shape[1]
        frame = torch.arange(t, device=before.device)[:, None]
        has_before, has_after = before >= 0, after < t
        return cls(
            frame=frame,
            before=torch.where(has_before, before, after).clamp(0, t - 1),
            after=torch.where(has_after, after, before).clamp(0, t - 1),
            has_before=has_before,
            has_after=has_after,
            ramp=ramp,
        )

    def last(self, frames: int) -> Neighbours:
        """Return the neighbours of only the last `frames` frames."""
        return Neighbours(
            before=self.before[:, -frames:],
            after=self.after[:, -frames:],
            has_before=self.has_before[:, -frames:],
            has_after=self.has_after[:, -frames:],
            frame=self.frame[-frames:],
            ramp=self.ramp,
        )

    @property
    def since(self) -> Tensor:
        """Return the frames (B, T, G) since the keyframe before."""
        return (self.frame - self.before).clamp(min=0)

    @property
    def until(self) -> Tensor:
        """Return the frames (B, T, G) until the keyframe after."""
        return (self.after - self.frame).clamp(min=0)

    @cached_property
    def weight(self) -> Tensor:
        """Return the weight (B, T, G) of the keyframe after: 0 at the keyframe before, 1 at the keyframe after."""
        # Share of the way from the keyframe before (0) to the one after (1); held until the ramp begins.
        begin = self.before if self.ramp is None else torch.maximum(self.before, self.after - self.ramp)
        span = (self.after - begin).clamp(min=1)
        return ((self.frame - begin) / span).clamp(0.0, 1.0)

    def interpolate(self, values: Tensor) -> Tensor:
        """Return (B, T, G, D) on the lines between values (B, S, G, D) at keyframes, for the T frames of `frame`."""
        index = [i[..., None].expand(-1, -1, -1, values.shape[-1]) for i in (self.before, self.after)]
        first, second = (values.gather(1, i) for i in index)
        return first + (second - first) * self.weight[..., None]

    def positions(self) -> Tensor:
        """Return binary sliding positions (B, T, G, 2 * bits + 3): T^tf of equation (10)."""
        # IV-B5: T^tf as a binary vector, so that one more frame changes the input clearly; ours: to both neighbours.
        powers = 2 ** torch.arange(POSITION_BITS, device=self.before.device)
        bits = (torch.stack([self.since, self.until], dim=-1)[..., None] & powers) > 0
        ends = torch.stack([self.has_before.to(self.weight), self.has_after.to(self.weight), self.weight], dim=-1)
        return torch.cat([bits.flatten(-2).to(ends), ends], dim=-1)


# --- Errors of all stretches, and the best k keyframes ----------------------------------------------------------------


class Segments(NamedTuple):
    """Squared errors of the stretches of N tracks of T frames.

    Attributes:
        inside: (N, T, T) between keyframes i < j; infinite where j <= i.
        before: (N, T) of holding j back to the start; after: (N, T) of holding i to the end.
    """

    inside: Tensor
    before: Tensor
    after: Tensor

    def through(self, chosen: Tensor) -> Segments:
        """Return the errors with infinity for stretches that pass over any of the `chosen` frames (N, T)."""
        seen = chosen.cumsum(-1)  # chosen frames up to and including t
        ahead = seen - chosen
        passed = ahead[:, None, :] - seen[:, :, None] > 0.5  # strictly between i and j
        return Segments(
            self.inside.masked_fill(passed, torch.inf),
            self.before.masked_fill(ahead > 0.5, torch.inf),
            self.after.masked_fill(seen[:, -1:] - seen > 0.5, torch.inf),
        )


def segments(x: Tensor, max_gap: int | None = None) -> Segments:
    """Return the errors of every stretch of tracks x (N, T, c), straight lines all the way.

    `max_gap`: frames of the longest stretch, also to both ends; None for no bound.
    """
    most = x.shape[1] if max_gap is None else max_gap
    before, band, after = stretches(x, most)
    frame = torch.arange(x.shape[1], device=x.device)
    gap = frame - frame[:, None]  # j - i
    inside = band[:, frame, gap.clamp(0, most)]  # [i, j] = band[j, j - i]
    return Segments(inside.masked_fill((gap <= 0) | (gap > most), torch.inf), before, after)


def best_frames(cost: Segments, count: int) -> Tensor:
    """Return the frames (N, count) of the best `count` keyframes.

    best[j] = min_i best[i] + inside[i, j], `count` - 1 times; the way back from the cheapest end gives the frames.
    """
    # best[j]: least error up to j of the keyframes placed so far, the last of them at j.
    best, parents = cost.before, []
    for _ in range(count - 1):
        best, parent = (best[:, :, None] + cost.inside).min(dim=1)
        parents.append(parent)
    path = [(best + cost.after).argmin(dim=1, keepdim=True)]
    for parent in reversed(parents):
        path.append(parent.gather(1, path[-1]))
    return torch.cat(path[::-1], dim=1)


def completion_errors(cost: Segments, chosen: Tensor, most: int) -> Tensor:
    """Return the error (N, most, T) of the best mask of 1..`most` keyframes with the `chosen` frames and frame t.

    `chosen`: (N, T). Infinite where that many keyframes cannot include them all. The best next keyframe is where this
    is smallest. ahead[m][t] is the least error up to t of m keyframes that end with t, behind[m][t] that from t on;
    two paths that meet at t count it twice: k = m + m' - 1.
    """
    allowed = cost.through(chosen)
    ahead, behind = [allowed.before], [allowed.after]
    for _ in range(most - 1):
        ahead.append((ahead[-1][:, :, None] + allowed.inside).amin(dim=1))
        behind.append((allowed.inside + behind[-1][:, None, :]).amin(dim=2))
    # Of k keyframes, m stand up to t and k + 1 - m from t on; the best split counts.
    forward, backward = torch.stack(ahead, 1), torch.stack(behind, 1)  # (N, most, T)
    totals = [(forward[:, :k] + backward[:, :k].flip(1)).amin(dim=1) for k in range(1, most + 1)]
    return torch.stack(totals, 1)


def mask_cost(cost: Segments, mask: Tensor) -> Tensor:
    """Return the error (N,) of a mask (N, T): the sum over its stretches, infinite for a mask without keyframes."""
    # Each keyframe counts the error of the stretch that ends with it, the last one also that of the frames after it.
    key, last = mask > 0.5, nearest_keys(mask)[0]
    previous = F.pad(last[:, :-1], (1, 0), value=-1)
    between = cost.inside.gather(1, previous.clamp(min=0)[:, None])[:, 0]
    at_key = torch.where(previous >= 0, between, cost.before)
    behind = cost.after.gather(1, last[:, -1:].clamp(min=0))[:, 0]
    total = torch.where(key, at_key, 0.0).sum(1) + behind
    return total.masked_fill(~key.any(1), torch.inf)


# --- As many keyframes as pay for themselves --------------------------------------------------------------------------
#
# In the paper every window has the same number of keyframes. Motion far away then decides about keyframes here: a nod
# takes them from the stillness around it and from the next second's smile. With a cost per keyframe, a keyframe is
# placed where it saves more error than it costs, wherever the others are: none in stillness except those that `max_gap`
# requires, many in a nod, and the two sides of a keyframe that two motions share are placed in the same way.
#
#     best[j] = cost + min(before[j], min_i best[i] + stretch[i, j])
#
# `stretch[i, j]` is the error between keyframes i and j of `Neighbours.interpolate`: keyframe i is held until the ramp
# begins at frame b = j - r, r = min(ramp, j - i), then a straight line. With u = max(0, s - b) / r,
#
#     stretch[i, j] = sum over i < s <= j of |x_s - (1 - u) x_i - u x_j|^2
#                   = (sum |x_s|^2 - 2 <x_j, sum u x_s> + ww |x_j|^2)        depends on j, except for the sum's start
#                     + (j - i - r + vv) |x_i|^2 - 2 <x_i, sum x_s - sum u x_s - mixed x_j>
#
# with ww = sum u^2, mixed = sum u (1 - u), vv = sum (1 - u)^2 over the ramp. With prefix sums, all terms except one
# product <x_i, y[j]> depend on i alone or on j alone: a stretch costs one dot product.


@torch.no_grad()
def place_penalised(
    motion: Tensor, costs: Sequence[float], member: Tensor, max_gap: int | None = None, ramp: int | None = None
) -> Tensor:
    """Return the mask (B, T, G) with the least squared error plus costs of its keyframes, at least one per group.

    Args:
        motion: (B, T, C); scale the channels by how much each matters.
        costs: (G,) cost of a keyframe, above 0, in squared units of the motion summed over a group's channels.
        member: (G, C), 1 where a channel belongs to a group.
        max_gap: at most this many frames from one keyframe to the next and to both ends; None for no bound.
        ramp: see above; None for straight lines all the way.
    """
    t = motion.shape[1]
    gap = t if max_gap is None else min(max_gap, t)
    if not min(costs) > 0:
        raise ValueError(f"keyframe costs: not all above 0: {list(costs)}")
    mask = motion.new_zeros(*motion.shape[:2], len(costs))
    for group, cost in enumerate(costs):
        own = motion[..., member[group] > 0.5].double().cpu()
        for row, frames in enumerate(_cheapest(cost, *stretches(own, gap, ramp))):
            mask[row, frames, group] = 1.0
    return mask


def stretches(x: Tensor, gap: int, ramp: int | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Return the errors of tracks x (N, T, c) in double precision, infinite where a gap is too large.

    Returns:
        Errors (N, T) of holding each frame back to the start; errors (N, T, gap + 1) of the stretch to each frame from
        the keyframe d frames before it, at column d; errors (N, T) of holding each frame to the end.
    """
    t = x.shape[1]
    x = x.double() - x.double().mean(1, keepdim=True)  # keeps the sums small
    frame = torch.arange(t, device=x.device)
    norm = x.square().sum(-1)
    s0, p0, p1 = norm.cumsum(1), x.cumsum(1), (x * frame[:, None]).cumsum(1)
    own = 2 * (x * p0).sum(-1) - s0  # terms of keyframe i alone
    inside = x.new_full((*x.shape[:2], gap + 1), torch.inf)
    for d in range(1, min(gap, t - 1) + 1):
        r = d if ramp is None else min(ramp, d)
        if d == r:  # from d = ramp on the ramp is the same
            u = torch.arange(1, r + 1) / torch.tensor(r, dtype=x.dtype)
            ww, mixed, vv = (float(each.sum()) for each in (u**2, u * (1 - u), (1 - u) ** 2))
            begin = (frame - r).clamp(min=0)
            rising = (p1 - p1[:, begin] - begin[:, None] * (p0 - p0[:, begin])) / r  # sum of u x_s
            y = p0 - rising - mixed * x
            ends = s0 - 2 * (x * rising).sum(-1) + ww * norm  # terms of keyframe j alone
        i, j = slice(0, t - d), slice(d, t)
        inside[:, j, d] = ends[:, j] + own[:, i] + (d - r + vv) * norm[:, i] - 2 * (x[:, i] * y[:, j]).sum(-1)
    before = (frame + 1) * norm - own
    after = s0[:, -1:] - s0 - 2 * (x * (p0[:, -1:] - p0)).sum(-1) + (t - 1 - frame) * norm
    before = before.masked_fill(frame > gap, torch.inf)
    after = after.masked_fill(t - 1 - frame > gap, torch.inf)
    return before.clamp(min=0), inside.clamp(min=0), after.clamp(min=0)


def _cheapest(cost: float, before: Tensor, inside: Tensor, after: Tensor) -> list[list[int]]:
    """Return the keyframes of every track, last to first, from the `cost` of a keyframe and `stretches`."""
    best, band, ends = before.numpy() + cost, inside.numpy(), after.numpy()
    tracks, t = best.shape
    # parent: the keyframe before j in the cheapest mask with a keyframe at j; -1: j is the first.
    parent, every = np.full((tracks, t), -1), np.arange(tracks)
    for j in range(1, t):
        first = max(0, j - band.shape[2] + 1)
        options = best[:, first:j] + band[:, j, j - first : 0 : -1]
        i = options.argmin(axis=1)
        total = options[every, i] + cost
        better = total < best[:, j]
        best[better, j], parent[better, j] = total[better], first + i[better]
    chosen: list[list[int]] = []
    for track, at in enumerate((best + ends).argmin(axis=1).tolist()):
        chosen.append([])
        while at >= 0:
            chosen[-1].append(at)
            at = int(parent[track, at])
    return chosen
