"""What an event that is told does to a face on average: curves over its course, as large as it is said to be.

`features` of a control row (`signals.control`) times weights that are fitted on the data, by least squares, are the
motion to be expected of events alone. What is drawn is the rest: a nod that was begun too large is brought back to the
one that was told, and a smile, which is rare, is not left to be learned from nothing.

Of every kind: hats over how much of it is over, and over how long it lasts already; of those that swing, the first two
harmonics of where in a swing it is, and these as they die away. All times its size; and a 1, for rest.

`remains` is what an event leaves of what was drawn beside it: nothing, once it is over. A nod that went too far has
come back by its end, and a mouth that smiled more than it was told to is at rest again.
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
_AT: Final = {name: at for at, name in enumerate(COLUMNS)}
FEATURES: Final = 1 + len(KINDS) * (len(_OVER) + len(_SINCE)) + 8 * len(SWINGING)
RIDGE: Final = 1.0  # frames that speak for nothing happening
LEAST: Final = 1e-3  # of an event that is left in any frame of it
_SMILING: Final = ("mouth", "cheek", "nose", "eyeSquint")
# Channels that are moved, by how their names begin; a jaw may speak while its mouth smiles.
MOVES: Final[Mapping[str, tuple[str, ...]]] = {
    "nod": POSE_CHANNELS,
    "shake": POSE_CHANNELS,
    "tilt": POSE_CHANNELS,
    "smile": _SMILING,
    "laugh": (*_SMILING, "jaw", "brow", "eyeWide"),
    "brow_raise": ("brow", "eyeWide"),
    "blink": ("eyeBlink",),
}


def features(row: Tensor) -> Tensor:
    """Control rows (..., K) -> (..., FEATURES), the first of them 1."""
    found = [torch.ones_like(row[..., :1])]
    for kind in KINDS:
        size = (row[..., _AT[f"{kind}.active"]] * row[..., _AT[f"{kind}.size"]])[..., None]
        over, since = (row[..., _AT[f"{kind}.{what}"], None] for what in ("over", "since"))
        found += [size * _hats(over, _OVER), size * _hats(since, _SINCE)]
        if kind in SWINGING:
            sine, cosine = (row[..., _AT[f"{kind}.{what}"], None] for what in ("sine", "cosine"))
            waves = torch.cat([sine, cosine, 2 * sine * cosine, cosine.square() - sine.square()], dim=-1)
            found += [size * waves, size * over * waves]
    return torch.cat(found, dim=-1)


def moves(channels: Sequence[str]) -> Tensor:
    """(KINDS, C) bool: which of the channels each kind moves."""
    return torch.tensor([[name.startswith(MOVES.get(kind, ())) for name in channels] for kind in KINDS])


def moved_channels(row: Tensor, moves: Tensor) -> Tensor:
    """(..., C) bool: which channels an event of the control row (..., K) moves; `moves` (KINDS, C) as of `moves`."""
    active = row[..., [_AT[f"{kind}.active"] for kind in KINDS]] > 0
    return (active[..., None] & moves).any(-2)


def remains(before: Tensor, now: Tensor, moves: Tensor) -> Tensor:
    """Share (..., C) of what was off after a frame of control row `before` (..., K) that is left at the row `now`.

    1 where no event moves a channel. While one does, what is left of it over what was left a frame ago, which brings
    anything to 0 by its end, however long it is: the drift of a Brownian bridge.
    """
    active, over = ([_AT[f"{kind}.{what}"] for kind in KINDS] for what in ("active", "over"))
    left = 1 - now[..., over] * now[..., active]
    left = torch.where((before[..., active] > 0) & (now[..., active] == 0), 0.0, left)
    was = (1 - before[..., over] * before[..., active]).clamp(min=LEAST)
    share: Tensor = torch.where(moves, (left / was).clamp(0, 1)[..., None], 1.0).prod(dim=-2)
    return share


def _hats(x: Tensor, knots: tuple[float, ...]) -> Tensor:
    """x (..., 1) within the knots -> (..., knots): 1 at its own knot, 0 at the next ones, straight in between."""
    at = torch.tensor(knots, dtype=x.dtype, device=x.device)
    gap = at.diff()
    below, above = (x - at[:-1]) / gap, (at[1:] - x) / gap
    rise = torch.cat([torch.ones_like(x), below], dim=-1)
    fall = torch.cat([above, torch.ones_like(x)], dim=-1)
    return torch.minimum(rise, fall).clamp(0, 1)


def fit(rows: Tensor, motion: Tensor) -> Tensor:
    """Weights (FEATURES, C) of least squares for motion (N, C) at control rows (N, K), a little drawn to nothing."""
    gram = torch.zeros(FEATURES, FEATURES, dtype=torch.float64)
    moved = torch.zeros(FEATURES, motion.shape[1], dtype=torch.float64)
    for row, made in zip(torch.split(rows, 65536), torch.split(motion, 65536), strict=True):
        of = features(row.float()).double()
        gram += of.T @ of
        moved += of.T @ made.double()
    gram += RIDGE * torch.eye(FEATURES, dtype=torch.float64)
    weights: Tensor = torch.linalg.solve(gram, moved).float()
    return weights
