"""The small motion of a face that does nothing, as a process of its own beside what a listener draws.

Keyframes pay for events: what moves by a hundredth is drawn as stillness, and a face that stands still looks dead. As
with the slow sway of a head there is nothing to predict in it, so it is drawn from what recorded faces do and tokens
leave out (Shinozuka's spectral representation of a stationary Gaussian process),

    x(t) = rest + size * sum over k of  loadings[k] * sum over l of  amplitude[l, k] (a cos 2 pi f t + b sin 2 pi f t),

components k, lines l, a, b ~ N(0, 1), `LINES` frequencies drawn from each of the `BANDS_HZ` per component, `size` a
stream's own. Components are patterns of channels that move together; `rest` is how far from people the codes rest. A
function of the seed and of time alone: a plan may be made anew, or in other pieces, and shows the same. It sets in over
the first `EASE_S`. Faces never go below 0 nor above 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ModelError
from sfms_robot.frames import MOTION_DIM, SHAPES, Doubles, Floats
from sfms_robot.listeners.spectral_lines import as_cosines, set_in, sum_of_lines

FILE: Final = "idle_motion.safetensors"  # in a listener's folder; without it a listener has none
BANDS_HZ: Final = (0.04, 0.4, 0.75, 1.25, 2.0, 3.0, 5.0, 8.0)  # edges
BANDS: Final = len(BANDS_HZ) - 1
LINES: Final = 3  # of each band
LARGEST: Final = 0.5  # no resting face moves so far
_SEED: Final = 0x1D1E  # apart from what else a stream draws by its seed
_COUNT: Final = MOTION_DIM - SHAPES.start
_TENSORS: Final = ("loadings", "amplitude", "spread", "rest")


@dataclass(frozen=True)
class IdleStream:
    """One stream's own: of every line, which is one cosine, frequency [rad/s], size and phase [rad], (L, K) each;
    loadings (K, 52), rest (52,).
    """

    frequency: Doubles
    size: Doubles
    phase: Doubles
    loadings: Doubles
    rest: Doubles

    def added(self, frames: Floats, times_s: Doubles) -> Floats:
        """Motion (N, 58) with the idle motion of times (N,) since the stream began: a new array."""
        parts = sum_of_lines(times_s, self.frequency, self.size, self.phase)  # (N, K)
        eased = (parts @ self.loadings + self.rest) * set_in(times_s)[:, None]
        out = frames.copy()
        out[:, SHAPES] = np.minimum(np.maximum(out[:, SHAPES] + eased, 0), 1)
        return out


@dataclass(frozen=True)
class IdleMotion:
    """What was learned: K components.

    Attributes:
        loadings: (K, 52) how far each blendshape goes with a component, of deviation 1.
        amplitude: (BANDS, K) deviation of each component within each band; of all bands together about 1.
        spread: deviation of the logarithm of sizes between people.
        rest: (52,) mean of people's resting faces less that of the listener's.
    """

    loadings: Floats
    amplitude: Floats
    spread: float
    rest: Floats

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
        frequency = 2 * math.pi * frequency_hz.reshape(-1, parts)
        return IdleStream(frequency, sizes, phase, self.loadings.astype(np.float64), self.rest.astype(np.float64))

    def save(self, file: Path) -> None:
        """Raises ModelError where it cannot be written."""
        from safetensors import SafetensorError
        from safetensors.numpy import save_file

        tensors = {name: getattr(self, name) for name in _TENSORS}
        try:
            save_file({name: np.ascontiguousarray(value, np.float32) for name, value in tensors.items()}, file)
            file.chmod(0o644)
        except (OSError, SafetensorError) as error:
            raise ModelError(f"{file}: cannot be written: {error}") from error

    @classmethod
    def load(cls, file: Path) -> IdleMotion:
        """Raises ModelError when the file is none, cut off, of another shape, not finite or larger than faces idle."""
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        try:
            found = load_file(file)
        except (OSError, SafetensorError) as error:
            raise ModelError(f"{file}: not a readable safetensors file: {error}") from error
        if set(found) != {*_TENSORS}:
            raise ModelError(f"{file}: holds {', '.join(sorted(found))}, not {', '.join(_TENSORS)}")
        loadings, amplitude, spread, rest = (found[name] for name in _TENSORS)
        parts = len(loadings) if loadings.ndim else 0
        shapes = [(parts, _COUNT), (BANDS, parts), (_COUNT,)]
        if [one.shape for one in (loadings, amplitude, rest)] != shapes or spread.size != 1:
            raise ModelError(
                f"{file}: loadings {loadings.shape}, amplitude {amplitude.shape}, spread {spread.shape}, rest "
                f"{rest.shape}; idle motion has (K, {_COUNT}), ({BANDS}, K), one number and ({_COUNT},)"
            )
        if not all(np.isfinite(value).all() for value in found.values()):
            raise ModelError(f"{file}: holds values that are not finite")
        largest = float(np.abs(loadings).max(initial=0.0) * np.linalg.norm(amplitude, axis=0).max(initial=0.0))
        largest = max(largest, float(np.abs(rest).max()))
        if largest > LARGEST or not 0 <= float(spread.item()) <= 1:
            raise ModelError(
                f"{file}: moves a face by {largest:.3g}, with a spread of {float(spread.item()):.3g}; "
                f"at rest none moves by more than {LARGEST:g}, nor differ people by more than 1"
            )
        return cls(loadings, amplitude, float(spread.item()), rest)
