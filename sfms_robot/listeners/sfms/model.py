"""Both phases of SFMS put together: the tokenizer (scores, codes, inpainter) and the predictor of its tokens."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.listeners.sfms.audio_frontend import SHAPES
from sfms_robot.listeners.sfms.inpainter import Inpainter
from sfms_robot.listeners.sfms.neighbours import Around
from sfms_robot.listeners.sfms.placement import Strategy, place
from sfms_robot.listeners.sfms.predictor import Predictor
from sfms_robot.listeners.sfms.quantizer import Quantizer
from sfms_robot.listeners.sfms.score import ConditionalScore, ScoreNetwork
from sfms_robot.listeners.sfms.speaker import SpeakerEncoder
from sfms_robot.listeners.sway import BANDS, head_channels
from sfms_robot.signals.control import COLUMNS
from sfms_robot.signals.phase import FEATURES


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
        self.sweeps = settings.scores.sweeps
        self.window = settings.window_frames
        self.ramp = settings.ramp_frames
        self.keyframes = [group.keyframes or 0 for group in groups]  # none where each has its cost instead
        self.costs = [group.keyframe_cost or 0.0 for group in groups]
        self.register_buffer("member", membership(groups, settings.channels), persistent=False)
        levels = [group.levels for group in groups]
        self.quantizer = Quantizer(self.member, levels, settings.quantizer, settings.code_dims)
        self.inpainter = Inpainter(
            self.quantizer,
            settings.tokenizer_width,
            settings.heads,
            settings.tokenizer_layers,
            residual=settings.inpainter == "residual",
            ramp=settings.ramp_frames,
        )
        self.score = _score_network(settings)

    def counts(self, frames: int) -> list[int]:
        """Keyframes per group for a stretch of `frames`, at the configured rate per window."""
        return [max(1, round(k * frames / self.window)) for k in self.keyframes]

    def place(self, motion: Tensor, keyframes: Sequence[int] | None = None, strategy: Strategy | None = None) -> Tensor:
        """Mask (B, T, G) of motion (B, T, C); `keyframes` (per group), `strategy`: others than the configured ones."""
        gap = self.max_gap if motion.shape[1] >= self.window and keyframes is None else None
        return place(
            motion,
            keyframes or self.counts(motion.shape[1]),
            strategy or self.strategy,
            member=self.member,
            score=self.score,
            max_gap=gap,
            sweeps=self.sweeps,
            costs=self.costs,
            ramp=self.ramp,
        )

    def encode(self, motion: Tensor, mask: Tensor) -> Tensor:
        """Tokens (B, T, G) of motion (B, T, C) whose keyframes are given."""
        indices = self.quantizer.indices(self.quantizer.encode(motion))
        return torch.where(mask > 0.5, indices + 1, 0)

    def decode(self, tokens: Tensor, last: int | None = None, around: Around | None = None) -> Tensor:
        """Motion (B, T, C) of tokens (B, T, G), or of the `last` frames alone; a token below 0 counts as transition.

        `around`: what there is around every frame, for who knows.
        """
        codes = self.quantizer.codes((tokens - 1).clamp(min=0))
        return self.inpaint(codes, (tokens > 0).float(), last, around)

    def inpaint(self, codes: Tensor, mask: Tensor, last: int | None = None, around: Around | None = None) -> Tensor:
        """Motion (B, T, C) of codes (B, T, G, D) at a mask (B, T, G), or of the `last` frames alone."""
        out: Tensor = self.inpainter(codes, mask, self.quantizer, last, around)
        return out


def _score_network(settings: config.Sfms) -> ScoreNetwork | ConditionalScore | None:
    """Only learned placement has scores to learn; the others carry no dead weights."""
    scores = settings.scores
    if settings.placement == "learned_paper":
        channels, groups = len(settings.channels), len(settings.groups)
        return ScoreNetwork(channels, groups, scores.width, scores.heads, scores.layers)
    if settings.placement == "learned":
        largest = max(len(group.channels) for group in settings.groups.values())
        return ConditionalScore(largest, scores.width, scores.heads, scores.layers)
    return None


class SfmsModel(nn.Module):
    """Weights of one listener, with the scales of its motion and sound."""

    motion_mean: Tensor
    motion_std: Tensor
    motion_speed: Tensor
    sound_mean: Tensor
    sound_std: Tensor
    sway_mixture: Tensor
    sway_spread: Tensor

    def __init__(self, settings: config.Sfms) -> None:
        super().__init__()
        width, (rows, bins) = len(settings.channels), SHAPES[settings.audio]
        phases = FEATURES if settings.phase else 0
        self.register_buffer("motion_mean", torch.zeros(width))
        self.register_buffer("motion_std", torch.ones(width))
        # Fastest natural change of each channel from one frame to the next, standardised.
        self.register_buffer("motion_speed", torch.full((width,), 1e6))
        self.register_buffer("sound_mean", torch.zeros(bins))
        self.register_buffer("sound_std", torch.ones(bins))
        self.head = head_channels(settings.channels) if settings.sway else []
        if settings.sway:
            self.register_buffer("sway_mixture", torch.zeros(BANDS, len(self.head), len(self.head)))
            self.register_buffer("sway_spread", torch.zeros(()))
        self.tokenizer = Tokenizer(settings)
        inner, heads = settings.predictor_width, settings.heads
        self.predictor = Predictor(
            [group.levels for group in settings.groups.values()],
            settings.quantizer,
            SpeakerEncoder(width, rows, bins, phases, inner, heads, settings.speaker_layers),
            settings.future_frames,
            inner,
            heads,
            settings.predictor_layers,
            settings.sequential,
            len(COLUMNS) if settings.events else 0,
        )

    def standardise(self, motion: Tensor) -> Tensor:
        """Motion (..., C) of the model's motion space -> the units it works in."""
        return (motion - self.motion_mean) / self.motion_std

    def restore(self, motion: Tensor) -> Tensor:
        """The inverse of `standardise`."""
        return motion * self.motion_std + self.motion_mean

    def standardise_sound(self, rows: Tensor) -> Tensor:
        """Rows (..., bins) of sound features, likewise."""
        return (rows - self.sound_mean) / self.sound_std
