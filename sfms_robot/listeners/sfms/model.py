"""Both phases of SFMS put together: the tokenizer (scores, codes, inpainter) and the predictor of its tokens."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.listeners.sfms.inpainter import Inpainter
from sfms_robot.listeners.sfms.placement import Strategy, place
from sfms_robot.listeners.sfms.predictor import Predictor
from sfms_robot.listeners.sfms.quantizer import Quantizer, codes_to_indices, indices_to_codes
from sfms_robot.listeners.sfms.score import ScoreNetwork
from sfms_robot.signals.mel import MEL_BINS


def membership(groups: Sequence[config.ChannelGroup], channels: Sequence[str]) -> Tensor:
    """(G, C): 1 where a channel belongs to a group."""
    return torch.tensor([[float(name in group.channels) for name in channels] for group in groups])


class Tokenizer(nn.Module):
    """Motion <-> tokens (B, T, G): 0 at a transition frame, 1 + code index at a keyframe. Motion is standardised."""

    member: Tensor

    def __init__(self, settings: config.Sfms) -> None:
        super().__init__()
        groups = list(settings.groups.values())
        self.strategy: Strategy = settings.placement
        self.max_gap = settings.max_gap_frames
        self.window = settings.window_frames
        self.keyframes = [group.keyframes for group in groups]
        self.register_buffer("member", membership(groups, settings.channels), persistent=False)
        self.quantizer = Quantizer(self.member, [group.levels for group in groups])
        self.inpainter = Inpainter(self.quantizer, settings.tokenizer_width, settings.heads)
        # Only learned placement has scores to learn; the others carry no dead weights.
        self.score = (
            ScoreNetwork(len(settings.channels), len(groups), settings.tokenizer_width, settings.heads)
            if settings.placement == "learned"
            else None
        )

    def counts(self, frames: int) -> list[int]:
        """Keyframes per group for a stretch of `frames`, at the configured rate per window."""
        return [max(1, round(k * frames / self.window)) for k in self.keyframes]

    def place(self, motion: Tensor) -> Tensor:
        """Mask (B, T, G) of motion (B, T, C)."""
        gap = self.max_gap if motion.shape[1] >= self.window else None
        k = self.counts(motion.shape[1])
        return place(motion, k, self.strategy, member=self.member, score=self.score, max_gap=gap)

    def encode(self, motion: Tensor, mask: Tensor) -> Tensor:
        """Tokens (B, T, G) of motion (B, T, C) whose keyframes are given."""
        indices = codes_to_indices(self.quantizer.encode(motion), self.quantizer.levels)
        return torch.where(mask > 0.5, indices + 1, 0)

    def decode(self, tokens: Tensor) -> Tensor:
        """Motion (B, T, C) of tokens (B, T, G); a token below 0 counts as transition."""
        codes = indices_to_codes((tokens - 1).clamp(min=0), self.quantizer.levels)
        return self.inpaint(codes, (tokens > 0).float())

    def inpaint(self, codes: Tensor, mask: Tensor) -> Tensor:
        """Motion (B, T, C) of codes (B, T, G, D) at a mask (B, T, G)."""
        out: Tensor = self.inpainter(codes, mask, self.quantizer)
        return out


class SfmsModel(nn.Module):
    """Weights of one listener, with the scales of its motion and sound."""

    motion_mean: Tensor
    motion_std: Tensor
    motion_speed: Tensor
    mel_mean: Tensor
    mel_std: Tensor

    def __init__(self, settings: config.Sfms) -> None:
        super().__init__()
        width = len(settings.channels)
        self.register_buffer("motion_mean", torch.zeros(width))
        self.register_buffer("motion_std", torch.ones(width))
        # Fastest natural change of each channel from one frame to the next, standardised.
        self.register_buffer("motion_speed", torch.full((width,), 1e6))
        self.register_buffer("mel_mean", torch.zeros(MEL_BINS))
        self.register_buffer("mel_std", torch.ones(MEL_BINS))
        self.tokenizer = Tokenizer(settings)
        self.predictor = Predictor(
            [group.levels for group in settings.groups.values()],
            width,
            MEL_BINS,
            settings.future_frames,
            settings.predictor_width,
            settings.heads,
            settings.predictor_layers,
        )

    def standardise(self, motion: Tensor) -> Tensor:
        """Motion (..., C) of the model's motion space -> the units it works in."""
        return (motion - self.motion_mean) / self.motion_std

    def restore(self, motion: Tensor) -> Tensor:
        """The inverse of `standardise`."""
        return motion * self.motion_std + self.motion_mean

    def standardise_mel(self, mel: Tensor) -> Tensor:
        return (mel - self.mel_mean) / self.mel_std
