"""Tokens out of probabilities: frame by frame, every group at once, many streams at a time."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.predictor import UNDECIDED, Context, Trail, trails
from sfms_robot.listeners.sfms.reach import Reach

LIKELIEST = 128  # classes that are looked at: what is behind them weighs next to nothing, and sorting it takes time


def draw(
    model: SfmsModel,
    settings: config.Sfms,
    reach: Reach,
    seen: Context,
    generators: Sequence[torch.Generator],
) -> Tensor:
    """`seen.tokens` (B, P + H, G) with its undecided frames drawn; stream b by the numbers of generators[b]."""
    predictor, tokens = model.predictor, seen.tokens.clone()
    first = int((tokens[0] > UNDECIDED).all(-1).sum())  # the same for all streams
    future = tokens.shape[1] - settings.future_frames
    groups = list(settings.groups.values())
    bias = torch.tensor([group.transition_bias for group in groups])
    nucleus = torch.tensor([group.nucleus or settings.sampling.nucleus for group in groups])
    past = trails(tokens)
    slots = predictor(seen, past)  # (B, H, W)
    trail = Trail(*(part[:, first - 1] for part in past))
    left = tokens.shape[1] - first
    chances = torch.stack([torch.rand(left, len(groups), generator=one) for one in generators], dim=1)
    for frame, chance in enumerate(chances, first):
        logits = predictor.classes(slots[:, frame - future], trail, frame - 1)  # (B, G, V)
        logits = logits.masked_fill(reach.too_soon(trail.tokens[..., 0], frame - trail.at[..., 0]), -torch.inf)
        drawn = sample(logits / settings.sampling.temperature, bias, nucleus, chance)
        tokens[:, frame] = drawn
        trail = trail.then(drawn, frame)
    return tokens


def sample(logits: Tensor, bias: Tensor, nucleus: Tensor, chance: Tensor) -> Tensor:
    """One class (..., G) of each logits (..., G, V): bias (G,) on class 0, then the likeliest that hold `nucleus` (G,).

    `chance` (..., G) in 0..1 says where in that mass: a class is drawn as often as it is likely.
    """
    biased = logits.clone()
    biased[..., 0] += bias
    order = torch.softmax(biased, dim=-1).topk(min(LIKELIEST, logits.shape[-1]))
    mass = order.values.cumsum(-1)
    kept = ((mass - order.values) < nucleus[:, None]).sum(-1, keepdim=True)
    whole = mass.gather(-1, kept - 1)
    place = torch.minimum((mass <= chance[..., None] * whole).sum(-1, keepdim=True), kept - 1)
    return order.indices.gather(-1, place)[..., 0]
