"""Both phases of SFMS put together: the tokenizer (scores, codes, inpainter) and the predictor of its tokens."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.listeners.idle import BANDS, head_channels
from sfms_robot.listeners.layers import Block, sinusoidal
from sfms_robot.listeners.sfms.audio_frontend import SHAPES
from sfms_robot.listeners.sfms.neighbours import POSITION_BITS, Around, Neighbours
from sfms_robot.listeners.sfms.placement import Strategy, place
from sfms_robot.listeners.sfms.predictor import Predictor, SpeakerEncoder
from sfms_robot.listeners.sfms.quantizer import Quantizer
from sfms_robot.listeners.sfms.score import ConditionalScore, ScoreNetwork
from sfms_robot.signals.control import COLUMNS
from sfms_robot.signals.phase import FEATURES


def membership(groups: Sequence[config.ChannelGroup], channels: Sequence[str]) -> Tensor:
    """(G, C): 1 where a channel belongs to a group."""
    return torch.tensor([[float(name in group.channels) for name in channels] for group in groups])


# --- Sparse to dense (IV-B5) ------------------------------------------------------------------------------------------
#
# Keyframe codes and their places -> every frame. A keyframe encoder reads the keyframes, a transition encoder queries
# them from each frame's place between its neighbours, a decoder joins both (equations 9 and 10). Unlike the paper,
# the result is added to plain linear interpolation of the decoded keyframes: the network only has to learn how faces
# deviate from straight lines. `residual=False` is the paper's, which has to learn the lines as well: after 300 steps
# on recorded faces (k = 7, one set of keyframes per channel, exact masks, unseen takes) its error was 4.3 times as
# large. With `ramp` a line begins at most so many frames before its end.


class Inpainter(nn.Module):
    """phi of equation (9)."""

    def __init__(
        self,
        quantizer: Quantizer,
        width: int,
        heads: int,
        layers: int = 1,
        residual: bool = True,
        ramp: int | None = None,
    ) -> None:
        super().__init__()
        groups, channels = quantizer.member.shape
        dims = quantizer.dims
        self.width = width
        self.residual = residual
        self.ramp = ramp
        self.keyframe_in = nn.Linear(groups * (dims + 1), width)
        self.keyframe_encoder = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.transition_in = nn.Linear(groups * (dims + 2 * POSITION_BITS + 3), width)
        self.transition_encoder = nn.ModuleList(Block(width, heads, cross=True) for _ in range(layers))
        self.join = nn.Linear(2 * width, width)
        self.decoder = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, channels)
        if residual:  # training begins at the straight lines
            nn.init.zeros_(self.out.weight)
            nn.init.zeros_(self.out.bias)

    def forward(
        self,
        codes: Tensor,
        mask: Tensor,
        quantizer: Quantizer,
        last: int | None = None,
        around: Around | None = None,
    ) -> Tensor:
        """codes (B, T, G, D), read where mask (B, T, G) is 1 -> motion (B, T, C), standardised.

        `last`: only so many frames at the end are wanted, (B, last, C). `around`: where the mask is 1, for who knows.
        """
        if around is None:
            neighbours = Neighbours.in_mask(mask, self.ramp)
        else:
            neighbours = Neighbours.at(around.before, around.after, self.ramp)
        places = sinusoidal(mask.shape[1], self.width).to(codes)
        # Multiplying by the mask is where learned placement gets its gradient: forward it changes nothing.
        keyed = codes * mask[..., None]
        z_kf = self.keyframe_in(torch.cat([keyed, mask[..., None]], dim=-1).flatten(2)) + places
        # Other frames are neither looked at nor kept; but a gradient, which learned placement needs, passes there.
        rows, seen, found = _every(mask) if around is None else around[2:]
        z_keys = F.embedding(rows, z_kf.flatten(0, 1))
        for block in self.keyframe_encoder:
            z_keys = block(z_keys, seen=seen)
        z_kf = F.embedding(found, z_keys.flatten(0, 1)) * mask.amax(-1, keepdim=True)
        between = neighbours.interpolate(keyed)
        query = torch.cat([between, neighbours.positions()], dim=-1).flatten(2)  # concatenated, not added (IV-B5)
        z_tf = self.transition_in(query) + places
        for block in self.transition_encoder:
            z_tf = block(z_tf, memory=z_keys, memory_seen=seen)
        joined = self.join(torch.cat([z_kf, z_tf], dim=-1))
        *inner, outer = self.decoder
        for block in inner:
            joined = block(joined)
        out: Tensor = quantizer.drawn * self.out(self.norm(outer(joined, last=last)))
        if not self.residual:
            return out
        return out + self._straight(keyed, neighbours if last is None else neighbours.last(last), quantizer)

    @staticmethod
    def _straight(codes: Tensor, neighbours: Neighbours, quantizer: Quantizer) -> Tensor:
        """Lines between the decoded keyframes (B, T, C), each channel between those of its own group."""
        return quantizer.by_channel(neighbours.interpolate(quantizer.decoder(codes)))


def _every(mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`Around.rows`, `seen` and `places` of a mask (B, T, G) with every frame among the keyframes of its window; where
    no gradient is asked for, those alone that are one in any window.
    """
    seen = (mask > 0.5).any(-1)
    seen = seen | ~seen.any(-1, keepdim=True)  # a window without any keyframe looks at its blanks
    windows, frames = seen.shape
    frame = torch.arange(frames, device=mask.device)
    keys = frame if torch.is_grad_enabled() else seen.any(0).nonzero()[:, 0]
    window = torch.arange(windows, device=mask.device)[:, None]
    place = torch.zeros_like(frame).index_copy(0, keys, torch.arange(len(keys), device=mask.device))
    return window * frames + keys, seen[:, keys], window * len(keys) + place


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
