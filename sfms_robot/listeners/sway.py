"""Slow sway of the head, as a process of its own beside what a listener draws. Beyond both papers, which draw all.

A head at rest moves by about a degree, most of it below half a hertz, and there is nothing to predict in it: sway
answers to nobody. As tokens it steps, since the codes of a whole head are as far apart as its sway is wide. Drawn frame
by frame on its own past it grows, or drags what was drawn of a nod along for seconds. So it is made of what recorded
heads do (Shinozuka's spectral representation of a stationary process),

    x(t) = size * sum over lines l of  2^1/2 M[l] (a_l cos 2 pi f_l t + b_l sin 2 pi f_l t),   a_l, b_l in R^S

of which every line is one cosine a channel.

`LINES` frequencies drawn from each of the `BANDS_HZ`, `M M^T` of each band what heads do together there: who leans
forward also comes down. Over the lines of a band sum a a^T + b b^T = 1: which way a head goes is by lot, how far it
goes in all is not. Only `size` says that, a stream's own manner, and within what people's is. Every other stream is
somebody seen in a mirror: people lean to either side alike.

Heads do not sway evenly, they stand for a second or two and shift then. So t is the time of a clock that goes faster
and slower, by `UNEVEN` of its pace, once in some `CLOCK_S`; turns of the head have one, shifts of it another. Where the
head is how often stays the same; how far it goes in two seconds differs from one to the next as much as it does of
people. A function of time alone: any frame of the future is known, nothing adds up, and after an hour it is where it
was. It sets in over the first `EASE_S`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.frames import FRAME_S, LATERAL_POSE, POSE_CHANNELS, Doubles, Floats
from sfms_robot.listeners.stream_rng import Use, normals, uniforms

BANDS_HZ = (0.01, 0.03, 0.06, 0.1, 0.16, 0.24, 0.34, 0.46, 0.62, 0.85, 1.15, 1.6)  # edges
BANDS = len(BANDS_HZ) - 1
LINES = 6  # of each band; twice as many are no fewer than channels of a head
WIDEST = 2.0  # deviations by which a manner is off the mean one, at most
UNEVEN = 0.85
CLOCK_S = (4.0, 8.0)  # least and most


class HeadSway:
    """The sway of one listener's streams; nothing at all for one with `sway: false`.

    Its tensors, fitted by `learning.slow_motion`: `sway_mixture` (BANDS, S, S) and `sway_spread` () of `draw_sway`, in
    units of its motion space, of the S channels that move the head.
    """

    def __init__(self, settings: config.Listener, tensors: Mapping[str, Floats]) -> None:
        self._head = head_channels(settings.channels) if settings.sway else []
        self._lateral = lateral_channels(settings.channels)
        self._shifting = shifting_channels(settings.channels)
        self._tensors = tensors

    def start(self, seed: int) -> Doubles:
        """A stream's own, as `sway_at` takes it; empty without."""
        if not self._head:
            return np.zeros((3, 0, 0))
        mixture, spread = self._tensors["sway_mixture"], float(self._tensors["sway_spread"])
        return draw_sway(mixture, spread, seed, self._lateral, self._shifting)

    def added(self, motion: Floats, sway: Doubles, first: int | NDArray[np.int64]) -> Floats:
        """Motion (..., N, C) of frames `first`, `first` + 1, ... with the sway of each stream, in place.

        `sway`: (..., 3, 1 + L, S). `first` is of all streams, or (...) of each.
        """
        if self._head:
            frames = np.asarray(first)[..., None] + 1.0 + np.arange(motion.shape[-2])
            motion[..., self._head] += sway_at(sway, FRAME_S * frames)
        return motion


def draw_sway(
    mixture: Floats, spread: float, seed: int, lateral: Sequence[int] = (), shifting: Sequence[int] = ()
) -> Doubles:
    """What one stream's sway is made of.

    Args:
        mixture: (BANDS, S, S) M of each band: what (a, b) of a line become in each channel.
        spread: deviation of the logarithm of sizes between people.
        seed: of the stream.
        lateral: channels that a mirror turns around.
        shifting: channels that go by the second clock.

    Returns:
        (3, 1 + BANDS * LINES, S) frequencies [rad/s], sizes in units of the motion, and phases [rad]; first those of
        each channel's clock, whose sizes are seconds.
    """
    bands, channels, _ = mixture.shape
    edges = np.array(BANDS_HZ)
    uniform = uniforms(seed, 0, Use.SWAY, 1 + bands * LINES + 4)
    frequency_hz = edges[:-1, None] + uniform[1:-4].reshape(bands, LINES) * np.diff(edges)[:, None]
    drawn = normals(seed, 1, Use.SWAY, 1 + 2 * bands * LINES * channels).astype(np.float64)
    lots, _ = np.linalg.qr(drawn[1:].reshape(bands, 2 * LINES, channels))  # of each band: orthonormal columns
    factors = np.einsum("bsc,bplc->pbls", mixture.astype(np.float64), lots.reshape(bands, 2, LINES, channels))
    factors *= math.sqrt(2) * math.exp(spread * min(max(drawn[0], -WIDEST), WIDEST))
    if uniform[0] < 0.5:
        factors[..., list(lateral)] *= -1
    size, phase = as_cosines(*factors)
    turns = np.broadcast_to(2 * math.pi * frequency_hz[..., None], size.shape)
    lines = np.stack([turns, size, phase]).reshape(3, bands * LINES, channels)
    return np.concatenate([_clocks(uniform[-4:], channels, shifting)[:, None], lines], axis=1)


def _clocks(uniform: Doubles, channels: int, shifting: Sequence[int]) -> Doubles:
    """(3, S) of each channel's clock, of two that are drawn: `uniform` (4,) are their lengths and phases."""
    second = np.zeros(channels, np.intp)
    second[list(shifting)] = 1
    turn = 2 * math.pi / (CLOCK_S[0] + (CLOCK_S[1] - CLOCK_S[0]) * uniform[:2])
    return np.stack([turn, UNEVEN / turn, 2 * math.pi * uniform[2:]])[:, second]


def sway_at(sway: Doubles, times_s: NDArray[np.floating]) -> Floats:
    """Sway (..., 3, 1 + L, S) at times (T,) since the stream began, or (..., T) of each -> (..., T, S) in units of the
    motion; 0 before that.
    """
    lines, clocks = sway[..., 1:, :], sway[..., :1, :]
    own_s = times_s[..., None] + sum_of_lines(times_s[..., None], *_parts(clocks))  # (..., T, S)
    return np.asarray(sum_of_lines(own_s, *_parts(lines)) * set_in(times_s)[..., None], np.float32)


def _parts(lines: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Frequencies, sizes, phases of lines (..., 3, L, S)."""
    return lines[..., 0, :, :], lines[..., 1, :, :], lines[..., 2, :, :]


# --- Spectral lines ---------------------------------------------------------------------------------------------------
#
# A line a cos 2 pi f t + b sin 2 pi f t is one cosine, |(a, b)| cos(2 pi f t - atan2(b, a)), and is kept as such.
# Idle motion (`idle_motion`) is a sum of lines too.

EASE_S: Final = 3.0


def as_cosines(a: Doubles, b: Doubles) -> tuple[Doubles, Doubles]:
    """Size and phase [rad] of lines with the factors a of the cosine and b of the sine."""
    return np.hypot(a, b), np.arctan2(b, a)


def sum_of_lines(times_s: NDArray[np.floating], frequency: Doubles, size: Doubles, phase: Doubles) -> Doubles:
    """Lines (..., L, K), frequency [rad/s], at times (T, 1) of all, (..., T, 1) of each, or (..., T, K), where every
    column goes by a clock of its own -> (..., T, K).
    """
    turn = times_s[..., None, :] * frequency[..., None, :, :]  # (..., T, L, K)
    turn -= phase[..., None, :, :]
    waves: Doubles = size[..., None, :, :] * np.cos(turn, out=turn)
    return np.asarray(waves.sum(-2))


def set_in(times_s: NDArray[np.floating]) -> Doubles:
    """0 before a stream begins, 1 from `EASE_S` on, smooth in between."""
    begun = np.minimum(np.maximum(times_s / EASE_S, 0), 1)
    return np.asarray(begun**2 * (3 - 2 * begun))


# --- Channels of the head ---------------------------------------------------------------------------------------------

# Channels of any motion space that turn or move the head, and those of them that a mirror turns around.
HEAD = frozenset(
    {*POSE_CHANNELS, *(f"{part}_{axis}" for part in ("rotation", "translation", "head") for axis in "xyz")}
)

LATERAL = frozenset((*LATERAL_POSE, "rotation_y", "rotation_z", "translation_x", "head_y", "head_z"))
SHIFTING = frozenset(("x", "y", "z", *(f"translation_{axis}" for axis in "xyz")))


def head_channels(channels: Sequence[str]) -> list[int]:
    """Which of the channels move the head."""
    return [index for index, name in enumerate(channels) if name in HEAD]


def lateral_channels(channels: Sequence[str]) -> list[int]:
    """Which of the `head_channels` a mirror turns around, by their place among those."""
    return [at for at, index in enumerate(head_channels(channels)) if channels[index] in LATERAL]


def shifting_channels(channels: Sequence[str]) -> list[int]:
    """Which of the `head_channels` move the head without turning it, by their place among those."""
    return [at for at, index in enumerate(head_channels(channels)) if channels[index] in SHIFTING]
