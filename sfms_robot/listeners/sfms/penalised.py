"""As many keyframes as pay: the least squared error of interpolation plus a cost per keyframe, by dynamic programming.

The paper gives every window its number of keyframes. What then happens far away decides what is placed here: a nod
takes keyframes from the stillness around it, and from the next second's smile. With a cost (lambda) instead a keyframe
stands where it saves more than that, wherever else others stand: none in stillness but what `max_gap` asks for, many in
a nod, and both sides of a keyframe that two motions share are placed alike.

    best[j] = cost + min(before[j], min_i best[i] + stretch[i, j])

`stretch[i, j]` is the error between keyframes i and j of `Neighbours.interpolate`: keyframe i is held until `ramp`
frames before j, then a straight line. A stream draws its keyframes a few frames ahead, so it cannot begin a line
earlier than that; where labels may, what is shown jumps onto the line when its end is drawn.

With b = j - r the frame where the line begins, r = min(ramp, j - i), and sums over the frames of the stretch

    stretch[i, j] = sum |x_s|^2 - 2 x_i . (sum of x_s, each as far as i tells it) - 2 x_j . (likewise) + norms

of which all but one product x_i . y_r[j] belongs to i or to j alone: a stretch costs one dot product.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from sfms_robot.frames import Doubles


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
        ramp: see the module's text; None for straight lines all the way.
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
