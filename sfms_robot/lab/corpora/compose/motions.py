"""Recorded curves joined to a motion: repeated, stretched, held and added frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypeVar

import numpy as np
from scipy import signal

from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, FRAME_S, SMILE_CORNERS, Floats, ListenerEvent

Rng = np.random.Generator
SHAPE: Final = {name: index for index, name in enumerate(BLENDSHAPES)}

FADE: Final = FRAME_HZ
SMILE: Final = [SHAPE[name] for name in SMILE_CORNERS]
_Item = TypeVar("_Item")


def slow(pose: Floats, cut_hz: float = 0.8) -> Floats:
    """Return the part of a head's motion below `cut_hz`, mean 0."""
    sos = signal.butter(2, cut_hz, fs=FRAME_HZ, output="sos")
    low = signal.sosfiltfilt(sos, pose - pose.mean(0), axis=0)
    return np.asarray(low - low.mean(0), np.float32)


def edges(length: int, ramp: int) -> Floats:
    """Return a window that is 1 in the middle and falls to 0 as a raised cosine at both ends."""
    ramp = min(ramp, length // 2)
    up = 0.5 - 0.5 * np.cos(np.pi * np.arange(ramp) / max(ramp, 1))
    return np.concatenate([up, np.ones(length - 2 * ramp), up[::-1]]).astype(np.float32)


def tiled(pieces: Sequence[Floats], frames: int, rng: Rng, fade: int = FADE) -> Floats:
    """Join random pieces (K, C), each crossfaded over `fade` frames; return (frames, C)."""
    usable = [piece for piece in pieces if len(piece) > 2 * fade] or [max(pieces, key=len)]
    fade = min(fade, min(len(piece) for piece in usable) // 2)
    total = frames + 2 * fade
    out = np.zeros((total, usable[0].shape[1]), np.float32)
    at = 0
    while at < total:
        piece = pick(usable, rng)
        piece = piece[rng.integers(0, max(1, (len(piece) - 2 * fade) // 2)) :]
        piece = piece * edges(len(piece), fade)[:, None]
        out[at : at + len(piece)] += piece[: total - at]
        at += len(piece) - fade
    return out[fade : fade + frames]


def stretched(curve: Floats, frames: int) -> Floats:
    """Return a curve (K, C) played over `frames` frames."""
    at = np.linspace(0, len(curve) - 1, max(2, frames))
    low = np.minimum(at.astype(int), len(curve) - 2)
    part = (at - low)[:, None]
    return np.asarray(curve[low] * (1 - part) + curve[low + 1] * part, np.float32)


def held(curve: Floats, frames: int) -> Floats:
    """Return a rise and fall (K, 52) that is seen (mouthSmile above half of its peak) for about `frames` frames.

    A longer one is held at its peak, as long smiles are; a shorter one is played faster, down to 0.6 of its length.
    """
    height = curve[:, SMILE].mean(axis=1)
    peak, seen = int(height.argmax()), int((height > 0.5 * height.max()).sum())
    if frames >= seen:
        return np.concatenate(
            [curve[:peak], np.repeat(curve[peak : peak + 1], frames - seen + 1, axis=0), curve[peak + 1 :]]
        )
    return stretched(curve, int(len(curve) * max(0.6, frames / seen)))


def first_frame(start_s: float) -> int:
    """Return the frame that begins at or nearest to a time."""
    return round(start_s * FRAME_HZ)


def placed(curve: Floats, start_s: float, frames: int) -> Floats:
    """Return zeros (frames,) or (frames, C) with the curve from `start_s` on."""
    out = np.zeros((frames, *curve.shape[1:]), np.float32)
    first = first_frame(start_s)
    low, high = max(0, first), min(frames, first + len(curve))
    if high > low:
        out[low:high] = curve[low - first : high - first]
    return out


def laid_event(kind: str, start_s: float, curve: Floats, size: float) -> ListenerEvent:
    """Return the event of a curve that was laid with `placed`."""
    return ListenerEvent(kind, first_frame(start_s) * FRAME_S, len(curve) * FRAME_S, float(size))


def pick(items: Sequence[_Item], rng: Rng) -> _Item:
    """Draw one item, all with the same probability."""
    return items[int(rng.integers(len(items)))]


def over(below: Floats, above: Floats) -> Floats:
    """Combine two activations of the same muscles: about their sum while small, saturating smoothly at 1."""
    return below + above - np.clip(below, 0, 1) * np.clip(above, 0, 1)
