"""Fit of the small motion of resting faces that a listener lacks; `listeners.idle` draws it.

Motion of people and of the listener is cut into windows of two seconds without an event of the face: no blink, smile or
word. In each frequency band, the covariance of people's channels minus that of the listener's is what it lacks. The
largest eigenvectors, region by region, are the patterns. Their powers by band are the spectrum, without the power that
leaks from other bands in such short windows. The slowest band is the difference between windows, over all people. The
rest positions of people, and of the listener with its patterns, are quantiles of all frames of these windows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.optimize import nnls

from sfms_robot.config import find
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, FRAME_SAMPLES, SHAPES, Doubles, Floats, ListenerEvent
from sfms_robot.lab.evaluation.rollout import rollouts, streamable
from sfms_robot.listeners.checkpoint import load_config
from sfms_robot.listeners.idle import FILE, IDLE_BANDS, IDLE_BANDS_HZ, KNOTS, MOUTH, STEEPEST, IdleMotion
from sfms_robot.listeners.registry import load_folder, one_thread
from sfms_robot.signals.events import runs

WINDOW: Final = 2 * FRAME_HZ
FACE_KINDS: Final = ("laugh", "smile", "mm_hm", "brow_raise", "blink")
MARGIN_FRAMES: Final = 4
REGIONS: Final = [  # rows of blendshapes: brows, lids, mouth
    np.array([at for at, name in enumerate(BLENDSHAPES) if name.startswith(begins)])
    for begins in (("brow",), ("eyeSquint", "eyeWide", "eyeBlink"), MOUTH)
]
PATTERNS: Final = 4  # most patterns of each region
LEAST: Final = 0.001  # least deviation of a pattern, over all its channels, that is worth drawing
AT: Final = (0.01, 0.05, 0.15, 0.3, 0.5, 0.7, 0.85, 0.95, 0.99)  # quantiles
_SOUND: Final = 1e-3
# Band of every line of a window's spectrum.
_BAND: Final = np.searchsorted(IDLE_BANDS_HZ, np.fft.rfftfreq(WINDOW, 1 / FRAME_HZ), side="right") - 1


def resting(motion: Floats, events: Iterable[ListenerEvent], own_voice: Floats | None = None) -> Floats:
    """Return the windows (W, 50, 52) of a motion (N, 58) without events of the face or own voice (N * 640,)."""
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
    return np.array(found, np.float32).reshape(-1, WINDOW, len(BLENDSHAPES))


def fit_idle(theirs: Sequence[Floats], ours: Sequence[Floats]) -> IdleMotion:
    """Return the idle motion that the windows `ours` lack compared with `theirs`.

    Both have an array (W, 50, 52) per person. Raises ValueError if either has no window.
    """
    people, listener = ([one for one in faces if len(one)] for faces in (theirs, ours))
    if not people or not listener:
        raise ValueError("no two seconds in which a face rests")
    lacking = covariances(people) - covariances(listener)  # (IDLE_BANDS, C, C)
    loadings, amplitudes = [], []
    for rows in REGIONS:
        part = lacking[:, rows[:, None], rows]
        power, patterns = np.linalg.eigh(part.sum(0))
        for value, pattern in sorted(zip(power.tolist(), patterns.T, strict=True), key=lambda one: -one[0])[:PATTERNS]:
            if value < LEAST**2:
                break
            by_band = nnls(_leakage(), np.einsum("c,bcd,d->b", pattern, part, pattern))[0]
            loading = np.zeros(len(BLENDSHAPES))
            loading[rows] = np.sqrt(by_band.sum()) * pattern
            loadings.append(loading)
            amplitudes.append(np.sqrt(by_band / by_band.sum()))
    # Size of each person's motion, for those with ten seconds or more of windows.
    sizes = [np.log(windows.std(axis=(0, 1)).mean() + 1e-9) for windows in people if len(windows) * 2 >= 10]
    idle = IdleMotion(
        np.array(loadings, np.float32).reshape(-1, len(BLENDSHAPES)),
        np.array(amplitudes, np.float32).reshape(-1, IDLE_BANDS).T,
        float(np.clip(np.std(sizes), 0, 1)) if len(sizes) > 1 else 0.0,
        *np.zeros((2, KNOTS, len(BLENDSHAPES)), np.float32),
    )
    held, shown = _quantiles(idle, people, listener)
    return replace(idle, held=held, shown=shown)


def _quantiles(idle: IdleMotion, people: Sequence[Floats], listener: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return quantiles (KNOTS, C) of the listener's windows with the idle motion added, and of people's windows.

    The channels of gaze are unchanged. Steps between people's quantiles, counted from the middle one, are limited to
    the steepest allowed map.
    """
    rng = np.random.default_rng(0)
    rest = np.concatenate(listener).reshape(-1, len(BLENDSHAPES)).astype(np.float64)
    lots = rng.standard_normal((len(rest), len(idle.loadings)))
    lots *= np.exp(idle.spread * rng.standard_normal((len(rest), 1)) - idle.spread**2)
    held = np.quantile(rest + lots @ idle.loadings, AT, axis=0)
    shown = held.copy()
    wanted = np.quantile(np.concatenate(people).reshape(-1, len(BLENDSHAPES)), AT, axis=0)
    middle = KNOTS // 2
    steps = np.minimum(np.diff(wanted, axis=0), STEEPEST * np.diff(held, axis=0))
    at = np.concatenate([np.zeros((1, len(BLENDSHAPES))), np.cumsum(steps, axis=0)])
    for rows in REGIONS:
        shown[:, rows] = (at - at[middle] + wanted[middle])[:, rows]
    return held.astype(np.float32), shown.astype(np.float32)


def _leakage() -> Doubles:
    """Return the mean power that `covariances` finds in each band (row) for power 1 in a band (column).

    Shape (IDLE_BANDS, IDLE_BANDS). A frequency also shows in other bands, above all if its period exceeds the window.
    """
    edges = np.array(IDLE_BANDS_HZ)
    hz = edges[:-1] + (np.arange(64)[:, None] + 0.5) / 64 * np.diff(edges)  # (64, IDLE_BANDS)
    turn = np.exp(2j * np.pi * hz.T[:, :, None] / FRAME_HZ * np.arange(WINDOW))  # (IDLE_BANDS, 64, 50)
    power = np.abs(np.fft.fft(turn, axis=-1) / WINDOW) ** 2  # of lines a + ib: half of it at f, half at -f
    both = (power + np.roll(power[..., ::-1], 1, axis=-1)) / 2
    found = np.zeros((IDLE_BANDS, IDLE_BANDS))
    found[0] = both[..., 0].mean(1)
    for at in range(1, IDLE_BANDS):
        found[at] = 2 * both[..., : WINDOW // 2 + 1][..., _BAND == at].sum(-1).mean(1)
    return found


def covariances(faces: Sequence[Floats]) -> Doubles:
    """Return covariances (IDLE_BANDS, C, C) of people's windows (W, 50, C); the slowest about their common mean."""
    windows = np.concatenate(faces)
    channels = windows.shape[-1]
    means = windows.mean(axis=1, dtype=np.float64)
    found = np.zeros((IDLE_BANDS, channels, channels))
    off = means - means.mean(0)
    found[0] = off.T @ off / len(windows)
    lines = np.fft.rfft(windows - means[:, None], axis=1) / WINDOW  # (W, F, C)
    for at in range(1, IDLE_BANDS):
        chosen = lines[:, _BAND == at].reshape(-1, channels)
        found[at] = 2 * np.real(chosen.conj().T @ chosen) / len(windows)
    return found


# --- `train idle`: fit the small motion that a trained listener lacks at rest, and write it to its folder --------

SHOWN: Final = 8  # number of channels, those that move most, in the figures


def train_idle(name: str, data: Path, clips: int, seed: int) -> dict[str, Any]:
    """Roll the listener out over `clips` training dyads with their events, and write the idle motion that it lacks.

    Idle motion of an earlier run is not used. Raises ConfigError for a listener without events, data without events,
    and faces that never rest. Blocks for about a minute.
    """
    one_thread()
    folder = find("listeners", name, "config.yaml")
    settings = load_config(folder)
    if not settings.events:
        raise ConfigError(
            f"{folder}: expected a listener with events; without them rest and events cannot be separated"
        )
    chosen = [*streamable(data, "train", most=clips)]
    if not chosen or any(dyad.events is None for dyad in chosen):
        raise ConfigError(
            f"{data}: expected dyads with events of listeners; without blinks and smiles rest cannot be found"
        )
    how = load_folder(folder)
    shown = rollouts(how, chosen, seed, f"{name} listens")
    theirs, ours = (
        [resting(motion, dyad.events or (), dyad.agent_audio) for motion, dyad in zip(motions, chosen, strict=True)]
        for motions in ([dyad.listener for dyad in chosen], [motion for motion, _ in shown])
    )
    try:
        idle = fit_idle(theirs, ours)
    except ValueError as error:
        raise ConfigError(f"{data}: {error}") from None
    idle.save(folder / FILE)
    added = np.sqrt((idle.loadings.astype(np.float64) ** 2).sum(0))  # deviation of every channel
    return {
        "out": str(folder / FILE),
        "dyads": len(chosen),
        "patterns": len(idle.loadings),
        "spread": round(idle.spread, 3),
        "deviation": {BLENDSHAPES[at]: round(float(added[at]), 4) for at in np.argsort(-added)[:SHOWN]},
    }
