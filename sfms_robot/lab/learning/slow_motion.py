"""Slow motion of a head told from what it does, and the sway that a listener is given of it (`listeners.idle`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor

from sfms_robot.frames import FRAME_HZ, Doubles, Floats, ListenerEvent
from sfms_robot.listeners.idle import BANDS, BANDS_HZ, head_channels
from sfms_robot.listeners.space import MotionSpace

CUT_HZ: Final = 1.0
HEAD_KINDS: Final = ("nod", "shake", "tilt")  # events that move the head
MARGIN_FRAMES: Final = 2  # around an event that may still be it
UNKNOWN: Final = 1e-4  # weight of a frame in which sway cannot be seen: below 0.1 Hz it still counts
LONGEST: Final = 2048  # frames of a spectrum
ROUNDS: Final = 8  # to choose between people and mirror images, at most


def slow_part(motion: Floats, events: Sequence[ListenerEvent]) -> Floats:
    """Return the slow part (N, S) of motion (N, S): below `CUT_HZ`, and smooth across the events that move the head.

    Whittaker's smoother, the z with the least sum of w |x - z|^2 + mu |second difference of z|^2. Frames of a nod weigh
    nothing: sway cannot be seen in them, a low-pass alone would take the mean of a nod for sway, and give the nod a
    swing in the opposite direction before it begins.
    """
    from scipy.linalg import solveh_banded

    n = len(motion)
    if n < 3:
        return motion.copy()
    weight = np.ones(n)
    for event in events:
        if event.kind in HEAD_KINDS:
            first = int(np.floor(event.start_s * FRAME_HZ)) - MARGIN_FRAMES
            last = int(np.ceil(event.end_s * FRAME_HZ)) + MARGIN_FRAMES
            weight[max(0, first) : max(0, last)] = UNKNOWN
    mu = (2 * np.sin(np.pi * CUT_HZ / FRAME_HZ)) ** -4.0  # half of it passes at the cut
    bands = np.zeros((3, n))
    difference = (1.0, -2.0, 1.0)
    for a, left in enumerate(difference):
        for b, right in enumerate(difference[a:]):
            bands[b, a : n - 2 + a] += mu * left * right
    bands[0] += weight
    slow: Doubles = solveh_banded(bands, weight[:, None] * motion.astype(np.float64), lower=True)
    return slow.astype(np.float32)


def without_sway(
    motion: Tensor, space: MotionSpace, channels: Sequence[str], events: Sequence[ListenerEvent]
) -> tuple[Tensor, Tensor]:
    """Motion (N, C) of a space less the sway of its head, and that sway (N, S), by how far it is off neutral."""
    head = head_channels(channels)
    slow = torch.from_numpy(slow_part(motion[:, head].numpy(), events))
    sway = slow - torch.tensor(space.neutral, dtype=torch.float32)[head]
    fast = motion.clone()
    fast[:, head] -= sway
    return fast, sway


def fit_sway(slow: Sequence[Tensor], lateral: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
    """Return mixtures (BANDS, S, S) of `draw_sway` and spread () of sizes, of slow motion (N, S) of people.

    Each person is scaled to the mean size before powers are taken; `spread` holds the sizes. Of a person and the mirror
    image, with `lateral` channels inverted, the one nearer to the other people counts.
    """
    tracks = [one.double() - one.double().mean(0) for one in slow if len(one) >= 2 * FRAME_HZ]
    if not tracks:
        raise ValueError("no motion of 2 s or more to fit sway on")
    sizes = torch.stack([track.square().mean(0).sqrt().clamp(min=1e-9).log() for track in tracks])  # (K, S)
    common = (sizes - sizes.mean(0)).mean(1)  # of the whole head
    weight = torch.tensor([float(len(track)) for track in tracks], dtype=torch.float64)
    spread = common.std(correction=0) if len(tracks) > 1 else torch.zeros((), dtype=torch.float64)
    powers = torch.stack(
        [band_powers(track / one.exp()) * weight_ for track, one, weight_ in zip(tracks, common, weight, strict=True)]
    )
    powers = _one_side(powers, lateral).sum(0) / weight.sum()
    value, vector = torch.linalg.eigh(powers)
    root = vector * value.clamp(min=0).sqrt()[:, None] @ vector.mT  # symmetric
    return root.float(), spread.float()


def _one_side(powers: Tensor, lateral: Sequence[int]) -> Tensor:
    """Powers (K, BANDS, S, S) of people or of their mirror images, whichever are more alike."""
    turned = torch.ones(powers.shape[-1], dtype=powers.dtype)
    turned[list(lateral)] = -1
    mirror = turned[:, None] * turned
    size = powers.sum((0, 1)).diagonal().clamp(min=1e-30).sqrt()
    alike = powers.sum(1) / size / size[:, None]  # (K, S, S), every channel as much as any other
    mirrored = torch.zeros(len(powers), 1, 1, dtype=torch.bool)
    for _ in range(ROUNDS):
        mean = torch.where(mirrored, alike * mirror, alike).sum(0)
        likeness = (alike * mean * (1 - mirror)).sum((1, 2))  # of what a mirror changes, as each stands
        before, mirrored = mirrored, (likeness < 0)[:, None, None]
        if torch.equal(before, mirrored):
            break
    return torch.where(mirrored[:, None], powers * mirror, powers)


def band_powers(track: Tensor) -> Tensor:
    """Co-spectrum (BANDS, S, S) of a track (N, S): what its channels do together within each of `BANDS_HZ`; what is
    slower counts in the first.
    """
    from scipy import signal

    length = min(len(track), LONGEST)
    values = track.numpy()
    how = {"fs": FRAME_HZ, "nperseg": length, "detrend": "constant"}
    frequency_hz, density = signal.csd(values.T[:, None], values.T[None], **how)
    band = np.clip(np.searchsorted(BANDS_HZ, frequency_hz, side="right") - 1, 0, BANDS)
    powers = np.zeros((BANDS + 1, *density.shape[:2]))
    np.add.at(powers, band, np.moveaxis(density.real, -1, 0) * (frequency_hz[1] - frequency_hz[0]))
    return torch.from_numpy(powers[:BANDS])
