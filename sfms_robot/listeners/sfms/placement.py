"""Keyframe discovery (IV-B2): the frames of keyframes. One function, `place(motion, k, ...) -> mask`, seven strategies.

    exact          the mask with the least error of linear interpolation, by dynamic programming
    penalised      the mask with the least error plus a cost per keyframe, any number of them (`place_penalised`)
    static         evenly, centred
    static_paper   at every floor(N / k)-th frame, the paper's baseline, which leaves the window's end to extrapolation
    learned_paper  the paper's: one pass of the score network, Gumbel top-k by Algorithm 1
    adaptive       given up by the paper (IV-B3): a frame's own score makes it a keyframe, (8) holds their number
    learned        ours: conditional scores, computed again at each of the k steps, then swept over (`choose`, `sweep`)

Shapes: B batch, T frames, C channels, G groups; a mask is (B, T, G) with exactly k[g] ones along T, except `penalised`
and `adaptive`.
N = B * G tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.config.listener import Placement, Scores
from sfms_robot.listeners.layers import Block, places_of
from sfms_robot.listeners.sfms.piecewise_linear import (
    Neighbours,
    Segments,
    best_frames,
    mask_cost,
    nearest_keys,
    place_penalised,
    segments,
)

Strategy = Placement
EPSILON = 1e-20  # Algorithm 1, line 9: the score of a chosen frame falls by 46, more than any two scores differ
MOST_CURVES = 3  # most principal curves of a group that the network sees
STILL = 1e-3  # root mean square, standardised, below which motion counts as noise
STATE_FEATURES = 11  # features in addition to three per curve
TIME_SCALE_FRAMES = 48.0


# --- Score networks ---------------------------------------------------------------------------------------------------
#
# A score is the preference for a frame as a keyframe, per channel group. `ScoreNetwork` is the paper's: it looks at
# the motion once, and the k highest scores are the keyframes. Scores of smooth motion are smooth, so the k highest are
# neighbours. `ConditionalScore` is ours, because of that: the same network, called again at every one of the k steps
# with the frames already chosen and the number still to choose. Next to a chosen frame no error is left to explain, so
# keyframes cannot cluster.


class ScoreNetwork(nn.Module):
    """Phi_score: 1-D convolution, linear, sinusoidal positions, transformer encoder -> logits s of equation (4)."""

    def __init__(self, inputs: int, outputs: int, settings: Scores) -> None:
        super().__init__()
        width = settings.width
        self.conv = nn.Conv1d(inputs, width, kernel_size=5, padding=2)
        self.linear = nn.Linear(width, width)
        self.blocks = nn.ModuleList(Block(width, settings.heads) for _ in range(settings.layers))
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, outputs)

    def forward(self, seen: Tensor) -> Tensor:
        """Return logits (B, T, outputs) of (B, T, inputs): in the paper standardised motion, one output per group."""
        x = self.linear(self.conv(seen.transpose(1, 2)).transpose(1, 2))
        x = x + places_of(x)
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.out(self.norm(x))
        return out


@dataclass(frozen=True)
class Tracks:
    """N windows, each of one group's channels, to choose keyframes for; ordered sample by sample.

    Attributes:
        curves: (N, T, P) the first principal curves of the group in this window; all of its motion if P channels
            suffice.
        cost: errors of its stretches over all channels. Both are in units of the window's own deviation.
    """

    curves: Tensor
    cost: Segments

    def __getitem__(self, rows: Tensor) -> Tracks:
        return Tracks(self.curves[rows], Segments(*(part[rows] for part in self.cost)))


@torch.no_grad()
def tracks(motion: Tensor, member: Tensor, most: int) -> Tracks:
    """Return the tracks of motion (B, T, C) with groups `member` (G, C) and `most` principal curves each."""
    centred = motion - motion.mean(1, keepdim=True)
    groups = []
    for row in member:
        own = centred[..., row > 0.5]  # (B, T, c)
        groups.append(own / own.square().sum(-1).mean(1).sqrt().clamp(min=STILL)[:, None, None])
    cost = segments(_padded(groups, max(own.shape[-1] for own in groups)))  # zeros add no error
    return Tracks(_padded([_principal(own, most) for own in groups], most), Segments(*(part.float() for part in cost)))


def _padded(groups: Sequence[Tensor], width: int) -> Tensor:
    """Return windows (B * G, T, width) of G groups (B, T, c), sample by sample, with zeros behind their c columns."""
    return torch.stack([F.pad(own, (0, width - own.shape[-1])) for own in groups], 1).flatten(0, 1)


def _principal(own: Tensor, most: int) -> Tensor:
    """Return the first principal curves of centred channels (B, T, c): (B, T, most), or (B, T, c) if c is smaller."""
    if own.shape[-1] > 1:  # in double precision, which autocast does not change
        wide = own.double()
        axes = torch.linalg.eigh(wide.transpose(1, 2) @ wide).eigenvectors  # ascending
        own = (wide @ axes.flip(-1)[..., :most]).to(own.dtype)
    return own


class ConditionalScore(nn.Module):
    """Logits of the next keyframe of a track, given those already chosen; one network for all groups."""

    def __init__(self, largest_group: int, settings: Scores) -> None:
        super().__init__()
        self.curves = min(MOST_CURVES, largest_group)
        self.network = ScoreNetwork(3 * self.curves + STATE_FEATURES, 1, settings)

    def forward(self, track: Tracks, chosen: Tensor, remaining: Tensor) -> Tensor:
        """Return logits (N, T), minus infinity where a frame is already `chosen` (N, T).

        `remaining` (N,): keyframes still to choose, this one included.
        """
        logits: Tensor = self.network(_features(track, chosen, remaining))[..., 0]
        return logits.masked_fill(chosen > 0.5, -torch.inf)


def _features(track: Tracks, chosen: Tensor, remaining: Tensor) -> Tensor:
    """Return (N, T, 3 P + STATE_FEATURES): motion, interpolation between chosen frames, difference, state features."""
    curves = track.curves
    near = Neighbours.in_mask(chosen[..., None])
    drawn = near.interpolate((curves * chosen[..., None])[:, :, None])[:, :, 0]
    missing = curves - drawn
    left = missing.square().sum(-1)  # (N, T)
    rms = left.mean(1).sqrt().clamp(min=STILL)[:, None]
    place = (near.since / TIME_SCALE_FRAMES, near.until / TIME_SCALE_FRAMES, near.has_before, near.has_after)
    now, then = stretch_errors(track.cost, chosen)
    total = left.sum(1, keepdim=True).clamp(min=STILL)
    gain = torch.where(now.isfinite(), now - then, then) / total  # error that this frame would remove
    rest = torch.where(now.isfinite(), then / now.clamp(min=STILL), 0.0).clamp(max=2.0)  # share that it would leave
    count = remaining.float()
    told = (torch.zeros_like(count), count.log() / 2, 1 / count)  # the first is always 0: the weights have a row for it
    frames = [chosen, rms.log().expand_as(chosen) / 3, *(one.float()[..., 0] for one in place)]
    frames += [one[:, None].expand_as(chosen) for one in told]
    frames += [torch.asinh(3 * gain), rest]
    return torch.cat([curves, drawn, missing / rms[..., None], torch.stack(frames, dim=-1)], dim=-1)


def stretch_errors(cost: Segments, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Return the error of the stretch around each frame, and of its two parts if the frame were chosen, both (N, T).

    The first is infinite where no frame is chosen yet.
    """
    t = chosen.shape[1]
    last, following = nearest_keys(chosen)
    last = F.pad(last[:, :-1], (1, 0), value=-1)  # strictly before
    following = F.pad(following[:, 1:], (0, 1), value=t)  # strictly after
    i, j = last.clamp(min=0), following.clamp(max=t - 1)
    left = torch.where(last >= 0, cost.inside.gather(1, i[:, None])[:, 0], cost.before)
    right = torch.where(following < t, cost.inside.gather(2, j[..., None])[..., 0], cost.after)
    across = cost.inside.flatten(1).gather(1, i * t + j)
    now = torch.where(last < 0, cost.before.gather(1, j), torch.where(following >= t, cost.after.gather(1, i), across))
    return now.masked_fill((last < 0) & (following >= t), torch.inf), left + right


# --- Placement --------------------------------------------------------------------------------------------------------


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
    """Return the deterministic keyframe mask (B, T, G) of motion (B, T, C) that encoding uses.

    Args:
        motion: standardised.
        k: keyframes of each group; not used by `penalised`.
        strategy: see the module.
        member: (G, C), 1 where a channel belongs to a group.
        score: network of the learned strategies.
        max_gap: bounds `exact` and `penalised`.
        sweeps: rounds of `sweep` that improve `learned`.
        costs: cost of a keyframe per group, for `penalised`.
        ramp: ramp of the interpolation, for `penalised`.

    Raises ValueError if a strategy has no score network of its kind, or k does not fit the frames.
    """
    if strategy == "penalised":
        return place_penalised(motion, costs, member, max_gap, ramp)
    if strategy == "exact":
        return place_exact(motion, k, member, max_gap)
    if strategy in ("static", "static_paper"):
        return place_static(motion, k, centred=strategy == "static")
    if isinstance(score, ScoreNetwork) and strategy in ("learned_paper", "adaptive"):
        return place_learned(score(motion), k)[0] if strategy == "learned_paper" else place_adaptive(score(motion))[0]
    if isinstance(score, ConditionalScore) and strategy == "learned":
        return place_conditional(motion, k, member, score, sweeps)
    raise ValueError(f"{strategy} placement needs a score network of its kind")


def place_static(motion: Tensor, k: Sequence[int], *, centred: bool = True) -> Tensor:
    """Return evenly placed keyframes, the same for every sample."""
    b, t, _ = motion.shape
    mask = motion.new_zeros(b, t, len(k))
    for group, count in enumerate(k):
        _check(count, t)
        if centred:
            index = ((torch.arange(count) + 0.5) * t / count).long()
        else:
            index = torch.arange(count) * (t // count)
        mask[:, index.to(mask.device, non_blocking=True), group] = 1.0
    return mask


def place_exact(motion: Tensor, k: Sequence[int], member: Tensor, max_gap: int | None = None) -> Tensor:
    """Return the mask with the least squared error of linear interpolation between keyframes, held at both ends.

    Args:
        motion: (B, T, C); scale the channels by how much each matters.
        k: keyframes per group.
        member: (G, C), 1 where a channel belongs to a group.
        max_gap: at most this many frames from one keyframe to the next; None for no bound.
    """
    b, t, _ = motion.shape
    mask = motion.new_zeros(b, t, len(k))
    for group, count in enumerate(k):  # one group at a time: its tables fit the processor's cache
        _check(count, t, max_gap)
        frames = best_frames(segments(motion[..., member[group] > 0.5], max_gap), count)
        mask[:, :, group] = mask[:, :, group].scatter(1, frames, 1.0)
    return mask


def _check(count: int, frames: int, max_gap: int | None = None) -> None:
    if not 1 <= count <= frames:
        raise ValueError(f"cannot place {count} keyframes in {frames} frames")
    if max_gap is not None and (count + 1) * max_gap < frames - 1:
        raise ValueError(f"{count} keyframes at most {max_gap} frames apart do not span {frames} frames")


# --- Algorithm 1 ------------------------------------------------------------------------------------------------------


def place_learned(
    scores: Tensor,
    k: Sequence[int],
    temperature: float = 0.0,
    generator: torch.Generator | None = None,
    *,
    tempered: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return (mask, relaxed mask), both (B, T, G), of scores (B, T, G): Gumbel top-k by Algorithm 1.

    In the forward pass the mask is exactly k-hot; its gradient is that of the relaxed mask (line 18). Temperature 0 is
    evaluation: the k largest scores, no noise, no gradient. In Algorithm 1 the mask that is drawn does not depend on
    the temperature: line 11 divides both scores and noise. `tempered`: the first frame is drawn from
    Categorical(exp(s / temperature)), as in equation (6), so the noise grows with the temperature.
    """
    if temperature == 0.0:
        hard = _top_k(scores, k)
        return hard, hard
    gumbel = -torch.log(-torch.log(_uniform_like(scores, generator)))
    noisy = scores + gumbel * (temperature if tempered else 1.0)  # lines 3 to 6: s_i + g_i
    relaxed = _relaxed_k_hot(noisy, k, temperature)
    hard = _top_k(relaxed, k)  # lines 14 to 16
    return hard - relaxed.detach() + relaxed, relaxed  # line 18


def place_adaptive(
    scores: Tensor, temperature: float = 0.0, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Return (mask, relaxed mask) of scores (B, T, G), which are each frame's log-odds of being a keyframe (IV-B3).

    Frames are drawn separately. Temperature 0 is evaluation. A track without a likely frame has its likeliest one.
    """
    noisy, relaxed = scores, torch.sigmoid(scores)
    if temperature:
        uniform = _uniform_like(scores, generator)
        noisy = scores + torch.log(uniform) - torch.log1p(-uniform)
        relaxed = torch.sigmoid(noisy / temperature)
    hard = torch.maximum((noisy > 0).float(), F.one_hot(noisy.argmax(1), scores.shape[1]).transpose(1, 2).float())
    return (hard - relaxed.detach() + relaxed if temperature else hard), relaxed


def _uniform_like(scores: Tensor, generator: torch.Generator | None) -> Tensor:
    source = scores.device if generator is None else generator.device
    return torch.rand(scores.shape, generator=generator, device=source).to(scores.device).clamp(1e-7, 1 - 1e-7)


def _relaxed_k_hot(noisy: Tensor, k: Sequence[int], temperature: float) -> Tensor:
    """Return the sums (B, T, G) of k softmaxes, each without the frames that the earlier ones chose (lines 7 to 13)."""
    k_hot = one_hot = torch.zeros_like(noisy)
    counts = torch.tensor(k).to(noisy.device, non_blocking=True)
    for step in range(max(k)):
        noisy = noisy + torch.log(torch.clamp(1.0 - one_hot, min=EPSILON))  # lines 9, 10
        one_hot = torch.softmax(noisy / temperature, dim=1)  # line 11
        k_hot = k_hot + one_hot * (step < counts)  # line 12
    return k_hot


def _top_k(scores: Tensor, k: Sequence[int]) -> Tensor:
    mask = torch.zeros_like(scores)
    for group, count in enumerate(k):
        _check(count, scores.shape[1])
        mask[..., group].scatter_(1, scores[..., group].topk(count, dim=1).indices, 1.0)
    return mask


# --- One keyframe after another ---------------------------------------------------------------------------------------
#
# Keyframes are chosen one by one by conditional scores, and once all are there, each is chosen again. This is Algorithm
# 1 with one change, ours: its lines 9 and 10 remove the frame just chosen from the same scores; here the scores are
# computed again at each of the k steps.


@torch.no_grad()
def place_conditional(motion: Tensor, k: Sequence[int], member: Tensor, score: ConditionalScore, sweeps: int) -> Tensor:
    """Return the mask of the highest conditional scores, one keyframe after another, improved by rounds of `sweep`."""
    b, t, _ = motion.shape
    for count in k:
        _check(count, t)
    track = tracks(motion, member, score.curves)
    mask = choose(score, track, torch.tensor(k, device=motion.device).repeat(b))
    for number in range(sweeps):
        mask = sweep(score, track, mask, together=1 + number % 2)
    return mask.view(b, len(k), t).transpose(1, 2).contiguous()


@torch.no_grad()
def choose(score: ConditionalScore, track: Tracks, k: Tensor) -> Tensor:
    """Return the mask (N, T) of k (N,) keyframes of each track, one at a time, the highest score each time."""
    n, t, _ = track.curves.shape
    mask = track.curves.new_zeros(n, t)
    for step in range(int(k.max())):
        wanted = step < k
        picked = score(track, mask, torch.where(wanted, k - step, 1)).argmax(1)
        mask = torch.where(wanted[:, None], mask.scatter(1, picked[:, None], 1.0), mask)
    return mask


@torch.no_grad()
def sweep(score: ConditionalScore, track: Tracks, mask: Tensor, together: int) -> Tensor:
    """Remove `together` neighbouring keyframes of a mask (N, T) at a time, left to right, and choose them again.

    A change is kept if it makes the error of linear interpolation smaller, so a sweep never makes a mask worse.
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
