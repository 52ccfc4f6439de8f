"""Listening head prediction (IV-C): 40 frames of both people -> classes of the next 8 frames, per channel group.

Class 0 is transition, class 1 + i the keyframe code i. The speaker has a gated dual encoder (`SpeakerEncoder`), the
listener's own tokens have a separate encoder, and a decoder queries both from all future frames at once: the paper's
parallel prediction. Ours:

    sequential   a small network at the end receives the keyframes that precede each frame, so that frames drawn one
                 after another agree; the transformers still run once per plan
    events       a row of `signals.control` joins the tokens of each frame, past or future: it shows the predictor which
                 event a frame belongs to
    phase        the speaker's place in a phrase, which reaches back further than 40 frames

Shapes: B batch, P past frames, H future frames, G channel groups, D digits of a code, W width, V classes, K columns.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.listeners.audio_frontend import SHAPES
from sfms_robot.listeners.layers import Attention, Block, NormFeedForward, mlp, places_of
from sfms_robot.listeners.sfms.draw import Context, LastKeyframes
from sfms_robot.listeners.sfms.quantizer import Grid
from sfms_robot.signals.control import COLUMNS
from sfms_robot.signals.phase import FEATURES

AGE_SCALE_FRAMES = 4.0
KERNEL_ROWS = 5  # rows of sound in the kernel of the convolution


def last_keyframes(tokens: Tensor) -> LastKeyframes[Tensor]:
    """Return `draw.last_keyframes` of tokens (B, T, G), computed on their device."""
    known = F.pad(tokens.clamp(min=0), (0, 0, 1, 0))  # a frame before all others, for frames without a keyframe yet
    frame = torch.arange(known.shape[1], device=tokens.device)[:, None]
    last = torch.where(known > 0, frame, 0).cummax(1).values
    before = torch.cat([last[:, :1], last[:, :-1]], dim=1).gather(1, last)  # the keyframe before the last
    at = torch.stack([last, before], dim=-1)[:, 1:]
    return LastKeyframes(torch.stack([known.gather(1, one) for one in at.unbind(-1)], dim=-1), at - 1)


# --- Speaker (IV-C1) --------------------------------------------------------------------------------------------------
#
# The speaker's face and voice, fused by the gated dual encoder of equation (12). `listen` turns the sound of every
# frame into one vector, looking back one frame and never ahead: it runs once per frame and serves all plans that look
# back on that frame. The input of the encoder is the last 40 of these vectors together with the face.


class GatedCross(nn.Module):
    """One side of equation (12): x~ = SelfAtt(x); x = x + x~ + alpha CrossAtt(x~, y); x = x + FFN(x)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.own = Attention(width, heads)
        self.other = Attention(width, heads)
        self.alpha = nn.Parameter(torch.tensor(0.1))
        self.ffn = NormFeedForward(width)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """Return x (B, P, W) after attention to itself and to y (B, P, W)."""
        normed = self.norm(x)  # ours: pre-norm, as in all blocks here
        own = self.own(normed, normed)  # x~
        x = x + own + self.alpha * self.other(own, y)
        out: Tensor = x + self.ffn(x)
        return out


class SpeakerEncoder(nn.Module):
    """Face and voice of the speaker -> (B, 2P, W)."""

    def __init__(self, settings: config.Sfms) -> None:
        super().__init__()
        width, heads, layers = settings.predictor_width, settings.heads, settings.speaker_layers
        self.rows, bins = SHAPES[settings.audio]
        self.face_in = nn.Linear(len(settings.channels), width)
        # Several rows per frame: convolution and max-pool align them; one row: the direct path (IV-C1).
        self.conv = nn.Conv1d(bins, width, KERNEL_ROWS) if self.rows > 1 else None
        self.direct: nn.Module = nn.Linear(bins, width) if self.rows == 1 else nn.Identity()
        self.phase_in = nn.Linear(FEATURES, width) if settings.phase else None
        self.no_face = nn.Parameter(torch.zeros(width))
        self.no_voice = nn.Parameter(torch.zeros(width))
        self.face = nn.ModuleList(GatedCross(width, heads) for _ in range(layers))
        self.voice = nn.ModuleList(GatedCross(width, heads) for _ in range(layers))

    def listen(self, sound: Tensor) -> Tensor:
        """Return (B, n, W) of standardised sound (B, (1 + n) * rows, bins), which begins with the frame before."""
        if self.conv is None:
            direct: Tensor = self.direct(sound[:, 1:])
            return direct
        # As a matrix product: for the few rows of one frame Conv1d takes several times as long.
        near = sound[:, self.rows - KERNEL_ROWS + 1 :].unfold(1, KERNEL_ROWS, 1)  # (B, n * rows, bins, K)
        y = F.linear(near.flatten(2), self.conv.weight.flatten(1), self.conv.bias)
        return F.gelu(y.view(y.shape[0], -1, self.rows, y.shape[-1]).amax(2))

    def forward(self, c: Context[Tensor]) -> Tensor:
        """Return (B, 2P, W): first the frames of the face, then those of the voice."""
        x = torch.where(c.face_known[..., None], self.face_in(c.face), self.no_face)
        voice = c.voice if self.phase_in is None else c.voice + self.phase_in(c.phase)
        y = torch.where(c.heard[..., None], voice, self.no_voice)
        places = places_of(x)  # (P, W)
        x, y = x + places, y + places
        for face_layer, voice_layer in zip(self.face, self.voice, strict=True):
            x, y = face_layer(x, y), voice_layer(y, x)
        return torch.cat([x, y], dim=1)


# --- Listener (IV-C2) -------------------------------------------------------------------------------------------------


class Predictor(nn.Module):
    """Equation (11) for 8 future frames at once. The `classes` of a group are its codes and the transition."""

    codes: Tensor

    def __init__(self, settings: config.Sfms) -> None:
        super().__init__()
        speaker = SpeakerEncoder(settings)  # created first, so that seeded weights stay the same
        width, heads, layers = settings.predictor_width, settings.heads, settings.predictor_layers
        grid = Grid([group.levels for group in settings.groups.values()])
        self.classes = [1 + group.codes for group in settings.groups.values()]
        groups, most = len(self.classes), max(self.classes)
        table = F.pad(grid.table.view(groups, most - 1, grid.dims), (0, 0, 1, 0))  # (G, V, D), 0 for none
        if settings.quantizer == "fsq":
            self.codes = nn.Buffer(table, persistent=False)
        else:  # without a grid, the similarity of codes has to be learned
            self.codes = nn.Parameter(torch.randn_like(table) * 0.5)
        self.first = nn.Buffer(torch.arange(groups)[:, None] * most, persistent=False)  # row of `codes`, (G, 1)
        self.future = settings.future_frames
        described = groups * (2 * grid.dims + 2)
        self.speaker = speaker
        self.token_in = nn.Linear(described + groups, width)
        self.undecided = nn.Parameter(torch.randn(width) * 0.02)
        self.own = nn.ModuleList(Block(width, heads) for _ in range(layers))
        # Queries of the H future frames: the paper's parallel prediction of 8 frames (V-C).
        self.slots = nn.Parameter(torch.randn(self.future, width) * 0.02)
        self.role = nn.Parameter(torch.randn(3, width) * 0.02)  # face, voice, own tokens
        self.phase_in = nn.Linear(FEATURES, width) if settings.phase else None
        self.decoder = nn.ModuleList(Block(width, heads, cross=True) for _ in range(layers))
        # `trail_in` and `chain`: names under which these weights were first saved.
        self.trail_in = nn.Linear(described, width) if settings.sequential else None
        self.chain = NormFeedForward(width) if settings.sequential else None
        self.norm = nn.LayerNorm(width)
        self.classify = nn.Linear(width, sum(self.classes))
        self.control_in = mlp(len(COLUMNS), width, width) if settings.events else None

    def forward(self, context: Context[Tensor], recent: LastKeyframes[Tensor] | None = None) -> Tensor:
        """Return slots (B, H, W): every future frame without the keyframes drawn before it.

        `recent`: `last_keyframes` of the context's tokens, for a caller that has them.
        """
        c = context
        # IV-C2: encoders of the speaker and of the listener, and one decoder that future frames query.
        speaker = self.speaker(c)
        own = self._own(c.tokens, last_keyframes(c.tokens) if recent is None else recent, c.control)
        # The place in the phrase at the newest frame also goes to every future frame directly.
        newest = torch.where(c.heard[:, -1:], c.phase[:, -1], 0.0).expand(own.shape[0], -1)
        speaker = speaker.expand(own.shape[0], -1, -1)
        # Ours: learned roles mark the modality of each memory slot for the decoder.
        speaker = speaker + self.role[:2].repeat_interleave(c.heard.shape[1], dim=0)
        memory = torch.cat([speaker, own + self.role[2]], dim=1)  # (B, 2P + P + H, W)
        x = self.slots + own[:, -self.future :]  # (B, H, W): queries of the future frames
        if self.phase_in is not None:
            x = x + self.phase_in(newest)[:, None]
        for block in self.decoder:
            x = block(x, memory=memory)
        return x

    def _own(self, tokens: Tensor, recent: LastKeyframes[Tensor], control: Tensor) -> Tensor:
        """Return (B, P + H, W) of tokens (B, P + H, G), their last keyframes and control rows (B, P + H, K)."""
        # A token is described by the last two keyframes of each group, not embedded alone: most frames are transitions.
        features = torch.cat([self.describe(recent, _frames(tokens)), (tokens > 0).float()], dim=-1)
        # Frames that are not drawn yet are one learned vector; they differ by their control rows.
        x = torch.where((tokens >= 0).all(-1, keepdim=True), self.token_in(features), self.undecided)
        if self.control_in is not None:
            x = x + self.control_in(control)
        x = x + places_of(x)
        for block in self.own:
            x = block(x)
        return x

    def describe(self, recent: LastKeyframes[Tensor], frame: Tensor) -> Tensor:
        """Return (..., G * (2D + 2)): the codes of last keyframes (..., G, 2) and their ages at `frame`."""
        codes = F.embedding(recent.tokens + self.first, self.codes.flatten(0, 1))  # (..., G, 2, D)
        # Single frames matter for the age of near keyframes, hardly for old ones: ages are on a logarithmic axis.
        ages = torch.log1p((frame - recent.at) / AGE_SCALE_FRAMES)
        return torch.cat([codes.flatten(-2), ages], dim=-1).flatten(-2)

    def flat_logits(self, slots: Tensor, recent: LastKeyframes[Tensor], frame: Tensor) -> Tensor:
        """Return logits (..., all classes of all groups) of slots (..., W).

        `recent`: for a sequential predictor, last keyframes (..., G, 2) up to the frame before, which is `frame`.
        """
        if self.trail_in is not None and self.chain is not None:
            slots = slots + self.trail_in(self.describe(recent, frame))
            slots = slots + self.chain(slots)
        out: Tensor = self.classify(self.norm(slots))
        return out

    def teacher_forced(self, context: Context[Tensor], target: Tensor) -> Tensor:
        """Return logits (B, H, G, V) of all future frames; a sequential predictor sees the true ones before each.

        `target`: the true tokens (B, H, G). V is the largest number of classes of a group; missing classes are -inf.
        """
        tokens = torch.cat([context.tokens[:, : -self.future], target], dim=1)
        # Ours, `sequential`: the last keyframes up to the frame before each future one, frames P - 1 to P + H - 2. It
        # makes (11) autoregressive within the window too; the transformers still run once.
        before = slice(-self.future - 1, -1)
        recent = LastKeyframes(*(part[:, before] for part in last_keyframes(tokens)))
        slots = self(context)
        parts = torch.split(self.flat_logits(slots, recent, _frames(tokens)[:, before]), self.classes, dim=-1)
        most = max(self.classes)
        return torch.stack([F.pad(part, (0, most - part.shape[-1]), value=-torch.inf) for part in parts], dim=-2)


def _frames(tokens: Tensor) -> Tensor:
    """Return the number of every frame, (1, T, 1, 1)."""
    return torch.arange(tokens.shape[1], device=tokens.device)[None, :, None, None]
