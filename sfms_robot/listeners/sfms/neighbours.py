"""Keyframes around each frame: where they are, and the straight lines between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

POSITION_BITS = 6  # distances to the neighbouring keyframes up to 63 frames, as binary digits


class Around(NamedTuple):
    """What `keyframes.around` finds in tokens (B, T, G) before a network sees them; the same here as tensors.

    Attributes:
        before, after: (B, T, G) as `Neighbours.at` wants them.
        rows: (B, K) frames that hold a keyframe of any group, as rows of (B * T).
        seen: (B, K) which of those count.
        places: (B, T) where each frame is among them, as a row of (B * K); anything for frames that are not.
    """

    before: Tensor
    after: Tensor
    rows: Tensor
    seen: Tensor
    places: Tensor


@dataclass(frozen=True)
class Neighbours:
    """For every frame and group the keyframe before (or at) it and the one after.

    Before the first and behind the last keyframe the nearest one is held.

    Attributes:
        frame: (T, 1) number of each frame.
        before, after: (B, T, G) frames of the two.
        has_before, has_after: (B, T, G) bool.
        ramp: the way to the keyframe after takes so many frames at most, before it the one before is held; None: all.
    """

    frame: Tensor
    before: Tensor
    after: Tensor
    has_before: Tensor
    has_after: Tensor
    ramp: int | None = None

    @classmethod
    def in_mask(cls, mask: Tensor, ramp: int | None = None) -> Neighbours:
        """From a mask (B, T, G)."""
        t = mask.shape[1]
        frame = torch.arange(t, device=mask.device)[:, None]
        key = mask > 0.5
        before = torch.where(key, frame, -1).cummax(1).values
        after = t - 1 - torch.where(key, t - 1 - frame, -1).flip(1).cummax(1).values.flip(1)
        return cls.at(before, after, ramp)

    @classmethod
    def at(cls, before: Tensor, after: Tensor, ramp: int | None = None) -> Neighbours:
        """From the keyframes (B, T, G) at or before each frame, -1 for none, and at or after it, T for none."""
        t = before.shape[1]
        frame = torch.arange(t, device=before.device)[:, None]
        has_before, has_after = before >= 0, after < t
        return cls(
            frame,
            torch.where(has_before, before, after).clamp(0, t - 1),
            torch.where(has_after, after, before).clamp(0, t - 1),
            has_before,
            has_after,
            ramp,
        )

    def last(self, frames: int) -> Neighbours:
        """Of so many frames at the end alone."""
        before, after, has_before, has_after = (
            part[:, -frames:] for part in (self.before, self.after, self.has_before, self.has_after)
        )
        return Neighbours(self.frame[-frames:], before, after, has_before, has_after, self.ramp)

    @property
    def since(self) -> Tensor:
        """(B, T, G) frames since the keyframe before."""
        return (self.frame - self.before).clamp(min=0)

    @property
    def until(self) -> Tensor:
        """(B, T, G) frames until the keyframe after."""
        return (self.after - self.frame).clamp(min=0)

    @cached_property
    def weight(self) -> Tensor:
        """(B, T, G): 0 at the keyframe before, 1 at the one after."""
        begin = self.before if self.ramp is None else torch.maximum(self.before, self.after - self.ramp)
        span = (self.after - begin).clamp(min=1)
        return ((self.frame - begin) / span).clamp(0.0, 1.0)

    def interpolate(self, values: Tensor) -> Tensor:
        """(B, S, G, D) at keyframes -> (B, T, G, D) on the straight lines between them, T the frames in here."""
        index = [i[..., None].expand(-1, -1, -1, values.shape[-1]) for i in (self.before, self.after)]
        first, second = (values.gather(1, i) for i in index)
        return first + (second - first) * self.weight[..., None]

    def positions(self) -> Tensor:
        """Binary sliding positions (B, T, G, 2 * bits + 3): T^tf of equation (10)."""
        powers = 2 ** torch.arange(POSITION_BITS, device=self.before.device)
        bits = (torch.stack([self.since, self.until], dim=-1)[..., None] & powers) > 0
        ends = torch.stack([self.has_before.to(self.weight), self.has_after.to(self.weight), self.weight], dim=-1)
        return torch.cat([bits.flatten(-2).to(ends), ends], dim=-1)
