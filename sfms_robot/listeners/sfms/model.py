"""Both phases of SFMS put together: the tokenizer (scores, codes, inpainter) and the predictor of its tokens."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM
from sfms_robot.listeners.sfms.inpainter import Inpainter
from sfms_robot.listeners.sfms.placement import Strategy, place
from sfms_robot.listeners.sfms.predictor import Predictor
from sfms_robot.listeners.sfms.quantizer import Quantizer, codes_to_indices, indices_to_codes
from sfms_robot.listeners.sfms.score import ScoreNetwork
from sfms_robot.signals.mel import MEL_BINS


def membership(groups: Sequence[config.ChannelGroup]) -> Tensor:
    """(G, 58): 1 where a channel belongs to a group."""
    member = torch.zeros(len(groups), MOTION_DIM)
    for row, group in enumerate(groups):
        member[row, [CHANNEL_INDEX[name] for name in group.channels]] = 1.0
    return member


class Tokenizer(nn.Module):
    """Motion <-> tokens (B, T, G): 0 at a transition frame, 1 + code index at a keyframe. Motion is standardised."""

    member: Tensor

    def __init__(self, settings: config.Listener) -> None:
        super().__init__()
        groups = list(settings.groups.values())
        self.strategy: Strategy = settings.placement
        self.max_gap = settings.max_gap_frames
        self.window = settings.window_frames
        self.keyframes = [group.keyframes for group in groups]
        self.register_buffer("member", membership(groups), persistent=False)
        self.quantizer = Quantizer(self.member, [group.levels for group in groups])
        self.inpainter = Inpainter(self.quantizer, settings.tokenizer_width, settings.heads)
        # Only learned placement has scores to learn; the others carry no dead weights.
        self.score = (
            ScoreNetwork(MOTION_DIM, len(groups), settings.tokenizer_width, settings.heads)
            if settings.placement == "learned"
            else None
        )

    def counts(self, frames: int) -> list[int]:
        """Keyframes per group for a stretch of `frames`, at the configured rate per window."""
        return [max(1, round(k * frames / self.window)) for k in self.keyframes]

    def place(self, motion: Tensor) -> Tensor:
        """Mask (B, T, G) of motion (B, T, 58)."""
        gap = self.max_gap if motion.shape[1] >= self.window else None
        k = self.counts(motion.shape[1])
        return place(motion, k, self.strategy, member=self.member, score=self.score, max_gap=gap)

    def encode(self, motion: Tensor, mask: Tensor) -> Tensor:
        """Tokens (B, T, G) of motion (B, T, 58) whose keyframes are given."""
        indices = codes_to_indices(self.quantizer.encode(motion), self.quantizer.levels)
        return torch.where(mask > 0.5, indices + 1, 0)

    def decode(self, tokens: Tensor) -> Tensor:
        """Motion (B, T, 58) of tokens (B, T, G); a token below 0 counts as transition."""
        codes = indices_to_codes((tokens - 1).clamp(min=0), self.quantizer.levels)
        return self.inpaint(codes, (tokens > 0).float())

    def inpaint(self, codes: Tensor, mask: Tensor) -> Tensor:
        """Motion (B, T, 58) of codes (B, T, G, D) at a mask (B, T, G)."""
        out: Tensor = self.inpainter(codes, mask, self.quantizer)
        return out


class SfmsModel(nn.Module):
    """Weights of one listener, with the scales of its motion and sound."""

    motion_mean: Tensor
    motion_std: Tensor
    motion_speed: Tensor
    mel_mean: Tensor
    mel_std: Tensor

    def __init__(self, settings: config.Listener) -> None:
        super().__init__()
        self.register_buffer("motion_mean", torch.zeros(MOTION_DIM))
        self.register_buffer("motion_std", torch.ones(MOTION_DIM))
        # Fastest natural change of each channel from one frame to the next, standardised.
        self.register_buffer("motion_speed", torch.full((MOTION_DIM,), 1e6))
        self.register_buffer("mel_mean", torch.zeros(MEL_BINS))
        self.register_buffer("mel_std", torch.ones(MEL_BINS))
        self.tokenizer = Tokenizer(settings)
        self.predictor = Predictor(
            [group.levels for group in settings.groups.values()],
            MOTION_DIM,
            MEL_BINS,
            settings.future_frames,
            settings.predictor_width,
            settings.heads,
            settings.predictor_layers,
        )

    def standardise(self, motion: Tensor) -> Tensor:
        """Motion (..., 58) in `FaceFrame` units -> the model's own space."""
        return (motion - self.motion_mean) / self.motion_std

    def restore(self, motion: Tensor) -> Tensor:
        """The inverse of `standardise`, blendshapes kept in 0..1."""
        out = motion * self.motion_std + self.motion_mean
        return torch.cat([out[..., :6], out[..., 6:].clamp(0.0, 1.0)], dim=-1)

    def standardise_mel(self, mel: Tensor) -> Tensor:
        return (mel - self.mel_mean) / self.mel_std
