"""The small motion of a face that does nothing, as a process of its own beside what a listener draws.

Keyframes pay for events: what moves by a hundredth is drawn as stillness, and a face that stands still looks dead. As
with the slow sway of a head there is nothing to predict in it, so it is drawn from what recorded faces do and tokens
leave out (Shinozuka's spectral representation of a stationary Gaussian process),

    x(t) = size * sum over k of  loadings[k] * sum over l of  amplitude[l, k] (a cos 2 pi f t + b sin 2 pi f t),

components k, lines l, a, b ~ N(0, 1), `LINES` frequencies drawn from each of the `BANDS_HZ` per component, `size` a
stream's own. Components are patterns of channels that move together. A function of the seed and of time alone: a plan
may be made anew, or in other pieces, and shows the same. It sets in over the first `EASE_S`.

What a listener draws and this together rest elsewhere than people do, and not as bells do: a muscle is slack for a
third of the time, and hardly ever far above its middle. So each channel goes through a map that never falls, from its
own quantiles at rest (`held`) to people's (`shown`), and above them, where events are, goes on by the last difference.
Faces never go below 0 nor above 1. A mouth that speaks does not rest: it goes through no map until half a second after
its own voice, and through all of it half a second later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ModelError
from sfms_robot.frames import BLENDSHAPES, MOTION_DIM, SHAPES, Doubles, Floats
from sfms_robot.listeners.checkpoint import read_weights, write_tensors
from sfms_robot.listeners.sway import as_cosines, set_in, sum_of_lines

FILE: Final = "idle_motion.safetensors"  # in a listener's folder; without it a listener has none
BANDS_HZ: Final = (0.04, 0.4, 0.75, 1.25, 2.0, 3.0, 5.0, 8.0)  # edges
BANDS: Final = len(BANDS_HZ) - 1
LINES: Final = 3  # of each band
LARGEST: Final = 0.5  # no resting face moves so far
_SEED: Final = 0x1D1E  # apart from what else a stream draws by its seed
_COUNT: Final = MOTION_DIM - SHAPES.start
KNOTS: Final = 9  # of the map of each channel
STEEPEST: Final = 2.0
AFTER_SPEECH_S: Final = 0.5  # a mouth rests; so much later it rests as people's do
MOUTH: Final = ("jaw", "mouth", "cheek", "nose", "tongue")  # what names of its channels begin with
_OF_MOUTH: Final = np.array([name.startswith(MOUTH) for name in BLENDSHAPES])
_ROUNDING: Final = 1e-6
_TENSORS: Final = ("loadings", "amplitude", "spread", "held", "shown")


@dataclass(frozen=True)
class RestMap:
    """Maps of 52 channels, pieces of straight lines: below the first knot and above the last a channel is moved, no
    more. 0 and above stays so.

    Attributes:
        base: (52,) what is added everywhere.
        low: (52, J) where each piece begins.
        width: (52, J) how long it is.
        gain: (52, J) how much steeper than 1.
    """

    base: Doubles
    low: Doubles
    width: Doubles
    gain: Doubles

    @classmethod
    def between(cls, held: Floats, shown: Floats) -> RestMap:
        """From values (J + 1, 52), which never fall, to others."""
        low, width = held[:-1].T.astype(np.float64), np.diff(held, axis=0).T.astype(np.float64)
        gain = np.diff(shown, axis=0).T / np.maximum(width, 1e-9) - 1
        return cls((shown[0] - held[0]).astype(np.float64), low, width, gain)

    def off(self, shapes: Doubles) -> Doubles:
        """How far the map takes shapes (N, 52)."""
        part = shapes[:, :, None] - self.low
        np.minimum(np.maximum(part, 0, out=part), self.width, out=part)
        return np.asarray(self.base + np.einsum("ncj,cj->nc", part, self.gain), np.float64)


@dataclass(frozen=True)
class IdleStream:
    """One stream's own: of every line, which is one cosine, frequency [rad/s], size and phase [rad], (L, K) each;
    loadings (K, 52), and the map of where it rests.
    """

    frequency: Doubles
    size: Doubles
    phase: Doubles
    loadings: Doubles
    rest: RestMap

    def added(self, frames: Floats, times_s: Doubles, silent_s: Doubles | float = math.inf) -> Floats:
        """Motion (N, 58) with the idle motion of times (N,) since the stream began: a new array.

        `silent_s`: (N,), how long its own voice has not been heard; `inf`: never.
        """
        parts = sum_of_lines(times_s[:, None], self.frequency, self.size, self.phase)  # (N, K)
        idle = parts @ self.loadings  # (N, 52)
        rest = self.rest.off(frames[:, SHAPES] + idle)
        at_rest = np.minimum(np.maximum(np.divide(silent_s, AFTER_SPEECH_S) - 1, 0), 1)  # 0: the mouth speaks
        rest[:, _OF_MOUTH] *= np.reshape(at_rest, (-1, 1))
        idle += rest
        out = frames.copy()
        out[:, SHAPES] = np.minimum(np.maximum(out[:, SHAPES] + idle * set_in(times_s)[:, None], 0), 1)
        return out


@dataclass(frozen=True)
class IdleMotion:
    """What was learned: K components.

    Attributes:
        loadings: (K, 52) how far each blendshape goes with a component, of deviation 1.
        amplitude: (BANDS, K) deviation of each component within each band; of all bands together about 1.
        spread: deviation of the logarithm of sizes between people.
        held, shown: (KNOTS, 52) quantiles of what the listener's resting face does with this, and of people's.
    """

    loadings: Floats
    amplitude: Floats
    spread: float
    held: Floats
    shown: Floats

    def start(self, seed: int) -> IdleStream:
        """A stream's own, by lot of its seed."""
        rng = np.random.default_rng([_SEED, seed])
        edges, (bands, parts) = np.array(BANDS_HZ), self.amplitude.shape
        uniform = rng.random((bands, LINES, parts))
        frequency_hz = edges[:-1, None, None] + uniform * np.diff(edges)[:, None, None]
        size = math.exp(self.spread * rng.standard_normal() - self.spread**2)  # of power 1 in the mean
        factors = size * rng.standard_normal((2, bands, LINES, parts)) * (self.amplitude / math.sqrt(LINES))[:, None]
        cosine, sine = factors.reshape(2, bands * LINES, parts)
        sizes, phase = as_cosines(cosine, sine)
        frequency = 2 * math.pi * frequency_hz.reshape(bands * LINES, parts)
        rest = RestMap.between(self.held, self.shown)
        return IdleStream(frequency, sizes, phase, self.loadings.astype(np.float64), rest)

    def save(self, file: Path) -> None:
        """Write the tensors to `file`. Raises ModelError if it cannot be written."""
        write_tensors(file, {name: np.ascontiguousarray(getattr(self, name), np.float32) for name in _TENSORS})

    @classmethod
    def load(cls, file: Path) -> IdleMotion:
        """Read `file`. Raises ModelError if it is missing, cut off, of another shape, or moves a face too far."""
        found = read_weights(file)
        if set(found) != {*_TENSORS}:
            raise ModelError(f"{file}: holds {', '.join(sorted(found))}, not {', '.join(_TENSORS)}")
        loadings, amplitude, spread, held, shown = (found[name] for name in _TENSORS)
        parts = len(loadings) if loadings.ndim else 0
        shapes = [(parts, _COUNT), (BANDS, parts), (KNOTS, _COUNT), (KNOTS, _COUNT)]
        if [one.shape for one in (loadings, amplitude, held, shown)] != shapes or spread.size != 1:
            raise ModelError(
                f"{file}: loadings {loadings.shape}, amplitude {amplitude.shape}, spread {spread.shape}, held "
                f"{held.shape}, shown {shown.shape}; idle motion has (K, {_COUNT}), ({BANDS}, K), one number and twice "
                f"({KNOTS}, {_COUNT})"
            )
        steps = np.diff(np.stack([held, shown]).astype(np.float64), axis=1)
        if steps.min() < 0 or (steps[1] > STEEPEST * steps[0] + _ROUNDING).any():
            raise ModelError(f"{file}: a map of where a face rests falls, or is steeper than {STEEPEST:g}")
        largest = float(np.abs(loadings).max(initial=0.0) * np.linalg.norm(amplitude, axis=0).max(initial=0.0))
        largest = max(largest, float(np.abs(shown - held).max()))
        if largest > LARGEST or not 0 <= float(spread.item()) <= 1:
            raise ModelError(
                f"{file}: moves a face by {largest:.3g}, with a spread of {float(spread.item()):.3g}; "
                f"at rest none moves by more than {LARGEST:g}, nor differ people by more than 1"
            )
        return cls(loadings, amplitude, float(spread.item()), held, shown)
