"""What conditional keyframe scores learn from: a teacher that knows how every choice would end.

The score network chooses keyframes for some tracks by itself, now and then by chance, and at each state it came through
the teacher says, for every frame, the error of the best mask of k keyframes that holds what is chosen and this frame
(`exact.completion_errors`). The scores learn to prefer what costs least in the end. Because the states are the
network's own, it learns to get out of its own mistakes.

Why not equation (13) alone: through Algorithm 1 a score hears only of the draw it took part in, and the loss stalls
above evenly placed keyframes. The teacher's error is that of linear interpolation, which the inpainter starts from.

Error of linear interpolation over that of the exact masks, recorded faces, unseen takes, one set of keyframes per
channel, k = 3, 7, 10: even keyframes 4.3, 11, 15; choices of this network 1.7, 2.0, 1.6; swept over twice 1.16, 1.23,
1.13 (width 32, 2 layers, 1,500 steps of 32 tracks).
"""

from __future__ import annotations

import torch
from torch import Tensor

from sfms_robot.listeners.sfms.piecewise_linear import completion_errors
from sfms_robot.listeners.sfms.placement import ConditionalScore, Tracks, tracks

FLOOR = 0.05  # added to the least error, in squared deviations of the track: below it nobody sees a difference
SHARPNESS = 0.1  # temperature of the teacher's preferences
CANDIDATES = 4  # tracks looked at for one that is learned from
EXPLORED = 0.5  # share of choices that are drawn rather than the highest score


def imitation(score: ConditionalScore, track: Tracks, most: int, generator: torch.Generator) -> Tensor:
    """Cross-entropy of the scores against the teacher, over all states of one choice of 1..`most` keyframes a track."""
    n = len(track.curves)
    k = torch.randint(1, most + 1, (n,), generator=generator).to(track.curves.device)
    rows, chosen, remaining = states(score, track, k, generator)
    regret = regrets(track[rows], chosen, k[rows], most)
    wanted = torch.softmax(-regret / SHARPNESS, dim=1)
    logits = score(track[rows], chosen, remaining)
    heard = torch.log_softmax(logits, dim=1).masked_fill(chosen > 0.5, 0.0)
    return -(wanted * heard).sum(1).mean()


@torch.no_grad()
def lively(motion: Tensor, member: Tensor, curves: int, count: int, generator: torch.Generator) -> Tracks:
    """At most `count` tracks of motion (B, T, C), those that move most likelier: a still one has no best keyframes."""
    few = -(-CANDIDATES * count // len(member))  # windows that give enough candidates
    some = motion[torch.randperm(len(motion), generator=generator)[:few].to(motion.device)]
    found = tracks(some, member, curves)
    around = (some - some.mean(1, keepdim=True)).square().mean(1) @ member.T  # (B, G)
    weight = around.float().flatten().clamp(max=1.0).sqrt().cpu() + 0.05
    rows = torch.multinomial(weight, min(count, len(weight)), generator=generator)
    return found[rows.to(motion.device)]


@torch.no_grad()
def states(
    score: ConditionalScore, track: Tracks, k: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Every state (track row, chosen frames (S, T), keyframes to come) that the network's own choices lead through."""
    n, t, _ = track.curves.shape
    mask = track.curves.new_zeros(n, t)
    rows, chosen, remaining = [], [], []
    for step in range(int(k.max())):
        here = (step < k).nonzero()[:, 0]
        rows.append(here)
        chosen.append(mask[here])
        remaining.append((k - step)[here])
        logits = score(track, mask, (k - step).clamp(min=1))
        noise = -torch.log(-torch.log(_uniform((n, t), generator, mask.device).clamp(1e-7, 1 - 1e-7)))
        drawn = _uniform(n, generator, mask.device) < EXPLORED
        picked = (logits + noise * drawn[:, None]).argmax(1, keepdim=True)
        mask = mask.scatter(1, picked, 1.0)
    return torch.cat(rows), torch.cat(chosen), torch.cat(remaining)


@torch.no_grad()
def regrets(track: Tracks, chosen: Tensor, k: Tensor, most: int) -> Tensor:
    """How much worse than the best each next frame (S, T) would be with all k keyframes, as a share of the least."""
    errors = completion_errors(track.cost, chosen, most)  # (S, most, T)
    errors = errors[torch.arange(len(k), device=k.device), k - 1]
    least = errors.amin(1, keepdim=True)
    return ((errors - least) / (least + FLOOR)).masked_fill(chosen > 0.5, torch.inf)


def _uniform(shape: int | tuple[int, int], generator: torch.Generator, device: torch.device) -> Tensor:
    return torch.rand(shape, generator=generator).to(device)
