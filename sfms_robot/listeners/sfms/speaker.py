"""The speaker's face and voice, fused by the gated dual encoder of equation (12).

`listen` turns the sound of every frame into one vector, looking back one frame and never ahead: done once per frame, it
serves all plans that look back on it. The encoder then reads the last 40 of them together with the face.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.listeners.layers import Attention, FeedForward, sinusoidal

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
