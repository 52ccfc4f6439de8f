"""Motion of a head and a face that do nothing: slow sway of the head, and the small motion of a resting face.

There is nothing to predict in either, so neither is drawn by a listener's network. Sway from tokens would move in
steps, since the codes of a whole head are as far apart as its sway is wide. Sway drawn frame by frame from its own past
grows, or keeps part of a nod for seconds. Keyframes are spent on events, so a face at rest would stand still and look
dead. Both motions are made from statistics of recorded people (Shinozuka's spectral representation of a stationary
process), as functions of the seed and of time alone. So all future frames are known, a plan that is made again, or in
other pieces, shows the same motion, nothing accumulates, and after an hour a head is where it was. Both begin smoothly
over the first `EASE_S`.

Sway is a sum of lines l, each one cosine per channel:

    x(t) = size * sum over l of  2^1/2 M[l] (a_l cos 2 pi f_l t + b_l sin 2 pi f_l t),   a_l, b_l in R^S

`LINES` frequencies are drawn from each of the `BANDS_HZ`. `M M^T` of each band is the covariance of the channels of
heads there: a head that leans forward also comes down. Over the lines of a band sum a a^T + b b^T = 1: the direction of
a head is random, but its amount of motion is not. Only `size`, a constant of the stream, sets that amount, within the
range of people. Half of all streams are mirrored, because people lean to both sides equally. Heads do not sway evenly:
they stand for a second or two and then shift. So t is the time of a clock that runs faster and slower, by `UNEVEN` of
its pace, with a period within `CLOCK_S`; turns of the head have one clock, shifts another. The distribution of the
head's positions stays the same; its motion within two seconds varies from time to time as much as that of people.

Idle motion of the face (`IdleMotion`), components k, lines l, a, b ~ N(0, 1):

    x(t) = size * sum over k of  loadings[k] * sum over l of  amplitude[l, k] (a cos 2 pi f t + b sin 2 pi f t)

Components are patterns of channels that move together. The sum of this and the listener's motion has other values at
rest than people have, whose values are not normally distributed: a muscle is slack for a third of the time, and hardly
ever far above its middle. So each channel goes through a non-decreasing map from its own quantiles at rest (`held`) to
those of people (`shown`). Above them, where events are, the last difference is added. Values stay within 0 and 1. A
mouth that speaks is not at rest: the map has no effect on it until half a second after the own voice, and its full
effect half a second later.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot import config
from sfms_robot.errors import ModelError
from sfms_robot.frames import (
    BLENDSHAPES,
    FRAME_S,
    LATERAL_POSE,
    MOTION_DIM,
    POSE_CHANNELS,
    SHAPES,
    Doubles,
    Floats,
    Ints,
    Reals,
)
from sfms_robot.listeners.checkpoint import read_weights, write_tensors
from sfms_robot.listeners.stream_rng import Use, normals, uniforms

BANDS_HZ = (0.01, 0.03, 0.06, 0.1, 0.16, 0.24, 0.34, 0.46, 0.62, 0.85, 1.15, 1.6)  # edges
BANDS = len(BANDS_HZ) - 1
LINES = 6  # lines per band; 2 * LINES must not be less than the channels of a head
WIDEST = 2.0  # largest difference of a stream's log size from the mean, in deviations
UNEVEN = 0.85
CLOCK_S = (4.0, 8.0)  # shortest and longest period of a clock


class HeadSway:
    """The sway of one listener's streams; a listener with `sway: false` has none.

    Its tensors, fitted by `lab.learning.corpus`, are `sway_mixture` (BANDS, S, S) and `sway_spread` () of `draw_sway`,
    in units of its motion space, for the S channels that move the head.
    """

    def __init__(self, settings: config.ListenerSettings, tensors: Mapping[str, Floats]) -> None:
        self._head = head_channels(settings.channels) if settings.sway else []
        self._lateral = among_head(settings.channels, LATERAL)
        self._shifting = among_head(settings.channels, SHIFTING)
        self._tensors = tensors

    def start(self, seed: int) -> Doubles:
        """Return the sway of a stream, for `sway_at`; empty for a listener without sway."""
        if not self._head:
            return np.zeros((3, 0, 0))
        mixture, spread = self._tensors["sway_mixture"], float(self._tensors["sway_spread"])
        return draw_sway(mixture, spread, seed, self._lateral, self._shifting)

    def added(self, motion: Floats, sway: Doubles, first: int | Ints) -> Floats:
        """Add the sway of each stream to motion (..., N, C) of frames `first`, `first` + 1, ..., in place.

        `sway`: (..., 3, 1 + L, S). `first`: one number for all streams, or (...) for each.
        """
        if self._head:
            frames = np.asarray(first)[..., None] + 1.0 + np.arange(motion.shape[-2])
            motion[..., self._head] += sway_at(sway, FRAME_S * frames)
        return motion


def draw_sway(
    mixture: Floats, spread: float, seed: int, lateral: Sequence[int] = (), shifting: Sequence[int] = ()
) -> Doubles:
    """Draw the lines of one stream's sway.

    Args:
        mixture: (BANDS, S, S) M of each band, from (a, b) of a line to the channels.
        spread: deviation of the logarithm of sizes between people.
        seed: seed of the stream.
        lateral: channels that change their sign in a mirror.
        shifting: channels that follow the second clock.

    Returns:
        (3, 1 + BANDS * LINES, S) frequencies [rad/s], sizes in units of the motion, and phases [rad]; the first row is
        each channel's clock, whose sizes are in seconds.
    """
    bands, channels, _ = mixture.shape
    edges = np.array(BANDS_HZ)
    uniform = uniforms(seed, 0, Use.SWAY, 1 + bands * LINES + 4)
    frequency_hz = edges[:-1, None] + uniform[1:-4].reshape(bands, LINES) * np.diff(edges)[:, None]
    drawn = normals(seed, 1, Use.SWAY, 1 + 2 * bands * LINES * channels).astype(np.float64)
    lots, _ = np.linalg.qr(drawn[1:].reshape(bands, 2 * LINES, channels))  # orthonormal columns in each band
    factors = np.einsum("bsc,bplc->pbls", mixture.astype(np.float64), lots.reshape(bands, 2, LINES, channels))
    factors *= math.sqrt(2) * math.exp(spread * min(max(drawn[0], -WIDEST), WIDEST))
    if uniform[0] < 0.5:
        factors[..., list(lateral)] *= -1
    size, phase = as_cosines(*factors)
    turns = np.broadcast_to(2 * math.pi * frequency_hz[..., None], size.shape)
    lines = np.stack([turns, size, phase]).reshape(3, bands * LINES, channels)
    clock = np.zeros(channels, np.intp)  # clock of each channel: the first or the second
    clock[list(shifting)] = 1
    turn = 2 * math.pi / (CLOCK_S[0] + (CLOCK_S[1] - CLOCK_S[0]) * uniform[-4:-2])
    clocks = np.stack([turn, UNEVEN / turn, 2 * math.pi * uniform[-2:]])[:, None, clock]
    return np.concatenate([clocks, lines], axis=1)


def sway_at(sway: Doubles, times_s: Reals) -> Floats:
    """Return motion (..., T, S) of sway (..., 3, 1 + L, S) at times (T,) since the stream began, or (..., T) of each.

    It is in units of the motion, and 0 before the stream began.
    """
    lines, clocks = sway[..., 1:, :], sway[..., :1, :]
    own_s = times_s[..., None] + sum_of_lines(times_s[..., None], *np.moveaxis(clocks, -3, 0))  # (..., T, S)
    return np.asarray(sum_of_lines(own_s, *np.moveaxis(lines, -3, 0)) * set_in(times_s)[..., None], np.float32)


# --- Spectral lines ---------------------------------------------------------------------------------------------------
#
# A line a cos 2 pi f t + b sin 2 pi f t is one cosine, |(a, b)| cos(2 pi f t - atan2(b, a)), and is stored as one.
# Sway and idle motion are both sums of lines.

EASE_S: Final = 3.0


def as_cosines(a: Doubles, b: Doubles) -> tuple[Doubles, Doubles]:
    """Return size and phase [rad] of lines with the factors a of the cosine and b of the sine."""
    return np.hypot(a, b), np.arctan2(b, a)


def sum_of_lines(times_s: Reals, frequency: Doubles, size: Doubles, phase: Doubles) -> Doubles:
    """Return the sum (..., T, K) of lines (..., L, K), with frequencies in [rad/s].

    Times are (T, 1) for all, (..., T, 1) for each, or (..., T, K) if every column has another clock.
    """
    turn = times_s[..., None, :] * frequency[..., None, :, :]  # (..., T, L, K)
    turn -= phase[..., None, :, :]
    waves: Doubles = size[..., None, :, :] * np.cos(turn, out=turn)
    return np.asarray(waves.sum(-2))


def set_in(times_s: Reals) -> Doubles:
    """Return a factor that is 0 before a stream begins, 1 from `EASE_S` on, and smooth in between."""
    begun = np.minimum(np.maximum(times_s / EASE_S, 0), 1)
    return np.asarray(begun**2 * (3 - 2 * begun))


# --- Channels of the head ---------------------------------------------------------------------------------------------

# Channels of any motion space that turn or move the head. LATERAL: those of them that change their sign in a mirror.
HEAD = frozenset(
    {*POSE_CHANNELS, *(f"{part}_{axis}" for part in ("rotation", "translation", "head") for axis in "xyz")}
)

LATERAL = frozenset((*LATERAL_POSE, "rotation_y", "rotation_z", "translation_x", "head_y", "head_z"))
SHIFTING = frozenset(("x", "y", "z", *(f"translation_{axis}" for axis in "xyz")))


def head_channels(channels: Sequence[str]) -> list[int]:
    """Return the indices of the channels that move the head."""
    return [index for index, name in enumerate(channels) if name in HEAD]


def among_head(channels: Sequence[str], names: Collection[str]) -> list[int]:
    """Return the positions among the `head_channels` of those with one of `names`, such as `LATERAL`."""
    return [at for at, index in enumerate(head_channels(channels)) if channels[index] in names]


# --- Idle motion of a face --------------------------------------------------------------------------------------------

FILE: Final = "idle_motion.safetensors"  # in a listener's folder; without it the listener has no idle motion
IDLE_BANDS_HZ: Final = (0.04, 0.4, 0.75, 1.25, 2.0, 3.0, 5.0, 8.0)  # edges
IDLE_BANDS: Final = len(IDLE_BANDS_HZ) - 1
IDLE_LINES: Final = 3  # lines per band
LARGEST: Final = 0.5  # limit of a file's motion: no resting face moves so far
_SEED: Final = 0x1D1E  # separates these numbers from others that a stream draws by its seed
_COUNT: Final = MOTION_DIM - SHAPES.start
KNOTS: Final = 9  # knots in the map of each channel
STEEPEST: Final = 2.0
AFTER_SPEECH_S: Final = 0.5  # until a mouth counts as resting; after twice this time the map has its full effect
MOUTH: Final = ("jaw", "mouth", "cheek", "nose", "tongue")  # prefixes of the names of its channels
_OF_MOUTH: Final = np.array([name.startswith(MOUTH) for name in BLENDSHAPES])
_ROUNDING: Final = 1e-6


@dataclass(frozen=True)
class RestMap:
    """Piecewise linear maps of 52 channels; beyond the first and last knot a channel is only shifted.

    Attributes:
        base: (52,) added everywhere.
        low: (52, J) beginning of each piece.
        width: (52, J) length of each piece.
        gain: (52, J) slope of each piece minus 1.
    """

    base: Doubles
    low: Doubles
    width: Doubles
    gain: Doubles

    @classmethod
    def between(cls, held: Floats, shown: Floats) -> RestMap:
        """Return the map from values `held` (J + 1, 52), which never fall, to values `shown` (J + 1, 52)."""
        low, width = held[:-1].T.astype(np.float64), np.diff(held, axis=0).T.astype(np.float64)
        gain = np.diff(shown, axis=0).T / np.maximum(width, 1e-9) - 1
        return cls((shown[0] - held[0]).astype(np.float64), low, width, gain)

    def off(self, shapes: Doubles) -> Doubles:
        """Return the change (N, 52) that the map makes to shapes (N, 52)."""
        part = shapes[:, :, None] - self.low
        np.minimum(np.maximum(part, 0, out=part), self.width, out=part)
        return np.asarray(self.base + np.einsum("ncj,cj->nc", part, self.gain), np.float64)


@dataclass(frozen=True, kw_only=True)
class IdleStream:
    """The idle motion of one stream.

    Each line is one cosine with a frequency [rad/s], size and phase [rad], (L, K) each. `loadings` is (K, 52), `rest`
    the map of a resting face.
    """

    frequency: Doubles
    size: Doubles
    phase: Doubles
    loadings: Doubles
    rest: RestMap

    def added(self, frames: Floats, times_s: Doubles, silent_s: Doubles | float = math.inf) -> Floats:
        """Return a new array of motion (N, 58) plus the idle motion at times (N,) since the stream began.

        `silent_s`: (N,) time since the own voice ended; `inf`: there has been none.
        """
        parts = sum_of_lines(times_s[:, None], self.frequency, self.size, self.phase)  # (N, K)
        idle = parts @ self.loadings  # (N, 52)
        rest = self.rest.off(frames[:, SHAPES] + idle)
        at_rest = np.minimum(np.maximum(np.divide(silent_s, AFTER_SPEECH_S) - 1, 0), 1)  # 0 while the mouth speaks
        rest[:, _OF_MOUTH] *= np.reshape(at_rest, (-1, 1))
        idle += rest
        out = frames.copy()
        out[:, SHAPES] = np.minimum(np.maximum(out[:, SHAPES] + idle * set_in(times_s)[:, None], 0), 1)
        return out


@dataclass(frozen=True)
class IdleMotion:
    """Learned idle motion with K components.

    Attributes:
        loadings: (K, 52) blendshapes of each component, of deviation 1.
        amplitude: (IDLE_BANDS, K) deviation of each component within each band; of all bands together about 1.
        spread: deviation of the logarithm of sizes between people.
        held, shown: (KNOTS, 52) quantiles of the listener's resting face with this motion, and of people's.
    """

    loadings: Floats
    amplitude: Floats
    spread: float
    held: Floats
    shown: Floats

    def start(self, seed: int) -> IdleStream:
        """Draw the idle motion of a stream by its seed."""
        rng = np.random.default_rng([_SEED, seed])
        edges, (bands, parts) = np.array(IDLE_BANDS_HZ), self.amplitude.shape
        frequency_hz = edges[:-1, None, None] + rng.random((bands, IDLE_LINES, parts)) * np.diff(edges)[:, None, None]
        size = math.exp(self.spread * rng.standard_normal() - self.spread**2)  # the mean power is 1
        factors = (
            size
            * rng.standard_normal((2, bands, IDLE_LINES, parts))
            * (self.amplitude / math.sqrt(IDLE_LINES))[:, None]
        )
        sizes, phase = as_cosines(*factors.reshape(2, bands * IDLE_LINES, parts))
        frequency = 2 * math.pi * frequency_hz.reshape(bands * IDLE_LINES, parts)
        rest = RestMap.between(self.held, self.shown)
        return IdleStream(
            frequency=frequency, size=sizes, phase=phase, loadings=self.loadings.astype(np.float64), rest=rest
        )

    def save(self, file: Path) -> None:
        """Write the tensors to `file`. Raises ModelError if it cannot be written."""
        write_tensors(file, {name: np.ascontiguousarray(value, np.float32) for name, value in vars(self).items()})

    @classmethod
    def load(cls, file: Path) -> IdleMotion:
        """Read `file`. Raises ModelError if it is missing, cut off, of another shape, or moves a face too far."""
        found = read_weights(file)
        parts = len(np.atleast_1d(found.get("loadings", np.zeros(0))))
        wanted = {
            "amplitude": (IDLE_BANDS, parts),
            "held": (KNOTS, _COUNT),
            "loadings": (parts, _COUNT),
            "shown": (KNOTS, _COUNT),
            "spread": (1,),
        }
        if (shapes := {name: found[name].shape for name in sorted(found)}) != wanted:
            raise ModelError(f"{file}: expected tensors {wanted}, got {shapes}")
        amplitude, held, loadings, shown, spread = (found[name] for name in wanted)
        steps = np.diff(np.stack([held, shown]).astype(np.float64), axis=1)
        if steps.min() < 0 or (steps[1] > STEEPEST * steps[0] + _ROUNDING).any():
            raise ModelError(f"{file}: held, shown: the map of rest falls, or is steeper than {STEEPEST:g}")
        largest = float(np.abs(loadings).max(initial=0.0) * np.linalg.norm(amplitude, axis=0).max(initial=0.0))
        largest = max(largest, float(np.abs(shown - held).max()))
        if largest > LARGEST or not 0 <= spread[0] <= 1:
            raise ModelError(
                f"{file}: expected motion up to {LARGEST:g} and a spread of 0..1, got {largest:.3g} and {spread[0]:.3g}"
            )
        return cls(loadings, amplitude, float(spread[0]), held, shown)
