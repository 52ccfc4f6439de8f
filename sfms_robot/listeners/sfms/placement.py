"""Where the keyframes go: one question, `place(motion, k, ...) -> mask`, and four answers.

`learned` is the paper's (Gumbel top-k over the score network, Algorithm 1), `static` puts them evenly and centred,
`static_paper` at every floor(N / k)-th frame as the paper's baseline does (which leaves the end of the window to
extrapolation), `exact` finds the mask with the least error of linear interpolation by dynamic programming.
Shapes: B batch, T frames, C channels, G groups; a mask is (B, T, G) with exactly k[g] ones along T.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor

Strategy = Literal["exact", "static", "static_paper", "learned"]
EPSILON = 1e-20  # a chosen frame falls back by 46: more than any two scores differ


def place(
    motion: Tensor,
    k: Sequence[int],
    strategy: Strategy,
    *,
    member: Tensor,
    score: Callable[[Tensor], Tensor] | None = None,
    max_gap: int | None = None,
) -> Tensor:
    """Keyframe mask (B, T, G) of motion (B, T, C), deterministic: what encoding uses.

    `score` gives the logits that `learned` ranks; `max_gap` bounds `exact`.
    """
    if strategy == "exact":
        return place_exact(motion, k, member, max_gap)
    if strategy == "learned":
        if score is None:
            raise ValueError("learned placement needs a score network")
        return place_learned(score(motion), k)[0]
    return place_static(motion, k, centred=strategy == "static")


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
    uniform = torch.rand(scores.shape, generator=generator, device=scores.device).clamp(1e-7, 1 - 1e-7)
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


def place_exact(motion: Tensor, k: Sequence[int], member: Tensor, max_gap: int | None = None) -> Tensor:
    """The mask with the least squared error of linear interpolation between keyframes, held at both ends.

    Args:
        motion: (B, T, C); scale the channels by how much each matters.
        k: keyframes per group.
        member: (G, C), 1 where a channel belongs to a group.
        max_gap: at most this many frames from one keyframe to the next; None for no bound.
    """
    b, t, _ = motion.shape
    x = motion.double()[:, None] * member[:, None].double()  # (B, G, T, C)
    inside, before, after = _segment_errors(x @ x.transpose(-1, -2))
    if max_gap is not None:
        frame = torch.arange(t)
        inside = inside.masked_fill(frame[None, :] - frame[:, None] > max_gap, torch.inf)
        before = before.masked_fill(frame > max_gap, torch.inf)
        after = after.masked_fill(t - 1 - frame > max_gap, torch.inf)
    mask = motion.new_zeros(b, t, len(k))
    for group, count in enumerate(k):
        _check(count, t, max_gap)
        index = _cheapest_path(inside[:, group], before[:, group], after[:, group], count)
        mask[:, :, group] = mask[:, :, group].scatter(1, index, 1.0)
    return mask


def _segment_errors(gram: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gram matrix (..., T, T) of the frames -> error of the segment between keyframes i < j (..., T, T; infinite where
    j <= i), of holding j back to the start, of holding i to the end, both (..., T).

    With w = (s - i) / (j - i) the frame between is (1 - w) x_i + w x_j, so its squared error is a sum of Gram entries
    weighted by 1, s and s^2; prefix sums over s make every segment O(1).
    """
    t = gram.shape[-1]
    s = torch.arange(t, dtype=gram.dtype)
    square = gram.diagonal(dim1=-2, dim2=-1)  # |x_s|^2, (..., T)
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
    return inside, before.clamp(min=0.0), after.clamp(min=0.0)


def _cheapest_path(inside: Tensor, before: Tensor, after: Tensor, count: int) -> Tensor:
    """Frames (B, count) of the best keyframes: cost[j] = min_i cost[i] + inside[i, j], `count` - 1 times."""
    cost, parents = before, []
    for _ in range(count - 1):
        cost, parent = (cost[:, :, None] + inside).min(dim=1)
        parents.append(parent)
    frame = (cost + after).argmin(dim=1, keepdim=True)
    path = [frame]
    for parent in reversed(parents):
        frame = parent.gather(1, frame)
        path.append(frame)
    return torch.cat(path[::-1], dim=1)


def _check(count: int, frames: int, max_gap: int | None = None) -> None:
    if not 1 <= count <= frames:
        raise ValueError(f"cannot place {count} keyframes in {frames} frames")
    if max_gap is not None and (count + 1) * max_gap < frames - 1:
        raise ValueError(f"{count} keyframes at most {max_gap} frames apart do not span {frames} frames")
