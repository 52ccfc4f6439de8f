"""One code for every eight frames: the VQ-VAE of Learning2Listen, table IV's L2L row.

Ng et al. 2022, "Learning to Listen", as its published configuration describes it (evonneng/learning2listen @ a0825d58):
three stages halve the time, one by a strided convolution and two by pooling, transformers stand on both sides of the
codes. Its authors learn 200 vectors, the SFMS paper compares with 256.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.config.training import HALVINGS
from sfms_robot.lab.evaluation.baselines.dense import DenseTokenizer

KERNEL = 5
GROUP = 1 << HALVINGS  # frames
SLOPE = 0.2  # of the leaky rectifiers between convolutions


class GroupedTokenizer(DenseTokenizer):
    """Motion (B, T, C), standardised <-> indices (B, T / 8, 1); T a multiple of 8."""

    def __init__(self, settings: config.Grouped, channels: int) -> None:
        super().__init__(settings, channels)
        width = settings.width
        strides = (2, 1, 1)
        self.shorten = nn.ModuleList(nn.Conv1d(width, width, KERNEL, stride, KERNEL // 2) for stride in strides)
        self.lengthen = nn.ModuleList(nn.Conv1d(width, width, KERNEL, padding=KERNEL // 2) for _ in strides)

    @property
    def bits_per_window(self) -> float:
        """Codes of a whole window."""
        return super().bits_per_window / GROUP

    def latent(self, motion: Tensor) -> Tensor:
        """(B, T, C) -> (B, T / 8, 1, D), not yet codes."""
        x = self.read(motion).transpose(1, 2)
        frames = x.shape[-1]
        for stage in self.shorten:
            frames //= 2
            x = F.leaky_relu(stage(x), SLOPE)
            x = x if x.shape[-1] == frames else F.max_pool1d(x, 2)
        return self.bottleneck.latent(self.encoder(x.transpose(1, 2)))

    def synthesise(self, codes: Tensor) -> Tensor:
        """(B, T / 8, 1, D) -> (B, T, C)."""
        x = self.bottleneck.restore(codes).transpose(1, 2)
        for stage in self.lengthen:
            x = F.leaky_relu(stage(x.repeat_interleave(2, dim=-1)), SLOPE)
        out: Tensor = self.write(self.decoder(x.transpose(1, 2)))
        return out
