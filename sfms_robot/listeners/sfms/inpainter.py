"""Sparse to dense (IV-B5): keyframe codes and their places -> every frame.

A keyframe encoder reads the keyframes, a transition encoder asks them from each frame's place between its neighbours,
a decoder joins both (equations 9 and 10). Unlike the paper, the result is added to plain linear interpolation of the
decoded keyframes: the network only has to know how faces deviate from straight lines.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sfms_robot.listeners.layers import Block, sinusoidal
from sfms_robot.listeners.sfms.quantizer import Quantizer

POSITION_BITS = 6  # distances to the neighbouring keyframes up to 63 frames, as binary digits


class Neighbours:
    """For every frame and group the keyframe before (or at) it and the one after, from a mask (B, T, G)."""

    def __init__(self, mask: Tensor) -> None:
        t = mask.shape[1]
        frame = torch.arange(t, device=mask.device)[None, :, None].expand(mask.shape)
        key = mask > 0.5
        before = torch.where(key, frame, -1).cummax(1).values
        after = torch.where(key, frame, t).flip(1).cummin(1).values.flip(1)
        self.has_before, self.has_after = before >= 0, after < t
        # Ahead of the first and behind the last keyframe the nearest one is held.
        self.before = torch.where(self.has_before, before, after).clamp(0, t - 1)
        self.after = torch.where(self.has_after, after, before).clamp(0, t - 1)
        self.since = (frame - self.before).clamp(min=0)
        self.until = (self.after - frame).clamp(min=0)
        span = (self.after - self.before).clamp(min=1)
        self.weight = ((frame - self.before) / span).clamp(0.0, 1.0)  # 0 at the keyframe before, 1 at the one after

    def interpolate(self, values: Tensor) -> Tensor:
        """(B, T, G, D) at keyframes -> (B, T, G, D) on the straight lines between them."""
        index = [i[..., None].expand(-1, -1, -1, values.shape[-1]) for i in (self.before, self.after)]
        first, second = (values.gather(1, i) for i in index)
        return first + (second - first) * self.weight[..., None]

    def positions(self) -> Tensor:
        """Binary sliding positions (B, T, G, 2 * bits + 3): T^tf of equation (10)."""
        powers = 2 ** torch.arange(POSITION_BITS, device=self.since.device)
        bits = [(d[..., None] // powers % 2).float() for d in (self.since, self.until)]
        ends = torch.stack([self.has_before.float(), self.has_after.float(), self.weight], dim=-1)
        return torch.cat([*bits, ends], dim=-1)


class Inpainter(nn.Module):
    """phi of equation (9)."""

    def __init__(self, quantizer: Quantizer, width: int, heads: int) -> None:
        super().__init__()
        groups, channels = quantizer.member.shape
        dims = quantizer.levels.shape[1]
        self.width = width
        self.keyframe_in = nn.Linear(groups * (dims + 1), width)
        self.keyframe_encoder = Block(width, heads)
        self.transition_in = nn.Linear(groups * (dims + 2 * POSITION_BITS + 3), width)
        self.transition_encoder = Block(width, heads, cross=True)
        self.join = nn.Linear(2 * width, width)
        self.decoder = Block(width, heads)
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, channels)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, codes: Tensor, mask: Tensor, quantizer: Quantizer) -> Tensor:
        """codes (B, T, G, D), read where mask (B, T, G) is 1 -> motion (B, T, C), standardised."""
        neighbours = Neighbours(mask)
        places = sinusoidal(mask.shape[1], self.width).to(codes)
        # Multiplying by the mask is where learned placement gets its gradient: forward it changes nothing.
        keyed = codes * mask[..., None]
        z_kf = self.keyframe_in(torch.cat([keyed, mask[..., None]], dim=-1).flatten(2)) + places
        seen = (mask > 0.5).any(-1)
        seen = seen | ~seen.any(-1, keepdim=True)  # a window without any keyframe looks at its blanks
        z_kf = self.keyframe_encoder(z_kf, seen=seen)
        between = neighbours.interpolate(keyed)
        query = torch.cat([between, neighbours.positions()], dim=-1).flatten(2)  # concatenated, not added (IV-B5)
        z_tf = self.transition_encoder(self.transition_in(query) + places, memory=z_kf, memory_seen=seen)
        joined = self.decoder(self.join(torch.cat([z_kf * mask.amax(-1, keepdim=True), z_tf], dim=-1)))
        straight = self._straight(keyed, neighbours, quantizer)
        out: Tensor = straight + self.out(self.norm(joined))
        return out

    def _straight(self, codes: Tensor, neighbours: Neighbours, quantizer: Quantizer) -> Tensor:
        per_group = quantizer.decoder(codes)  # (B, T, G, C)
        return (neighbours.interpolate(per_group) * quantizer.member).sum(-2)
