"""Motion of a whole corpus as tokens: what phase 2 is trained on."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sfms_robot.lab.learning.sfms.features import SfmsCorpus
from sfms_robot.listeners.sfms.model import SfmsModel, Tokenizer
from sfms_robot.listeners.sfms.predictor import last_keyframes

STRETCH_WINDOWS = 10  # exact placement shares its keyframes among this many windows


@torch.no_grad()
def place_all(tokenizer: Tokenizer, motion: Tensor, lengths: Sequence[int]) -> Tensor:
    """Keyframe masks (N, G) of all dyads: each dyad as a whole where a keyframe has its cost, else stretch by stretch,
    so that busy seconds may borrow from quiet ones of the same stretch.
    """
    size = tokenizer.window * (STRETCH_WINDOWS if tokenizer.strategy == "exact" else 1)
    masks = []
    for dyad in torch.split(motion, list(lengths)):
        if tokenizer.strategy == "penalised":
            masks.append(tokenizer.place(dyad[None])[0])
            continue
        for stretch in torch.split(dyad, _stretches(len(dyad), size, tokenizer.window)):
            masks.append(tokenizer.place(stretch[None])[0])
    return torch.cat(masks)


def _stretches(frames: int, size: int, least: int) -> list[int]:
    """Lengths that add up to `frames`, none under `least` unless there is only one."""
    whole, rest = divmod(frames, size)
    sizes = [size] * whole
    if rest and (rest >= least or not sizes):
        sizes.append(rest)
    elif rest:
        sizes[-1] += rest
    return sizes


@torch.no_grad()
def tokenise(model: SfmsModel, corpus: SfmsCorpus) -> Tensor:
    """Tokens (N, G) of every listener in the corpus."""
    motion = model.standardise(corpus.frames.motion.to(model.motion_mean.device))
    mask = place_all(model.tokenizer, motion, corpus.lengths)
    return torch.where(mask > 0.5, keyframe_tokens(model, motion), 0)


@torch.no_grad()
def keyframe_tokens(model: SfmsModel, motion: Tensor) -> Tensor:
    """What each frame of standardised motion (N, C) would be as a keyframe (N, G)."""
    quantizer = model.tokenizer.quantizer
    return torch.cat([quantizer.indices(quantizer.encode(m[None]))[0] + 1 for m in torch.split(motion, 4096)])


def held_tokens(tokens: Tensor, lengths: Sequence[int]) -> Tensor:
    """Of tokens (N, G) of dyads of those lengths: the last keyframe at or before each frame of its dyad, 0 for none."""
    return torch.cat([last_keyframes(one[None]).tokens[0, ..., 0] for one in torch.split(tokens, list(lengths))])
