"""Average motion of a face during an event: curves over its course, scaled with its size. Ours.

The motion expected of events alone is `features` of a control row (`signals.control`) times weights that are fitted to
the data by least squares. The listener draws the rest: a nod that was begun too large is brought back to the size that
was decided, and a smile, which is rare, need not be learned from nothing.

Features of every kind of event are piecewise linear curves over the share of it that has passed and over the time since
it began. Kinds that swing also have the first two harmonics of the place in a swing, and these harmonics times the
share that has passed, so that they can die away. All are multiplied by the size of the event. A feature of 1 is for
rest.

`remains` is the share of other motion that an event leaves: 0 by its end. A nod that went too far has come back by its
end, and a mouth that smiled more than was decided is at rest again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import torch
from torch import Tensor

from sfms_robot.frames import POSE_CHANNELS
from sfms_robot.signals.control import COLUMNS, KINDS, SWINGING

_OVER: Final = tuple(step / 8 for step in range(9))
_SINCE: Final = (0.0, 0.3, 0.6, 0.9, 1.2, 1.6, 2.0, 4.0)  # on the axis of the control row: 0 to 10 s
_EACH: Final = COLUMNS.index(f"{KINDS[1]}.active")  # columns per kind: active, since, over, size
FEATURES: Final = 1 + len(KINDS) * (len(_OVER) + len(_SINCE)) + 8 * len(SWINGING)
RIDGE: Final = 1.0  # weight of the pull towards no motion, in frames
LEAST: Final = 1e-3  # least share of an event that is left in any of its frames
_SMILING: Final = ("mouth", "cheek", "nose", "eyeSquint")
# Prefixes of the channels that each kind moves; a jaw may speak while its mouth smiles.
MOVES: Final[Mapping[str, tuple[str, ...]]] = {
    "nod": POSE_CHANNELS,
    "shake": POSE_CHANNELS,
    "tilt": POSE_CHANNELS,
    "smile": _SMILING,
    "laugh": (*_SMILING, "jaw", "brow", "eyeWide"),
    "brow_raise": ("brow", "eyeWide"),
    "blink": ("eyeBlink",),
}


def knots() -> Tensor:
    """Return the knots (S,) of all curves, for `features`."""
    return torch.tensor([*_OVER, *_SINCE])


def features(row: Tensor, at: Tensor | None = None) -> Tensor:
    """Return features (..., FEATURES) of control rows (..., K); the first of them is 1.

    `at`: `knots` on the device of the rows, from a caller that must not make a tensor: a step of a stream on a GPU.
    """
    at = knots().to(row) if at is None else at
    active, since, over, size = _of_kinds(row)  # (..., KINDS, 1)
    size = active * size  # 0 without such an event in progress: then the features of the kind are 0
    curves = torch.cat([size * _hats(over, at[: len(_OVER)]), size * _hats(since, at[len(_OVER) :])], dim=-1)
    swings = [KINDS.index(kind) for kind in SWINGING]
    sine, cosine = torch.unflatten(row[..., _EACH * len(KINDS) :], -1, (len(SWINGING), 2)).chunk(2, dim=-1)
    # sin a, cos a, sin 2a = 2 sin a cos a, cos 2a = cos^2 a - sin^2 a
    waves = torch.cat([sine, cosine, 2 * sine * cosine, cosine.square() - sine.square()], dim=-1)
    found = [torch.ones_like(row[..., :1])]
    for kind in range(len(KINDS)):
        found.append(curves[..., kind, :])
        if kind in swings:
            wave, of = waves[..., swings.index(kind), :], size[..., kind, :]
            found += [of * wave, of * over[..., kind, :] * wave]
    return torch.cat(found, dim=-1)


def _of_kinds(row: Tensor) -> tuple[Tensor, ...]:
    """Return active, since, over and size (..., KINDS, 1) of control rows (..., K): views, without an index tensor."""
    return torch.unflatten(row[..., : _EACH * len(KINDS)], -1, (len(KINDS), _EACH)).chunk(4, dim=-1)


def moves(channels: Sequence[str]) -> Tensor:
    """Return (KINDS, C) bool: the channels that each kind moves."""
    return torch.tensor([[name.startswith(MOVES.get(kind, ())) for name in channels] for kind in KINDS])


def moved_channels(row: Tensor, moves: Tensor) -> Tensor:
    """Return (..., C) bool: the channels that an event of the control row (..., K) moves; `moves` (KINDS, C)."""
    return ((_of_kinds(row)[0] > 0) & moves).any(-2)


def remains(before: Tensor, now: Tensor, moves: Tensor) -> Tensor:
    """Return the share (..., C) of a deviation at control row `before` (..., K) that is left at the row `now`.

    It is 1 where no event moves a channel. While an event does, it is left(t) / left(t - 1), where left is the share of
    the event still to come: the drift of a Brownian bridge, which brings any deviation to 0 by the end of the event,
    however long the event is.
    """
    active, _, over, _ = _of_kinds(now)  # (..., KINDS, 1)
    was_active, _, was_over, _ = _of_kinds(before)
    # left: share of the event still to come, at this row; 0 in the first row after the event.
    left = torch.where((was_active > 0) & (active == 0), 0.0, 1 - over * active)
    was = (1 - was_over * was_active).clamp(min=LEAST)
    # Overlapping events all reduce the deviation of the channels that they move: their shares multiply.
    return torch.where(moves, (left / was).clamp(0, 1), 1.0).prod(dim=-2)


def _hats(x: Tensor, at: Tensor) -> Tensor:
    """Return hats (..., S) of x (..., 1) within the knots `at`: 1 at its own knot, 0 at the next ones, else linear."""
    # A hat is the lower of two lines, rising to its knot and falling from it.
    gap = at.diff()
    below, above = (x - at[:-1]) / gap, (at[1:] - x) / gap
    rise = torch.cat([torch.ones_like(x), below], dim=-1)
    fall = torch.cat([above, torch.ones_like(x)], dim=-1)
    return torch.minimum(rise, fall).clamp(0, 1)


def fit(rows: Tensor, motion: Tensor) -> Tensor:
    """Return the weights (FEATURES, C) of ridge regression for motion (N, C) at control rows (N, K)."""
    # Normal equations (X^T X + r I) W = X^T Y, summed in pieces and in double precision.
    gram = torch.zeros(FEATURES, FEATURES, dtype=torch.float64)
    moved = torch.zeros(FEATURES, motion.shape[1], dtype=torch.float64)
    for row, made in zip(torch.split(rows, 65536), torch.split(motion, 65536), strict=True):
        of = features(row.float()).double()
        gram += of.T @ of
        moved += of.T @ made.double()
    gram += RIDGE * torch.eye(FEATURES, dtype=torch.float64)
    weights: Tensor = torch.linalg.solve(gram, moved).float()
    return weights
