"""Where the keyframes go: one question, `place(motion, k, ...) -> mask`, and six answers.

    exact          the mask with the least error of linear interpolation, by dynamic programming
    penalised      as many as pay: least error plus a cost per keyframe, by dynamic programming (`penalised`)
    static         evenly, centred
    static_paper   at every floor(N / k)-th frame, the paper's baseline, which leaves the window's end to extrapolation
    learned_paper  the paper's: one look of the score network, Gumbel top-k by Algorithm 1
    learned        ours: conditional scores, asked again at each of the k steps, then swept over (`choice`)

Shapes: B batch, T frames, C channels, G groups; a mask is (B, T, G) with exactly k[g] ones along T, but `penalised`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from sfms_robot.listeners.sfms.choice import choose, sweep
from sfms_robot.listeners.sfms.exact import best_frames, segments
from sfms_robot.listeners.sfms.penalised import place_penalised
from sfms_robot.listeners.sfms.score import ConditionalScore, ScoreNetwork, tracks

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
