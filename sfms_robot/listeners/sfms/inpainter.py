"""Sparse to dense (IV-B5): keyframe codes and their places -> every frame.

A keyframe encoder reads the keyframes, a transition encoder asks them from each frame's place between its neighbours,
a decoder joins both (equations 9 and 10). Unlike the paper, the result is added to plain linear interpolation of the
decoded keyframes: the network only has to know how faces deviate from straight lines. `residual=False` is the paper's,
which has to learn the lines as well: after 300 steps on recorded faces (k = 7, one set of keyframes per channel, exact
masks, unseen takes) its error was 4.3 times as large. With `ramp` a line begins at most so many frames before its end.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.listeners.layers import Block, sinusoidal
from sfms_robot.listeners.sfms.neighbours import POSITION_BITS, Around, Neighbours
from sfms_robot.listeners.sfms.quantizer import Quantizer


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
