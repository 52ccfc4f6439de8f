"""What a listener leaves out of the small motion of resting faces, as `listeners.idle_motion` draws it.

Both are cut into windows of two seconds in which nothing of the face is under way: no blink, no smile, no word. By band
the covariance of people's channels less that of the listener's is what it lacks; its largest eigenvectors, region by
region, are the patterns, and their powers by band the spectrum. The slowest band is what differs from window to window,
and where people rest less where the listener does is what it lacks of the mean.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, FRAME_SAMPLES, SHAPES, Doubles, Floats, ListenerEvent
from sfms_robot.listeners.idle_motion import BANDS, BANDS_HZ, IdleMotion
from sfms_robot.signals.events import runs

WINDOW: Final = 2 * FRAME_HZ
FACE_KINDS: Final = ("laugh", "smile", "mm_hm", "brow_raise", "blink")
MARGIN_FRAMES: Final = 4
REGIONS: Final = {
    "brows": ("brow",),
    "lids": ("eyeSquint", "eyeWide", "eyeBlink"),
    "mouth": ("jaw", "mouth", "cheek", "nose", "tongue"),
}
PATTERNS: Final = 4  # of each region, at most
LEAST: Final = 0.001  # deviation of a pattern that is worth drawing, in every channel together
_SOUND: Final = 1e-3


@dataclass(frozen=True)
class Resting:
    """Windows (W, 50, 52) of one face at rest."""

    windows: Floats


def resting(motion: Floats, events: Iterable[ListenerEvent], own_voice: Floats | None = None) -> Resting:
    """Those of a motion (N, 58), its events, and what it says (N * 640,)."""
    still = np.ones(len(motion), bool)
    for event in events:
        if event.kind in FACE_KINDS:
            first, last = int(event.start_s * FRAME_HZ) - MARGIN_FRAMES, int(event.end_s * FRAME_HZ) + MARGIN_FRAMES
            still[max(0, first) : max(0, last)] = False
    if own_voice is not None:
        said = np.abs(own_voice.reshape(len(motion), FRAME_SAMPLES)).max(axis=1) > _SOUND
        still &= np.convolve(said, np.ones(FRAME_HZ), "same") == 0
    found = [
        motion[at : at + WINDOW, SHAPES] for start, end in runs(still) for at in range(start, end - WINDOW + 1, WINDOW)
    ]
    return Resting(np.array(found, np.float32).reshape(-1, WINDOW, len(BLENDSHAPES)))


def fit_idle(theirs: Sequence[Resting], ours: Sequence[Resting]) -> IdleMotion:
    """What `ours` lack of `theirs`; one entry a person. Raises ValueError where either has no window at all."""
    people, listener = ([one.windows for one in faces if len(one.windows)] for faces in (theirs, ours))
    if not people or not listener:
        raise ValueError("no two seconds in which a face rests")
    lacking = covariances(people) - covariances(listener)  # (BANDS, C, C)
    off = _mean(people) - _mean(listener)
    rest, loadings, amplitudes = np.zeros(len(BLENDSHAPES), np.float32), [], []
    for prefixes in REGIONS.values():
        rows = np.array([at for at, name in enumerate(BLENDSHAPES) if name.startswith(prefixes)])
        rest[rows] = off[rows]  # where eyes look is not the face's
        part = lacking[:, rows[:, None], rows]
        power, patterns = np.linalg.eigh(part.sum(0))
        for value, pattern in sorted(zip(power.tolist(), patterns.T, strict=True), key=lambda one: -one[0])[:PATTERNS]:
            if value < LEAST**2:
                break
            by_band = np.clip(np.einsum("c,bcd,d->b", pattern, part, pattern), 0, None)
            loading = np.zeros(len(BLENDSHAPES))
            loading[rows] = np.sqrt(value) * pattern
            loadings.append(loading)
            amplitudes.append(np.sqrt(by_band / by_band.sum()))
    return IdleMotion(
        np.array(loadings, np.float32).reshape(-1, len(BLENDSHAPES)),
        np.array(amplitudes, np.float32).reshape(-1, BANDS).T,
        _spread(people),
        rest,
    )


def _mean(faces: Sequence[Floats]) -> Doubles:
    """(C,) of all windows (W, 50, C)."""
    return np.asarray(np.concatenate(faces).mean(axis=(0, 1), dtype=np.float64), np.float64)


def covariances(faces: Sequence[Floats]) -> Doubles:
    """(BANDS, C, C) of windows (W, 50, C) of several people, each about his own mean."""
    hz = np.fft.rfftfreq(WINDOW, 1 / FRAME_HZ)
    band = np.searchsorted(BANDS_HZ, hz, side="right") - 1
    channels = faces[0].shape[-1]
    found = np.zeros((BANDS, channels, channels))
    count = sum(map(len, faces))
    for windows in faces:
        means = windows.mean(axis=1, dtype=np.float64)
        off = means - means.mean(0)
        found[0] += off.T @ off / count
        lines = np.fft.rfft(windows - means[:, None], axis=1) / WINDOW  # (W, F, C)
        for at in range(1, BANDS):
            chosen = lines[:, band == at].reshape(-1, channels)
            found[at] += 2 * np.real(chosen.conj().T @ chosen) / count
    return found


def _spread(faces: Sequence[Floats]) -> float:
    """Deviation of the logarithm of how much people move, of those seen for ten seconds and more."""
    sizes = [np.log(windows.std(axis=(0, 1)).mean() + 1e-9) for windows in faces if len(windows) * 2 >= 10]
    return float(np.clip(np.std(sizes), 0, 1)) if len(sizes) > 1 else 0.0


def explained(idle: IdleMotion) -> NDArray[np.float64]:
    """(52,) deviation of every channel that it adds."""
    return np.asarray(np.sqrt((idle.loadings.astype(np.float64) ** 2).sum(0)), np.float64)
