"""Keyframe score network (IV-B2): how much each frame asks to be a keyframe, per channel group."""

from __future__ import annotations

from torch import Tensor, nn

from sfms_robot.listeners.layers import Block, sinusoidal


class ScoreNetwork(nn.Module):
    """1-D convolution, linear, sinusoidal positions, transformer encoder -> logits s of equation (4)."""

    def __init__(self, channels: int, groups: int, width: int, heads: int, layers: int = 2) -> None:
        super().__init__()
        self.width = width
        self.conv = nn.Conv1d(channels, width, kernel_size=5, padding=2)
        self.linear = nn.Linear(width, width)
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, groups)

    def forward(self, motion: Tensor) -> Tensor:
        """Standardised motion (B, T, C) -> logits (B, T, G)."""
        x = self.linear(self.conv(motion.transpose(1, 2)).transpose(1, 2))
        x = x + sinusoidal(x.shape[1], self.width).to(x)
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.out(self.norm(x))
        return out
