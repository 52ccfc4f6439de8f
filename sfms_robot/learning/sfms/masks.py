"""Keyframe masks for training: fresh for every batch, or, where that is slow, from a bank placed before the first step.

Conditional scores (`learned`, `nested`) learn from the exact masks, and so do the codes and the inpainter beside them:
the scores' own masks differ little from their teacher's once they are learned, and need not be placed anew each step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sfms_robot.learning.sfms.corpus import Corpus, place_all, windows
from sfms_robot.listeners.sfms.exact import best_frames_each, segments
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import Strategy, place, place_static

FEW_GROUPS = 8  # up to so many, exact masks of a batch take less time than its step
MOST_WINDOWS = 2000  # of which masks are kept; more overlap than that teaches little
CHUNK = 32  # windows placed at a time

Batch = Callable[[int, torch.Generator], tuple[Tensor, Tensor]]  # batch size -> motion (B, T, C), masks (B, T, G)


def teacher(strategy: Strategy) -> Strategy:
    """The placement that a tokenizer of this strategy is trained on."""
    return "exact" if strategy in ("learned", "nested") else strategy


@dataclass(frozen=True)
class Bank:
    """Masks of W windows, one for each number of keyframes that may be drawn.

    Attributes:
        starts: (W,) first frames; masks: (K, W, T, G) bool.
    """

    starts: Tensor
    masks: Tensor

    def draw(self, size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """First frames (B,) and masks (B, T, G) of some windows, each with a number of keyframes of its own."""
        window = torch.randint(len(self.starts), (size,), generator=generator)
        number = torch.randint(len(self.masks), (size,), generator=generator)
        return self.starts[window], self.masks[number, window].float()


@torch.no_grad()
def bank(tokenizer: Tokenizer, motion: Tensor, starts: Tensor, drawn: tuple[int, int] | None) -> Bank:
    """Masks of at most `MOST_WINDOWS` of the windows at `starts`, evenly spread; `drawn` as in the configuration."""
    kept = starts[:: max(1, -(-len(starts) // MOST_WINDOWS))]
    parts = [_masks(tokenizer, windows(motion, some, tokenizer.window), drawn) for some in torch.split(kept, CHUNK)]
    return Bank(kept, torch.cat(parts, dim=1))


def _masks(tokenizer: Tokenizer, batch: Tensor, drawn: tuple[int, int] | None) -> Tensor:
    """(K, B, T, G) bool."""
    strategy, member = teacher(tokenizer.strategy), tokenizer.member
    if drawn is None:
        gap = tokenizer.max_gap if tokenizer.strategy == "exact" else None
        return place(batch, tokenizer.keyframes, strategy, member=member, max_gap=gap)[None] > 0.5
    if strategy == "exact":
        return exact_each(batch, member, *drawn) > 0.5
    counts = range(drawn[0], drawn[1] + 1)
    centred = strategy == "static"
    return torch.stack([place_static(batch, [k] * len(member), centred=centred) for k in counts]) > 0.5


@torch.no_grad()
def exact_each(motion: Tensor, member: Tensor, least: int, most: int) -> Tensor:
    """Exact masks (K, B, T, G) of motion (B, T, C) for every number of keyframes from `least` to `most`."""
    b, t, _ = motion.shape
    groups = []
    for row in member:
        own = motion[..., row > 0.5].double()
        frames = best_frames_each(segments(own @ own.transpose(1, 2)), least, most)
        blank = torch.zeros(b, t, device=motion.device)
        groups.append(torch.stack([blank.scatter(1, index, 1.0) for index in frames]))
    return torch.stack(groups, dim=-1)


def batches(tokenizer: Tokenizer, corpus: Corpus, motion: Tensor, drawn: tuple[int, int] | None) -> Batch:
    """What every training step draws: windows of the standardised motion (N, C) with their masks."""
    starts = corpus.starts(tokenizer.window)
    if teacher(tokenizer.strategy) == "exact" and len(tokenizer.member) > FEW_GROUPS:
        kept = bank(tokenizer, motion, starts, drawn)

        def look_up(size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
            first, mask = kept.draw(size, generator)
            return windows(motion, first, tokenizer.window), mask

        return look_up

    # A tokenizer that places exactly at run time sees half its masks from long stretches, as the predictor will.
    stretched = tokenizer.strategy == "exact" and drawn is None
    long_masks = place_all(tokenizer, motion, corpus.lengths) if stretched else None

    def fresh(size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        first = starts[torch.randint(len(starts), (size,), generator=generator)]
        batch = windows(motion, first, tokenizer.window)
        near = size // 2 if stretched else 0
        masks = _masks(tokenizer, batch[near:], drawn)
        number = torch.randint(len(masks), (size - near,), generator=generator)
        mask = masks[number, torch.arange(size - near)].float()
        if long_masks is not None:
            mask = torch.cat([windows(long_masks, first[:near], tokenizer.window), mask])
        return batch, mask

    return fresh
