"""Where the keyframes go: one question, `place(motion, k, ...) -> mask`, and six answers.

    exact          the mask with the least error of linear interpolation, by dynamic programming
    penalised      as many as pay: least error plus a cost per keyframe, by dynamic programming (`place_penalised`)
    static         evenly, centred
    static_paper   at every floor(N / k)-th frame, the paper's baseline, which leaves the window's end to extrapolation
    learned_paper  the paper's: one look of the score network, Gumbel top-k by Algorithm 1
    learned        ours: conditional scores, asked again at each of the k steps, then swept over (`choose`, `sweep`)

Shapes: B batch, T frames, C channels, G groups; a mask is (B, T, G) with exactly k[g] ones along T, but `penalised`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sfms_robot.frames import Doubles
from sfms_robot.listeners.sfms.exact import best_frames, mask_cost, segments
from sfms_robot.listeners.sfms.score import ConditionalScore, ScoreNetwork, Tracks, tracks

Strategy = Literal["exact", "penalised", "static", "static_paper", "learned_paper", "learned"]
EPSILON = 1e-20  # a chosen frame falls back by 46: more than any two scores differ


def place(
    motion: Tensor,
    k: Sequence[int],
    strategy: Strategy,
    *,
    member: Tensor,
    score: ScoreNetwork | ConditionalScore | None = None,
    max_gap: int | None = None,
    sweeps: int = 0,
    costs: Sequence[float] = (),
    ramp: int | None = None,
) -> Tensor:
    """Keyframe mask (B, T, G) of motion (B, T, C), deterministic: what encoding uses.

    `score` is what the learned strategies ask; `max_gap` bounds `exact` and `penalised`, which asks the `costs` of a
    keyframe per group and the `ramp` of interpolation in place of k; `sweeps` improve `learned`. Raises ValueError when
    a strategy has no score network of its kind, or k does not fit the frames.
    """
    if strategy == "penalised":
        return place_penalised(motion, costs, member, max_gap, ramp)
    if strategy == "exact":
        return place_exact(motion, k, member, max_gap)
    if strategy in ("static", "static_paper"):
        return place_static(motion, k, centred=strategy == "static")
    if strategy == "learned_paper":
        if not isinstance(score, ScoreNetwork):
            raise ValueError("learned_paper placement needs a score network of the paper's kind")
        return place_learned(score(motion), k)[0]
    if not isinstance(score, ConditionalScore):
        raise ValueError(f"{strategy} placement needs a conditional score network")
    return place_conditional(motion, k, member, score, sweeps)


def place_static(motion: Tensor, k: Sequence[int], *, centred: bool = True) -> Tensor:
    """Evenly placed keyframes, the same for every sample."""
    b, t, _ = motion.shape
    mask = motion.new_zeros(b, t, len(k))
    for group, count in enumerate(k):
        _check(count, t)
        if centred:
            index = ((torch.arange(count) + 0.5) * t / count).long()
        else:
            index = torch.arange(count) * (t // count)
        mask[:, index, group] = 1.0
    return mask


def place_learned(
    scores: Tensor, k: Sequence[int], temperature: float = 0.0, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Gumbel top-k by Algorithm 1: (mask, relaxed), both (B, T, G).

    The mask is exactly k-hot going forward and carries the gradient of the relaxed one (line 18). Temperature 0 is
    evaluation: the k largest scores, no noise, no gradient.
    """
    if temperature == 0.0:
        hard = torch.cat([_top_k(scores[..., g], c)[..., None] for g, c in enumerate(k)], dim=-1)
        return hard, hard
    source = scores.device if generator is None else generator.device
    uniform = torch.rand(scores.shape, generator=generator, device=source).to(scores.device).clamp(1e-7, 1 - 1e-7)
    noisy = scores - torch.log(-torch.log(uniform))  # lines 3 to 6
    relaxed = torch.stack([_relaxed_k_hot(noisy[..., g], c, temperature) for g, c in enumerate(k)], dim=-1)
    hard = torch.stack([_top_k(relaxed[..., g], c) for g, c in enumerate(k)], dim=-1)  # lines 14 to 16
    return hard - relaxed.detach() + relaxed, relaxed  # line 18


def _relaxed_k_hot(noisy: Tensor, count: int, temperature: float) -> Tensor:
    """Lines 7 to 13: k softmaxes, each taking out what the ones before have chosen."""
    k_hot, one_hot = torch.zeros_like(noisy), torch.zeros_like(noisy)
    for _ in range(count):
        noisy = noisy + torch.log(torch.clamp(1.0 - one_hot, min=EPSILON))  # lines 9, 10
        one_hot = torch.softmax(noisy / temperature, dim=-1)
        k_hot = k_hot + one_hot
    return k_hot


def _top_k(scores: Tensor, count: int) -> Tensor:
    _check(count, scores.shape[-1])
    return torch.zeros_like(scores).scatter(-1, scores.topk(count, dim=-1).indices, 1.0)


@torch.no_grad()
def place_conditional(
    motion: Tensor, k: Sequence[int], member: Tensor, score: ConditionalScore, sweeps: int = 0
) -> Tensor:
    """Mask of the highest conditional scores, one keyframe after another, then `sweeps` rounds of second thoughts."""
    b, t, _ = motion.shape
    for count in k:
        _check(count, t)
    track = tracks(motion, member, score.curves)
    counts = torch.tensor(k, device=motion.device).repeat(b)
    mask = choose(score, track, counts)
    for number in range(sweeps):
        mask = sweep(score, track, mask, together=1 + number % 2)
    return mask.view(b, len(k), t).transpose(1, 2).contiguous()


def place_exact(motion: Tensor, k: Sequence[int], member: Tensor, max_gap: int | None = None) -> Tensor:
    """The mask with the least squared error of linear interpolation between keyframes, held at both ends.

    Args:
        motion: (B, T, C); scale the channels by how much each matters.
        k: keyframes per group.
        member: (G, C), 1 where a channel belongs to a group.
        max_gap: at most this many frames from one keyframe to the next; None for no bound.
    """
    b, t, _ = motion.shape
    mask = motion.new_zeros(b, t, len(k))
    for group, count in enumerate(k):  # one at a time: the tables of one group fit the processor's cache
        _check(count, t, max_gap)
        own = motion[..., member[group] > 0.5].double()  # errors are small differences
        cost = segments(own @ own.transpose(1, 2))
        frames = best_frames(cost if max_gap is None else cost.bounded(max_gap), count)
        mask[:, :, group] = mask[:, :, group].scatter(1, frames, 1.0)
    return mask


def _check(count: int, frames: int, max_gap: int | None = None) -> None:
    if not 1 <= count <= frames:
        raise ValueError(f"cannot place {count} keyframes in {frames} frames")
    if max_gap is not None and (count + 1) * max_gap < frames - 1:
        raise ValueError(f"{count} keyframes at most {max_gap} frames apart do not span {frames} frames")


# --- One keyframe after another ---------------------------------------------------------------------------------------
#
# Keyframes chosen one by one by conditional scores, then each chosen again once all are there. This is Algorithm 1 of
# the paper with one change: its lines 9 and 10 remove the frame just chosen from the same scores; here the scores are
# computed again at each of the k steps, with the number of keyframes that are still to come.


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


# --- As many keyframes as pay -----------------------------------------------------------------------------------------
#
# The least squared error of interpolation plus a cost per keyframe, by dynamic programming.
#
# The paper gives every window its number of keyframes. Motion far away then decides what is placed here: a nod takes
# keyframes from the stillness around it and from the next second's smile. With a cost (lambda) a keyframe stands
# where it saves more than that, wherever the others stand: none in stillness except those that `max_gap` requires,
# many in a nod, and the two sides of a keyframe that two motions share are placed alike.
#
#     best[j] = cost + min(before[j], min_i best[i] + stretch[i, j])
#
# `stretch[i, j]` is the error between keyframes i and j of `Neighbours.interpolate`: keyframe i is held until `ramp`
# frames before j, then a straight line. A stream draws its keyframes a few frames ahead, so it cannot begin a line
# earlier than that; if labels could, the motion shown would jump onto the line when its end is drawn.
#
# With b = j - r the frame where the line begins, r = min(ramp, j - i), and sums over the frames of the stretch
#
#     stretch[i, j] = sum |x_s|^2 - 2 x_i . (sum of x_s, each as far as i tells it) - 2 x_j . (likewise) + norms
#
# of which all but one product x_i . y_r[j] belongs to i or to j alone: a stretch costs one dot product.


@torch.no_grad()
def place_penalised(
    motion: Tensor, costs: Sequence[float], member: Tensor, max_gap: int | None = None, ramp: int | None = None
) -> Tensor:
    """The mask with the least squared error and `costs` per keyframe of each group; at least one keyframe per group.

    Args:
        motion: (B, T, C); scale the channels by how much each matters.
        costs: (G,) of a keyframe, above 0, in squared units of the motion summed over a group's channels.
        member: (G, C), 1 where a channel belongs to a group.
        max_gap: at most this many frames from one keyframe to the next and to both ends; None for no bound.
        ramp: see the section's text; None for straight lines all the way.
    """
    t = motion.shape[1]
    gap = t if max_gap is None else min(max_gap, t)
    cost = np.array(costs, np.float64)
    if not (cost > 0).all():
        raise ValueError(f"keyframes cost {list(costs)}: not all above 0")
    mask = torch.zeros(len(motion), t, len(cost), dtype=motion.dtype)
    for row, one in enumerate(motion.detach().double().cpu().numpy()):
        own = [one[:, channels > 0.5] for channels in member.cpu().numpy()]
        parts = [_stretches(x, gap, ramp) for x in own]
        before, inside, after = (np.stack(part) for part in zip(*parts, strict=True))
        for group, frames in enumerate(_cheapest(cost, before, inside, after)):
            mask[row, frames, group] = 1.0
    return mask.to(motion.device)


def _stretches(x: Doubles, gap: int, ramp: int | None) -> tuple[Doubles, Doubles, Doubles]:
    """Errors of one track (T, c): held back from each frame to the start (T,); to each frame from the keyframe d frames
    before it (T, gap), at gap - d; held from each frame to the end (T,). Infinite where the gap is too large.
    """
    t = len(x)
    x = x - x.mean(axis=0)  # sums stay small
    frame = np.arange(t)
    norm = (x**2).sum(axis=1)
    s0, p0, p1 = norm.cumsum(), x.cumsum(axis=0), (x * frame[:, None]).cumsum(axis=0)
    own = -s0 + 2 * (x * p0).sum(axis=1)  # what belongs to keyframe i alone
    inside = np.full((t, gap), np.inf)
    for d in range(1, min(gap, t - 1) + 1):
        r = d if ramp is None else min(ramp, d)
        if d == r:  # from here on the same line for all d
            u = np.arange(1, r + 1) / r
            ww, mixed, vv = (u**2).sum(), (u * (1 - u)).sum(), ((1 - u) ** 2).sum()
            begin = np.maximum(frame - r, 0)
            rising = (p1 - p1[begin] - begin[:, None] * (p0 - p0[begin])) / r  # sum of u x_s
            y = p0 - rising - mixed * x
            ends = s0 - 2 * (x * rising).sum(axis=1) + ww * norm
        i, j = slice(0, t - d), slice(d, t)
        inside[j, gap - d] = ends[j] + own[i] + (d - r + vv) * norm[i] - 2 * np.einsum("tc,tc->t", x[i], y[j])
    before = s0 - 2 * (x * p0).sum(axis=1) + (frame + 1) * norm
    after = s0[-1] - s0 - 2 * (x * (p0[-1] - p0)).sum(axis=1) + (t - 1 - frame) * norm
    before[frame > gap] = np.inf
    after[t - 1 - frame > gap] = np.inf
    return np.maximum(before, 0), np.maximum(inside, 0), np.maximum(after, 0)


def _cheapest(cost: Doubles, before: Doubles, inside: Doubles, after: Doubles) -> list[list[int]]:
    """Keyframes of every group: `cost` (G,), errors as `_stretches` gives them, (G, T), (G, T, gap), (G, T)."""
    groups, t, gap = inside.shape
    best = before + cost[:, None]
    parent = np.full((groups, t), -1)
    every = np.arange(groups)
    for j in range(1, t):
        first = max(0, j - gap)
        options = best[:, first:j] + inside[:, j, gap - (j - first) :]
        i = options.argmin(axis=1)
        total = options[every, i] + cost
        better = total < best[:, j]
        best[better, j], parent[better, j] = total[better], first + i[better]
    last = (best + after).argmin(axis=1)
    return [_back(parent[group], int(at)) for group, at in enumerate(last)]


def _back(parent: np.typing.NDArray[np.intp], at: int) -> list[int]:
    frames = []
    while at >= 0:
        frames.append(at)
        at = int(parent[at])
    return frames
