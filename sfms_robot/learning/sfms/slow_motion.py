"""Slow motion of a head told from what it does, and the sway that a listener is given of it (`listeners.sfms.sway`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor

from sfms_robot.frames import FRAME_HZ, Doubles, Floats, ListenerEvent
from sfms_robot.listeners.sfms.sway import BANDS, BANDS_HZ

CUT_HZ: Final = 1.0
HEAD_KINDS: Final = ("nod", "shake", "tilt", "laugh")  # events that move the head
MARGIN_FRAMES: Final = 2  # around an event that may still be it
UNKNOWN: Final = 1e-6  # weight of a frame in which sway cannot be seen
LONGEST: Final = 2048  # frames of a spectrum


def slow_part(motion: Floats, events: Sequence[ListenerEvent]) -> Floats:
    """The slow part (N, S) of motion (N, S): below `CUT_HZ`, and smoothly across the events that move the head.

    Whittaker's smoother, the z with the least sum of w |x - z|^2 + mu |second difference of z|^2. While the head nods
    nobody sees its sway, so those frames weigh nothing: a low-pass alone would take the mean of a nod for sway, and
    give the nod a swing the other way before it begins.
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


def fit_sway(slow: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Amplitudes (BANDS, S) and spread () of sizes, of slow motion (N, S) of people.

    Each person is brought to the mean size before powers are taken: how much somebody sways is `spread`'s.
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
    return (powers.sum(0) / weight.sum()).sqrt().float(), spread.float()


def band_powers(track: Tensor) -> Tensor:
    """Mean square (BANDS, S) of a track (N, S) within each of `BANDS_HZ`; what is slower counts in the first."""
    from scipy import signal

    length = min(len(track), LONGEST)
    frequency_hz, density = signal.welch(track.numpy(), FRAME_HZ, nperseg=length, axis=0, detrend="constant")
    band = np.clip(np.searchsorted(BANDS_HZ, frequency_hz, side="right") - 1, 0, BANDS)
    powers = np.zeros((BANDS + 1, track.shape[1]))
    np.add.at(powers, band, density * (frequency_hz[1] - frequency_hz[0]))
    return torch.from_numpy(powers[:BANDS])
