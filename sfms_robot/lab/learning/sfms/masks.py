"""Keyframe masks for training: fresh for every batch, or, where that is slow, from a bank placed beforehand.

Conditional scores (`learned`) learn from the exact masks, and so do the codes and the inpainter beside them: their own
masks differ little from their teacher's once they are learned, and need not be placed anew each step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sfms_robot.lab.learning.corpus import first_frames, windows
from sfms_robot.lab.learning.sfms.tokens import place_all
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import Strategy, place

FEW_GROUPS = 8  # up to so many, exact masks of a batch take less time than its step
MOST_WINDOWS = 2000  # of which masks are kept; more overlap than that teaches little
CHUNK = 32  # windows placed at a time

Batch = Callable[[int, torch.Generator], tuple[Tensor, Tensor]]  # batch size -> motion (B, T, C), masks (B, T, G)


def teacher(strategy: Strategy) -> Strategy:
    """The placement that a tokenizer of this strategy is trained on."""
    return "exact" if strategy == "learned" else strategy


@dataclass(frozen=True)
class MaskBank:
    """Masks (W, T, G) bool of the windows at `starts` (W,)."""

    starts: Tensor
    masks: Tensor

    def draw(self, size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """First frames (B,) and masks (B, T, G) of some windows."""
        window = torch.randint(len(self.starts), (size,), generator=generator)
        return self.starts[window], self.masks[window].float()


@torch.no_grad()
def mask_bank(tokenizer: Tokenizer, motion: Tensor, starts: Tensor, most: int = MOST_WINDOWS) -> MaskBank:
    """Masks of at most `most` of the windows at `starts`, evenly spread."""
    kept = starts[:: max(1, -(-len(starts) // min(most, MOST_WINDOWS)))]
    parts = [_masks(tokenizer, windows(motion, some, tokenizer.window)) > 0.5 for some in torch.split(kept, CHUNK)]
    return MaskBank(kept, torch.cat(parts))


def _masks(tokenizer: Tokenizer, batch: Tensor) -> Tensor:
    """(B, T, G)."""
    gap = tokenizer.max_gap if tokenizer.strategy == "exact" else None
    return place(batch, tokenizer.keyframes, teacher(tokenizer.strategy), member=tokenizer.member, max_gap=gap)


def batches(tokenizer: Tokenizer, motion: Tensor, lengths: Sequence[int], drawn: int) -> Batch:
    """What every training step draws: windows of the standardised motion (N, C) with their masks.

    `lengths` are those of the dyads in `motion`, `drawn` how many windows are ever asked for.
    """
    starts = first_frames(lengths, tokenizer.window)
    if teacher(tokenizer.strategy) == "exact" and len(tokenizer.member) > FEW_GROUPS:
        bank = mask_bank(tokenizer, motion, starts, drawn)

        def look_up(size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
            first, mask = bank.draw(size, generator)
            return windows(motion, first, tokenizer.window), mask

        return look_up

    if tokenizer.strategy == "penalised":  # a window is a piece of its dyad, and begins where the last keyframe is held
        whole = place_all(tokenizer, motion, lengths)

        def pieces(size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
            first = starts[torch.randint(len(starts), (size,), generator=generator)]
            mask = windows(whole, first, tokenizer.window)
            mask[:, 0] = 1.0
            return windows(motion, first, tokenizer.window), mask

        return pieces

    # A tokenizer that places exactly at run time sees half its masks from long stretches, as the predictor will.
    stretched = tokenizer.strategy == "exact"
    long_masks = place_all(tokenizer, motion, lengths) if stretched else None

    def fresh(size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        first = starts[torch.randint(len(starts), (size,), generator=generator)]
        batch = windows(motion, first, tokenizer.window)
        near = size // 2 if stretched else 0
        mask = _masks(tokenizer, batch[near:])
        if long_masks is not None:
            mask = torch.cat([windows(long_masks, first[:near], tokenizer.window), mask])
        return batch, mask

    return fresh
