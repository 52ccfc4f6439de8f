"""Keyframe score networks (IV-B2): how much each frame asks to be a keyframe, per channel group.

`ScoreNetwork` is the paper's: it looks at the motion once, and the k highest scores are the keyframes. Scores of smooth
motion are smooth, so the k highest stand side by side. `ConditionalScore` is ours: the same network, asked again at
every one of the k steps, and told what is already chosen and how many are still to come. Next to a chosen frame there
is nothing left to explain, so nothing can cluster.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.listeners.layers import Block, sinusoidal
from sfms_robot.listeners.sfms.exact import Segments, segments
from sfms_robot.listeners.sfms.neighbours import Neighbours

MOST_CURVES = 3  # principal curves of a group that the network sees
STILL = 1e-3  # root mean square, standardised, below which motion counts as noise
STATE_FEATURES = 11  # beside three per curve
TIME_SCALE_FRAMES = 48.0


class ScoreNetwork(nn.Module):
    """1-D convolution, linear, sinusoidal positions, transformer encoder -> logits s of equation (4)."""

    def __init__(self, inputs: int, outputs: int, width: int, heads: int, layers: int = 2) -> None:
        super().__init__()
        self.width = width
        self.conv = nn.Conv1d(inputs, width, kernel_size=5, padding=2)
        self.linear = nn.Linear(width, width)
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, outputs)

    def forward(self, seen: Tensor) -> Tensor:
        """(B, T, inputs) -> logits (B, T, outputs). The paper's: standardised motion in, one output per group."""
        x = self.linear(self.conv(seen.transpose(1, 2)).transpose(1, 2))
        x = x + sinusoidal(x.shape[1], self.width).to(x)
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.out(self.norm(x))
        return out


@dataclass(frozen=True)
class Tracks:
    """What keyframes are chosen for: N = B * G windows of one group's channels, sample by sample.

    Attributes:
        curves: (N, T, P) the first principal curves of the group in this window; all of it when P channels suffice.
        cost: errors of its stretches, all channels counted. Both are in units of the window's own deviation.
    """

    curves: Tensor
    cost: Segments

    def __getitem__(self, rows: Tensor) -> Tracks:
        cost = Segments(self.cost.inside[rows], self.cost.before[rows], self.cost.after[rows])
        return Tracks(self.curves[rows], cost)


@torch.no_grad()
def tracks(motion: Tensor, member: Tensor, most: int) -> Tracks:
    """Tracks of motion (B, T, C) whose groups are member (G, C), with `most` principal curves each."""
    centred = motion - motion.mean(1, keepdim=True)
    curves, costs = [], []
    for row in member:
        own = centred[..., row > 0.5]  # (B, T, c)
        own = own / own.square().sum(-1).mean(1).sqrt().clamp(min=STILL)[:, None, None]
        curves.append(_principal(own, most))
        costs.append(segments(own.double() @ own.double().transpose(1, 2)))
    inside = torch.stack([cost.inside.float() for cost in costs], 1)
    before, after = (torch.stack([getattr(cost, end).float() for cost in costs], 1) for end in ("before", "after"))
    cost = Segments(inside.flatten(0, 1), before.flatten(0, 1), after.flatten(0, 1))
    return Tracks(torch.stack(curves, 1).flatten(0, 1), cost)


def _principal(own: Tensor, most: int) -> Tensor:
    """The first principal curves (B, T, most) of centred channels (B, T, c), zeros where c is smaller."""
    channels = own.shape[-1]
    if channels > 1:  # in double precision, which autocast leaves alone
        wide = own.double()
        axes = torch.linalg.eigh(wide.transpose(1, 2) @ wide).eigenvectors  # ascending
        own = (wide @ axes.flip(-1)[..., :most]).to(own.dtype)
    return F.pad(own, (0, most - own.shape[-1]))


class ConditionalScore(nn.Module):
    """Logits of the next keyframe of a track, given those already chosen; one network for all groups."""

    def __init__(self, largest_group: int, width: int, heads: int, layers: int) -> None:
        super().__init__()
        self.curves = min(MOST_CURVES, largest_group)
        self.network = ScoreNetwork(3 * self.curves + STATE_FEATURES, 1, width, heads, layers)

    def forward(self, track: Tracks, chosen: Tensor, remaining: Tensor) -> Tensor:
        """Logits (N, T), minus infinity where a frame is already `chosen` (N, T).

        `remaining` (N,): keyframes still to choose, this one included.
        """
        logits: Tensor = self.network(_features(track, chosen, remaining))[..., 0]
        return logits.masked_fill(chosen > 0.5, -torch.inf)


def _features(track: Tracks, chosen: Tensor, remaining: Tensor) -> Tensor:
    """(N, T, 3 P + STATE_FEATURES): the motion, what the chosen frames make of it, and what is missing."""
    curves = track.curves
    near = Neighbours.in_mask(chosen[..., None])
    drawn = near.interpolate((curves * chosen[..., None])[:, :, None])[:, :, 0]
    missing = curves - drawn
    left = missing.square().sum(-1)  # (N, T)
    rms = left.mean(1).sqrt().clamp(min=STILL)[:, None]
    place = (near.since / TIME_SCALE_FRAMES, near.until / TIME_SCALE_FRAMES, near.has_before, near.has_after)
    now, then = stretch_errors(track.cost, chosen)
    total = left.sum(1, keepdim=True).clamp(min=STILL)
    gain = torch.where(now.isfinite(), now - then, then) / total
    rest = torch.where(now.isfinite(), then / now.clamp(min=STILL), 0.0).clamp(max=2.0)
    count = remaining.float()
    told = (torch.zeros_like(count), count.log() / 2, 1 / count)  # the first is always 0: weights have a row for it
    frames = [chosen, rms.log().expand_as(chosen) / 3, *(one.float()[..., 0] for one in place)]
    frames += [one[:, None].expand_as(chosen) for one in told]
    frames += [torch.asinh(3 * gain), rest]
    return torch.cat([curves, drawn, missing / rms[..., None], torch.stack(frames, dim=-1)], dim=-1)


def stretch_errors(cost: Segments, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Error of the stretch that each frame lies in, and of its two parts if that frame were chosen, both (N, T).

    The first is infinite where nothing is chosen yet.
    """
    t = chosen.shape[1]
    frame = torch.arange(t, device=chosen.device).expand(chosen.shape)
    key = chosen > 0.5
    last = F.pad(torch.where(key, frame, -1).cummax(1).values[:, :-1], (1, 0), value=-1)  # strictly before
    following = torch.where(key, frame, t).flip(1).cummin(1).values.flip(1)
    following = F.pad(following[:, 1:], (0, 1), value=t)
    i, j = last.clamp(min=0), following.clamp(max=t - 1)
    left = torch.where(last >= 0, cost.inside.gather(1, i[:, None])[:, 0], cost.before)
    right = torch.where(following < t, cost.inside.gather(2, j[..., None])[..., 0], cost.after)
    across = cost.inside.flatten(1).gather(1, i * t + j)
    now = torch.where(last < 0, cost.before.gather(1, j), torch.where(following >= t, cost.after.gather(1, i), across))
    return now.masked_fill((last < 0) & (following >= t), torch.inf), left + right
