"""Listening head prediction (IV-C): 40 frames of both people -> classes of the next 8 frames, per channel group.

Class 0 is transition, class 1 + i the keyframe code i. The speaker has a gated dual encoder (`SpeakerEncoder`), the
listener's own tokens an encoder of their own, and a decoder asks both from all future frames at once: the paper's
parallel prediction. Beyond the paper, a `sequential` predictor ends in a small network that is told which keyframes
precede each frame, so that frames drawn one after another agree; the transformers still run once per plan. And one that
is told of events reads what each frame, past or to come, belongs to: a row of `signals.control` joins the tokens of the
frame.

Shapes: B batch, P past frames, H future frames, G channel groups, D digits of a code, W width, V classes, K columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.listeners.layers import Attention, Block, FeedForward, sinusoidal
from sfms_robot.listeners.sfms.quantizer import as_levels, indices_to_codes

AGE_SCALE_FRAMES = 4.0


@dataclass(frozen=True)
class Context:
    """What the predictor may look at.

    Attributes:
        face: (B, P, C) speaker's standardised motion; anything where not `face_known`.
        face_known: (B, P) bool.
        voice: (B, P, W) what `SpeakerEncoder.listen` made of the sound; anything where not `heard`.
        heard: (B, P) bool.
        phase: (B, P, F) where the speaker is in a phrase; anything where not `heard`; F = 0 without.
        tokens: (B', P + H, G) the listener's own: past, what of the future is drawn already, UNDECIDED. B' = B, or
            any number when B = 1: many answers to one speaker.
        control: (B', P + H, K) what is told of events in each of those frames; K = 0 without.
    """

    face: Tensor
    face_known: Tensor
    voice: Tensor
    heard: Tensor
    phase: Tensor
    tokens: Tensor
    control: Tensor


class LastKeyframes(NamedTuple):
    """The last two keyframes of every group, the newer first: tokens (..., G, 2), 0 for none yet, and their frames."""

    tokens: Tensor
    at: Tensor


def last_keyframes(tokens: Tensor) -> LastKeyframes:
    """Tokens (B, T, G) -> the last keyframes at every frame, that frame included; -1 is before the first frame."""
    frame = torch.arange(tokens.shape[1], device=tokens.device)[None, :, None]
    last = torch.where(tokens > 0, frame, -1).cummax(1).values
    earlier = torch.cat([torch.full_like(last[:, :1], -1), last[:, :-1]], dim=1)  # of the frame before
    before = torch.where(last < 0, -1, earlier.gather(1, last.clamp(min=0)))
    found = [torch.where(at < 0, 0, tokens.gather(1, at.clamp(min=0))) for at in (last, before)]
    return LastKeyframes(torch.stack(found, dim=-1), torch.stack([last, before], dim=-1))


# --- Speaker ----------------------------------------------------------------------------------------------------------
#
# The speaker's face and voice, fused by the gated dual encoder of equation (12). `listen` turns the sound of every
# frame into one vector, looking back one frame and never ahead: it runs once per frame and serves all plans that look
# back on that frame. The encoder then reads the last 40 of them together with the face.

KERNEL_ROWS = 5


class GatedCross(nn.Module):
    """One side of equation (12): x~ = SelfAtt(x); x = x + x~ + alpha CrossAtt(x~, y); x = x + FFN(x)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.own = Attention(width, heads)
        self.other = Attention(width, heads)
        self.alpha = nn.Parameter(torch.tensor(0.1))
        self.ffn = FeedForward(width)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        normed = self.norm(x)
        own = self.own(normed, normed)
        x = x + own + self.alpha * self.other(own, y)
        out: Tensor = x + self.ffn(x)
        return out


class SpeakerEncoder(nn.Module):
    """Face and voice of the speaker -> (B, 2P, W)."""

    def __init__(self, channels: int, rows: int, bins: int, phase: int, width: int, heads: int, layers: int) -> None:
        """`rows` of `bins` numbers per frame of sound; `phase` numbers about its place in a phrase, 0 for none."""
        super().__init__()
        self.rows = rows
        self.face_in = nn.Linear(channels, width)
        # Several rows a frame: convolution and max-pool align them; one: the direct path (IV-C1).
        self.conv = nn.Conv1d(bins, width, KERNEL_ROWS) if rows > 1 else None
        self.direct = nn.Linear(bins, width) if rows == 1 else None
        self.phase_in = nn.Linear(phase, width) if phase else None
        self.no_face = nn.Parameter(torch.zeros(width))
        self.no_voice = nn.Parameter(torch.zeros(width))
        self.face = nn.ModuleList(GatedCross(width, heads) for _ in range(layers))
        self.voice = nn.ModuleList(GatedCross(width, heads) for _ in range(layers))

    def listen(self, sound: Tensor) -> Tensor:
        """Standardised sound (B, (1 + n) * rows, bins), the frame before first -> (B, n, W)."""
        if self.direct is not None:
            y: Tensor = self.direct(sound[:, 1:])
            return y
        if self.conv is None:
            raise ValueError("this encoder has no way in for sound")
        # As a matrix product: for the few rows of one frame Conv1d takes several times as long.
        near = sound[:, self.rows - KERNEL_ROWS + 1 :].unfold(1, KERNEL_ROWS, 1)  # (B, n * rows, bins, K)
        y = F.linear(near.flatten(2), self.conv.weight.flatten(1), self.conv.bias)
        return F.gelu(y.view(y.shape[0], -1, self.rows, y.shape[-1]).amax(2))

    def forward(self, face: Tensor, face_known: Tensor, voice: Tensor, heard: Tensor, phase: Tensor) -> Tensor:
        """face (B, P, C), voice (B, P, W) of `listen`, phase (B, P, F); (B, P) bool say which frames count."""
        x = torch.where(face_known[..., None], self.face_in(face), self.no_face)
        if self.phase_in is not None:
            voice = voice + self.phase_in(phase)
        y = torch.where(heard[..., None], voice, self.no_voice)
        places = sinusoidal(x.shape[1], x.shape[2]).to(x)
        x, y = x + places, y + places
        for face_layer, voice_layer in zip(self.face, self.voice, strict=True):
            x, y = face_layer(x, y), voice_layer(y, x)
        return torch.cat([x, y], dim=1)


class Predictor(nn.Module):
    """Equation (11) with 8 future frames at once. `classes` of a group are its codes and the transition."""

    codes: Tensor
    place: Tensor
    first: Tensor

    def __init__(
        self,
        levels: Sequence[Sequence[int]],
        quantizer: Literal["fsq", "vq"],
        speaker: SpeakerEncoder,
        future: int,
        width: int,
        heads: int,
        layers: int,
        sequential: bool,
        control: int = 0,
    ) -> None:
        """`levels` of each group; `control` columns, 0 for a predictor that is not told of events."""
        super().__init__()
        grid = as_levels(levels)
        sizes = grid.prod(-1).long()
        groups, most = len(sizes), int(sizes.max())
        every = torch.arange(most)[:, None] % sizes  # (V - 1, G)
        table = torch.cat([torch.zeros(1, *grid.shape), indices_to_codes(every, grid)])
        table = table.transpose(0, 1).contiguous()  # (G, V, D), 0 for none
        if quantizer == "fsq":
            self.register_buffer("codes", table, persistent=False)
        else:  # no grid tells which codes are alike: that is learned
            self.codes = nn.Parameter(torch.randn_like(table) * 0.5)
        classes = sizes + 1
        place = (classes.cumsum(0) - classes)[:, None] + torch.arange(most + 1)  # row of `classify` of every class
        place = torch.where(torch.arange(most + 1) < classes[:, None], place, int(classes.sum()))
        self.register_buffer("place", place.flatten(), persistent=False)  # classes a group lacks: one row too many
        self.register_buffer("first", torch.arange(groups)[:, None] * (most + 1), persistent=False)  # row of each group
        self.groups, self.future = groups, future
        described = groups * (2 * grid.shape[1] + 2)
        self.speaker = speaker
        self.token_in = nn.Linear(described + groups, width)
        self.undecided = nn.Parameter(torch.randn(width) * 0.02)
        self.own = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.slots = nn.Parameter(torch.randn(future, width) * 0.02)
        self.role = nn.Parameter(torch.randn(3, width) * 0.02)
        self.phase_in = None if speaker.phase_in is None else nn.Linear(speaker.phase_in.in_features, width)
        self.decoder = nn.ModuleList(Block(width, heads, cross=True) for _ in range(layers))
        # Weights keep the name that they were first saved under.
        self.trail_in = nn.Linear(described, width) if sequential else None
        self.chain = FeedForward(width) if sequential else None
        self.norm = nn.LayerNorm(width)
        self.classify = nn.Linear(width, int(classes.sum()))
        self.control_in = (
            nn.Sequential(nn.Linear(control, width), nn.GELU(), nn.Linear(width, width)) if control else None
        )

    def forward(self, context: Context, recent: LastKeyframes | None = None) -> Tensor:
        """What is known about every future frame without knowing those before it: (B, H, W).

        `recent`: what `last_keyframes` finds in the context's tokens, for those who need it themselves.
        """
        c = context
        speaker = self.speaker(c.face, c.face_known, c.voice, c.heard, c.phase)
        own = self._own(c.tokens, last_keyframes(c.tokens) if recent is None else recent, c.control)
        newest = torch.where(c.heard[:, -1:], c.phase[:, -1], 0.0).expand(own.shape[0], -1)
        speaker = speaker.expand(own.shape[0], -1, -1)
        speaker = speaker + self.role[:2].repeat_interleave(c.heard.shape[1], dim=0)
        memory = torch.cat([speaker, own + self.role[2]], dim=1)  # (B, 2P + P + H, W)
        x = self.slots + own[:, -self.future :]
        if self.phase_in is not None:
            x = x + self.phase_in(newest)[:, None]
        for block in self.decoder:
            x = block(x, memory=memory)
        return x

    def _own(self, tokens: Tensor, recent: LastKeyframes, control: Tensor) -> Tensor:
        """Tokens (B, P + H, G), their last keyframes and control rows (B, P + H, K) -> (B, P + H, W)."""
        features = torch.cat([self.describe(recent, _frames(tokens)), (tokens > 0).float()], dim=-1)
        x = torch.where((tokens >= 0).all(-1, keepdim=True), self.token_in(features), self.undecided)
        if self.control_in is not None:
            x = x + self.control_in(control)
        x = x + sinusoidal(x.shape[1], x.shape[2]).to(x)
        for block in self.own:
            x = block(x)
        return x

    def describe(self, recent: LastKeyframes, frame: Tensor | int) -> Tensor:
        """Last keyframes (..., G) as seen at `frame`: both codes and how long ago they were, (..., G * (2D + 2))."""
        codes = nn.functional.embedding(recent.tokens + self.first, self.codes.flatten(0, 1))  # (..., G, 2, D)
        ages = torch.log1p((frame - recent.at) / AGE_SCALE_FRAMES)
        return torch.cat([codes.flatten(-2), ages], dim=-1).flatten(-2)

    def classes(self, slots: Tensor, recent: LastKeyframes | None = None, frame: Tensor | int = 0) -> Tensor:
        """Logits (..., G, V) of slots (..., W), V the most classes of a group, -inf for those that it lacks.

        A sequential predictor needs the last keyframes (..., G) up to the frame before each, and that frame's number.
        """
        logits = nn.functional.pad(self.flat_logits(slots, recent, frame), (0, 1), value=-torch.inf)
        return logits.index_select(-1, self.place).view(*slots.shape[:-1], self.groups, -1)

    def flat_logits(self, slots: Tensor, recent: LastKeyframes | None = None, frame: Tensor | int = 0) -> Tensor:
        """`classes` as the network has them: (..., all classes of all groups), without those that a group lacks."""
        if self.trail_in is not None and self.chain is not None and recent is not None:
            slots = slots + self.trail_in(self.describe(recent, frame))
            slots = slots + self.chain(slots)
        out: Tensor = self.classify(self.norm(slots))
        return out

    def teacher_forced(self, context: Context, target: Tensor) -> Tensor:
        """Logits (B, H, G, V) of every future frame, told the true ones (B, H, G) before it where it is sequential."""
        told = torch.cat([context.tokens[:, : -self.future], target], dim=1)
        before = slice(-self.future - 1, -1)
        recent = LastKeyframes(*(part[:, before] for part in last_keyframes(told)))
        return self.classes(self(context), recent, _frames(told)[:, before])


def _frames(tokens: Tensor) -> Tensor:
    """(1, T, 1, 1): the number of every frame."""
    return torch.arange(tokens.shape[1], device=tokens.device)[None, :, None, None]
