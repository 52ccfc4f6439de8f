"""Keyframes around each frame: where they are, and the straight lines between them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

POSITION_BITS = 6  # distances to the neighbouring keyframes up to 63 frames, as binary digits


@dataclass(frozen=True)
class Neighbours:
    """For every frame and group the keyframe before (or at) it and the one after.

    Ahead of the first and behind the last keyframe the nearest one is held.

    Attributes:
        before, after: (B, T, G) frames of the two.
        has_before, has_after: (B, T, G) bool.
    """

    before: Tensor
    after: Tensor
    has_before: Tensor
    has_after: Tensor

    @classmethod
    def in_mask(cls, mask: Tensor) -> Neighbours:
        """From a mask (B, T, G)."""
        t = mask.shape[1]
        frame = _frames(mask)
        key = mask > 0.5
        before = torch.where(key, frame, -1).cummax(1).values
        after = torch.where(key, frame, t).flip(1).cummin(1).values.flip(1)
        has_before, has_after = before >= 0, after < t
        return cls(
            torch.where(has_before, before, after).clamp(0, t - 1),
            torch.where(has_after, after, before).clamp(0, t - 1),
            has_before,
            has_after,
        )

    def of(self, group: Tensor) -> Neighbours:
        """The neighbours of `group` (C,), one group per channel: (B, T, C)."""
        return Neighbours(
            self.before[..., group], self.after[..., group], self.has_before[..., group], self.has_after[..., group]
        )

    @property
    def since(self) -> Tensor:
        """(B, T, G) frames since the keyframe before."""
        return (_frames(self.before) - self.before).clamp(min=0)

    @property
    def until(self) -> Tensor:
        """(B, T, G) frames until the keyframe after."""
        return (self.after - _frames(self.after)).clamp(min=0)

    @property
    def weight(self) -> Tensor:
        """(B, T, G): 0 at the keyframe before, 1 at the one after."""
        span = (self.after - self.before).clamp(min=1)
        return ((_frames(self.before) - self.before) / span).clamp(0.0, 1.0)

    def interpolate(self, values: Tensor) -> Tensor:
        """(B, T, G, D) at keyframes -> (B, T, G, D) on the straight lines between them."""
        index = [i[..., None].expand(-1, -1, -1, values.shape[-1]) for i in (self.before, self.after)]
        first, second = (values.gather(1, i) for i in index)
        return first + (second - first) * self.weight[..., None]

    def positions(self) -> Tensor:
        """Binary sliding positions (B, T, G, 2 * bits + 3): T^tf of equation (10)."""
        powers = 2 ** torch.arange(POSITION_BITS, device=self.before.device)
        bits = [(d[..., None] // powers % 2).float() for d in (self.since, self.until)]
        ends = torch.stack([self.has_before.float(), self.has_after.float(), self.weight], dim=-1)
        return torch.cat([*bits, ends], dim=-1)


def _frames(like: Tensor) -> Tensor:
    return torch.arange(like.shape[1], device=like.device)[None, :, None].expand(like.shape)
