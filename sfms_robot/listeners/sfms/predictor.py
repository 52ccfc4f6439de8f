"""Listening head prediction (IV-C): 40 frames of both people -> classes of the next 8 frames, per channel group.

Class 0 is transition, class 1 + i the keyframe code i. Speaker face and voice are fused by the gated dual encoder of
equation (12), the listener's own past tokens have an encoder of their own, and a decoder asks both from every
future frame at once. Beyond the paper, a future frame that is already decided may be given to the decoder: with none
given it is the paper's parallel prediction, given one by one the frames can agree with one another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.listeners.layers import Attention, Block, FeedForward, Keys, sinusoidal
from sfms_robot.listeners.sfms.quantizer import as_levels, indices_to_codes
from sfms_robot.signals.mel import ROWS_PER_FRAME

AGE_SCALE_FRAMES = 16.0
SILENCE_FRAMES = (0, 4, 9, 19, 38)  # upper ends of the bins of silence so far: 0, 0.16, 0.36, 0.76, 1.5 s
LEAST_SPREAD = 0.8  # of the standardised level: below that a window is all speech or all silence
UNDECIDED = -1  # a future token nobody has drawn yet


@dataclass(frozen=True)
class Context:
    """What the decoder may look at.

    Attributes:
        face: (B, P, C) speaker's standardised motion; anything where not `face_known`.
        face_known: (B, P) bool.
        mel: (B, 4P, 128) standardised log-mel; anything where not `heard`.
        heard: (B, P) bool.
        tokens: (B, P, G) the listener's own past.
    """

    face: Tensor
    face_known: Tensor
    mel: Tensor
    heard: Tensor
    tokens: Tensor


@dataclass(frozen=True)
class Memory:
    """A context as the decoder uses it: each layer's keys, and where the speaker is in a phrase (B, 1, D)."""

    keys: list[Keys]
    phase: Tensor


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
    """Face and voice of the speaker -> (B, P, D)."""

    def __init__(self, channels: int, mel_bins: int, width: int, heads: int, layers: int) -> None:
        super().__init__()
        self.face_in = nn.Linear(channels, width)
        self.voice_in = nn.Conv1d(mel_bins, width, kernel_size=5, padding=2)
        self.loudness_in = nn.Linear(2, width)
        self.no_face = nn.Parameter(torch.zeros(width))
        self.no_voice = nn.Parameter(torch.zeros(width))
        self.face = nn.ModuleList(GatedCross(width, heads) for _ in range(layers))
        self.voice = nn.ModuleList(GatedCross(width, heads) for _ in range(layers))

    def forward(self, context: Context) -> Tensor:
        b, p, _ = context.face.shape
        x = torch.where(context.face_known[..., None], self.face_in(context.face), self.no_face)
        voice = F.gelu(self.voice_in(context.mel.transpose(1, 2)))
        y = F.max_pool1d(voice, ROWS_PER_FRAME).transpose(1, 2)  # four mel rows -> one frame
        y = y + self.loudness_in(_loudness(context.mel, context.heard))
        y = torch.where(context.heard[..., None], y, self.no_voice)
        places = sinusoidal(p, x.shape[-1]).to(x)
        x, y = x + places, y + places
        for face, voice_layer in zip(self.face, self.voice, strict=True):
            x, y = face(x, y), voice_layer(y, x)
        return torch.cat([x, y], dim=1)


def _loudness(mel: Tensor, heard: Tensor) -> Tensor:
    """Level of each frame below the loudest and above the quietest of the window (B, P, 2).

    Whatever the gain of the microphone, it tells speech from pause: an addition to the paper, whose Wav2Vec tokens
    know that by themselves.
    """
    b, p = heard.shape
    level = mel.view(b, p, -1).mean(-1)
    loudest = level.masked_fill(~heard, -torch.inf).amax(1, keepdim=True)
    quietest = level.masked_fill(~heard, torch.inf).amin(1, keepdim=True)
    both = torch.stack([level - loudest, level - quietest], dim=-1)
    return torch.where(heard[..., None], both, 0.0)


def _speech_phase(mel: Tensor, heard: Tensor) -> Tensor:
    """How long the speaker has been silent and how much of the window is speech, in bins (B, 2 * bins).

    Nods gather just behind phrase ends, but there are few of them to learn it from: so the decoder is told directly.
    """
    b, p = heard.shape
    level = mel.view(b, p, -1).mean(-1)
    low, high = level.amin(1, keepdim=True), level.amax(1, keepdim=True)
    varied = high - low > LEAST_SPREAD
    active = torch.where(varied, level > low + 0.4 * (high - low), level > 0) & heard
    frame = torch.arange(p, device=mel.device)
    silent = p - 1 - torch.where(active, frame, -1).amax(1)  # frames since speech
    bins = torch.tensor(SILENCE_FRAMES, device=mel.device)
    silence = F.one_hot(torch.bucketize(silent, bins), len(SILENCE_FRAMES) + 1).float()
    return torch.cat([silence, silence * active.float().mean(1, keepdim=True)], dim=-1)


class Predictor(nn.Module):
    """Equation (11), with the future frames that are not given predicted in parallel."""

    levels: Tensor

    def __init__(
        self,
        levels: Sequence[Sequence[int]],
        channels: int,
        mel_bins: int,
        future: int,
        width: int,
        heads: int,
        layers: int,
    ) -> None:
        super().__init__()
        self.register_buffer("levels", as_levels(levels), persistent=False)
        groups, dims = len(levels), len(levels[0])
        self.classes = [int(torch.tensor(row).prod()) + 1 for row in levels]
        self.speaker = SpeakerEncoder(channels, mel_bins, width, heads, 1)
        self.token_in = nn.Linear(groups * (2 * dims + 2), width)
        self.listener = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.future_token_in = nn.Linear(groups * (2 * dims + 2), width)
        self.undecided = nn.Parameter(torch.randn(width) * 0.02)
        self.slots = nn.Parameter(torch.randn(future, width) * 0.02)
        self.role = nn.Parameter(torch.randn(3, width) * 0.02)
        self.decoder = nn.ModuleList(Block(width, heads, cross=True) for _ in range(layers))
        self.phase_in = nn.Linear(2 * (len(SILENCE_FRAMES) + 1), width)
        self.norm = nn.LayerNorm(width)
        self.classify = nn.ModuleList(nn.Linear(width, n) for n in self.classes)

    def remember(self, context: Context) -> Memory:
        """What `decode` needs of speaker's face, speaker's voice and listener's past (3P frames)."""
        heard = context.heard.repeat_interleave(ROWS_PER_FRAME, dim=1)[..., None]
        context = replace(context, mel=torch.where(heard, context.mel, 0.0))
        speaker = self.speaker(context)
        p = context.tokens.shape[1]
        x = self.token_in(self._describe(context.tokens)[0])
        x = x + sinusoidal(p, x.shape[-1]).to(x)
        for block in self.listener:
            x = block(x)
        role = self.role.repeat_interleave(p, dim=0)
        memory = torch.cat([speaker, x], dim=1) + role  # (B, 3P, D)
        keys = [block.memory_keys(memory) for block in self.decoder if isinstance(block, Block)]
        return Memory(keys, self.phase_in(_speech_phase(context.mel, context.heard))[:, None])

    def decode(self, memory: Memory, past: Tensor, future: Tensor) -> list[Tensor]:
        """past (B, P, G) and future (B, H, G), UNDECIDED where not drawn yet -> per group logits (B, H, V_g + 1)."""
        features, decided = self._describe(torch.cat([past, future], dim=1))
        h = future.shape[1]
        x = torch.where(decided[:, -h:, None], self.future_token_in(features[:, -h:]), self.undecided)
        # The state at the seam, for every slot: where each group was last and how long ago.
        x = x + self.future_token_in(features[:, -h - 1 : -h]) + self.slots
        for block, keys in zip(self.decoder, memory.keys, strict=True):
            x = block(x, memory=keys)
        x = self.norm(x + memory.phase)
        return [head(x) for head in self.classify]

    def _describe(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Tokens (B, T, G) -> features (B, T, G * (2D + 2)) and decided (B, T).

        Per group: is this a keyframe, its code, the code last seen, the frames since then.
        """
        b, t, g = tokens.shape
        key = tokens > 0
        codes = indices_to_codes((tokens - 1).clamp(min=0), self.levels) * key[..., None]
        frame = torch.arange(t, device=tokens.device)[None, :, None].expand(b, t, g)
        last = torch.where(key, frame, -1).cummax(1).values
        held = codes.gather(1, last.clamp(min=0)[..., None].expand(-1, -1, -1, codes.shape[-1]))
        age = torch.log1p((frame - last) / AGE_SCALE_FRAMES * 4)
        features = torch.cat([key[..., None].float(), codes, held, age[..., None]], dim=-1)
        return features.flatten(2), (tokens >= 0).all(-1)
