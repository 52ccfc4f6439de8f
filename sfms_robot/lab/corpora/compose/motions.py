"""Cuts motion primitives from recordings: pieces, neutral-calibrated and brought to 25 fps.

`build` cuts them from a folder of recordings and `save` writes them to `sim/listeners/motions.npz`, which
`signals.motion_primitives` describes and reads. Whole recordings are kept apart for validation and test
(`splits.TAKES`).
"""

from __future__ import annotations

import csv
import gzip
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, FRAME_S, SHAPES, SMILE_CORNERS, Floats, ListenerEvent
from sfms_robot.lab.corpora.splits import split_of_take
from sfms_robot.signals.motion_primitives import STEP
from sfms_robot.signals.tracks import read_track, resample

CYCLE: Final = 24  # samples of one normalised nod
SHAPE: Final = {name: index for index, name in enumerate(BLENDSHAPES)}

_LIVE_LINK: Final = ("S07-001", "facial", "apfel")
_NODS: Final = (
    "yes1", "yes_sad1", "understanding1", "understanding2", "attentive1", "listening1",
    "yes_excited1", "attentive2", "listening2",
)  # fmt: skip
_SHAKES: Final = ("no_excited1", "reprimand2", "no_sad1", "displeased2")
_SWAY: Final = ("listening1", "attentive1", "thoughtful1", "inquiring2", "serenity1", "listening2", "attentive2")
_TALKERS: Final = ("d6", "d3", "d18")
_SMILES: Final = ("S07-001", "facial", "d19", "d0", "d12", "d18")

_EYES: Final = tuple(name for name in BLENDSHAPES if name.startswith(("eyeLook", "eyeBlink", "eyeWide")))
_MOUTH: Final = tuple(name for name in BLENDSHAPES if name.startswith(("mouth", "jaw", "tongue")))
_SMILE_KIN: Final = (
    "mouthSmileLeft", "mouthSmileRight", "cheekSquintLeft", "cheekSquintRight", "eyeSquintLeft", "eyeSquintRight",
    "mouthDimpleLeft", "mouthDimpleRight", "mouthStretchLeft", "mouthStretchRight", "mouthUpperUpLeft",
    "mouthUpperUpRight", "noseSneerLeft", "noseSneerRight", "browOuterUpLeft", "browOuterUpRight", "browInnerUp",
    "jawOpen",
)  # fmt: skip
_BROW_KIN: Final = ("browInnerUp", "browOuterUpLeft", "browOuterUpRight", "eyeWideLeft", "eyeWideRight")

# ARKit channels of FACEGOOD's mouth controls, each with its weight: mouth_oh_c reaches 1 in ordinary speech. Where
# several controls feed a channel the largest counts.
FACEGOOD: Final = {
    "jawOpen": (("mouth_stretch_c", 1.0),),
    "jawLeft": (("jaw_sideways_l", 1.0),),
    "mouthFunnel": (("mouth_funnel_", 1.0),),
    "mouthPucker": (("mouth_oh_c", 0.5), ("mouth_pucker_", 1.0), ("mouth_oo_c", 1.0)),
    "mouthSmile": (("mouth_lipCornerPull_", 1.0), ("mouth_lipCornerPullOpen_", 1.0)),
    "mouthStretch": (("mouth_lipStretch_", 1.0),),
    "mouthDimple": (("mouth_dimple_", 1.0),),
    "mouthPress": (("mouth_press_", 1.0),),
    "mouthRollLower": (("mouth_suck_d", 1.0),),
    "mouthRollUpper": (("mouth_suck_u", 1.0),),
    "mouthLowerDown": (("mouth_lowerLipDepress_", 1.0),),
    "mouthUpperUp": (("mouth_upperLipRaise_", 1.0),),
}


def save(file: Path, named: Iterable[tuple[str, str, Floats]]) -> None:
    """Write (kind, take, array) triples as `build` yields them, in steps of 0.001."""
    count: dict[str, int] = {}
    arrays: dict[str, NDArray[np.int16]] = {}
    for kind, take, array in named:
        stem = f"{split_of_take(take)}/{kind}/{take}"
        count[stem] = count.get(stem, -1) + 1
        arrays[f"{stem}/{count[stem]}"] = np.round(array / STEP).astype(np.int16)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def build(data: Path) -> Iterator[tuple[str, str, Floats]]:
    """Cut every primitive from a folder of recordings. Yields (kind, take, array).

    Raises ConfigError naming the file that is missing or broken.
    """
    yield from _heads(data)
    yield from _faces(data)
    for take in ("1114_2_01", "1114_3_15", "1114_3_16"):
        mouth = facegood_mouth(data / "facegood_audio_mouth" / f"{take}.npz")
        yield "talk", take, mouth[: 40 * FRAME_HZ]


def _heads(data: Path) -> Iterator[tuple[str, str, Floats]]:
    poses = _reachy(data / "reachy2_recordings" / "head_and_antennas.csv.gz")
    poses |= {take: _mediapipe(data, take)[:, :3] for take in _TALKERS}
    for take in (*_NODS, "d6"):
        for cycle in cycles(poses[take][:, 1], FRAME_HZ):
            yield "nods", take, cycle
    for take in _SHAKES:
        for cycle in cycles(poses[take][:, 2], FRAME_HZ):
            yield "shakes", take, cycle
    for take in _SWAY:
        yield "sway", take, slow(poses[take])
    for take in _TALKERS:
        pose = _mediapipe(data, take)[:, :6]
        yield "heads", take, (pose - pose.mean(0)).astype(np.float32)


def _faces(data: Path) -> Iterator[tuple[str, str, Floats]]:
    for take in _LIVE_LINK:
        shapes = _live_link(data, take)
        onsets, curves = _blinks(shapes)
        yield "gaps", take, np.clip(np.diff(onsets) / FRAME_HZ, 0.4, 12).astype(np.float32)
        for curve in curves:
            yield "blinks", take, curve
        for curve in _bumps(shapes, _BROW_KIN, "browInnerUp", 0.05, (22, 60)):
            yield "brows", take, curve
        for stretch in _quiet(shapes):
            yield "idle", take, stretch
        rest = np.clip(shapes, 0, 1)
        rest[:, [SHAPE[name] for name in _MOUTH]] = 0
        yield "faces", take, rest
    for take in _SMILES:
        shapes = _live_link(data, take) if take in _LIVE_LINK else neutral(_mediapipe(data, take)[:, SHAPES], 10)
        for curve in _bumps(shapes, _SMILE_KIN, "mouthSmileLeft", 0.15, (30, 100)):
            yield "smiles", take, curve


# --- recordings -------------------------------------------------------------------------------------------------


def table(file: Path) -> dict[str, list[str]]:
    """Columns of a CSV file, gzipped or not. Raises ConfigError."""
    try:
        with gzip.open(file, "rt", newline="") if file.suffix == ".gz" else file.open(newline="") as lines:
            rows = csv.reader(lines)
            header = next(rows)
            columns = [list(column) for column in zip(*rows, strict=True)]
            return dict(zip(header, columns or [[] for _ in header], strict=True))
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file") from None
    except (OSError, ValueError, StopIteration) as error:
        raise ConfigError(f"{file}: not a table: {error or 'empty'}") from error


def facegood_mouth(file: Path) -> Floats:
    """Mouth weights of a FACEGOOD take -> (N, 52) at 25 fps. Raises ConfigError."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            weights, names, fps = arrays["weights"], arrays["names"], float(arrays["fps"])
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{file}: not a file of mouth weights: {error}") from error
    shapes = np.zeros((len(weights), len(BLENDSHAPES)), np.float32)
    for column, name in enumerate(str(name) for name in names):
        for channel, gain in _channels_of(name):
            shapes[:, SHAPE[channel]] = np.maximum(shapes[:, SHAPE[channel]], gain * weights[:, column])
    return at_frame_rate(np.arange(len(shapes)) / fps, np.clip(shapes, 0, 1))


def _channels_of(control: str) -> list[tuple[str, float]]:
    side = {"_l": "Left", "_r": "Right"}.get(control[-2:], "")
    found = []
    for channel, controls in FACEGOOD.items():
        name = channel if channel in SHAPE else channel + side
        found += [(name, gain) for prefix, gain in controls if name in SHAPE and control.startswith(prefix)]
    return found


def at_frame_rate(times_s: NDArray[np.floating], values: Floats) -> Floats:
    """Linear onto the 25 fps grid from times_s[0] on, (N, C)."""
    grid = np.arange(times_s[0], times_s[-1], 1 / FRAME_HZ)
    return np.stack([np.interp(grid, times_s, column) for column in values.T], axis=1).astype(np.float32)


def _reachy(file: Path) -> dict[str, Floats]:
    columns = table(file)
    take = np.array(columns["recording"])
    times = np.array(columns["t_s"], np.float64)
    pose = np.deg2rad(
        np.stack([np.array(columns[f"head_{axis}_deg"], np.float32) for axis in ("roll", "pitch", "yaw")], axis=1)
    )
    return {str(name): at_frame_rate(times[take == name], pose[take == name]) for name in np.unique(take)}


def _live_link(data: Path, take: str) -> Floats:
    track = resample(read_track(data / "livelinkface_alexdjulin" / f"{take}.csv.gz"), FRAME_HZ)
    return neutral(track.motion[:, SHAPES], 50)


def _mediapipe(data: Path, take: str) -> Floats:
    return resample(read_track(data / "faces_mediapipe_liveportrait" / f"{take}.csv.gz"), FRAME_HZ).motion


def neutral(shapes: Floats, percentile: float) -> Floats:
    """Blendshapes (N, 52) less the value each rests at. Rows that are NaN (face lost) hold the last known one."""
    known = np.isfinite(shapes).all(axis=1)
    index = np.maximum.accumulate(np.where(known, np.arange(len(shapes)), np.argmax(known)))
    held = shapes[index]
    return np.asarray(held - np.percentile(held, percentile, axis=0), np.float32)


# --- cutting ----------------------------------------------------------------------------------------------------


def slow(pose: Floats, cut_hz: float = 0.8) -> Floats:
    """The part of a head's motion below `cut_hz`, mean 0."""
    sos = signal.butter(2, cut_hz, fs=FRAME_HZ, output="sos")
    low = signal.sosfiltfilt(sos, pose - pose.mean(0), axis=0)
    return np.asarray(low - low.mean(0), np.float32)


def cycles(angle: NDArray[np.floating], rate_hz: float) -> list[Floats]:
    """Single swings (24,) of 0.25 to 0.9 s and at least 1.5 degrees, from rest over a peak back to rest."""
    sos = signal.butter(2, (0.7, 6), "bandpass", fs=rate_hz, output="sos")
    swing = signal.sosfiltfilt(sos, angle)
    troughs, _ = signal.find_peaks(-swing, prominence=np.deg2rad(0.7))
    found = []
    for start, end in zip(troughs[:-1], troughs[1:], strict=True):
        if not 0.25 <= (end - start) / rate_hz <= 0.9:
            continue
        piece = np.interp(np.linspace(start, end, CYCLE), np.arange(len(swing)), swing)
        piece = piece - np.linspace(piece[0], piece[-1], CYCLE)
        if np.ptp(piece) >= np.deg2rad(1.5) and piece.min() > -0.1 * piece.max():
            found.append((np.clip(piece, 0, None) / piece.max()).astype(np.float32))
    return found


def _blinks(shapes: Floats) -> tuple[NDArray[np.int64], list[Floats]]:
    """Peak frames of the blinks, and the curve (K, 52) of each that stands alone."""
    lids = [SHAPE["eyeBlinkLeft"], SHAPE["eyeBlinkRight"]]
    along = [*lids, SHAPE["eyeSquintLeft"], SHAPE["eyeSquintRight"]]
    closed = np.clip(shapes[:, lids].mean(axis=1), 0, 1)
    peaks, _ = signal.find_peaks(closed, height=0.3, distance=5)
    curves = []
    for peak in peaks:
        start, end = _extent(closed, peak, 0.03, 6)
        curve = np.zeros((end - start, len(BLENDSHAPES)), np.float32)
        curve[:, along] = np.clip(shapes[start:end, along], 0, 1)
        if 3 <= len(curve) <= 12 and curve[0, lids].max() < 0.15 and curve[-1, lids].max() < 0.15:
            curve[[0, -1]] = 0
            curves.append(np.clip(curve / closed[peak], 0, 1))
    return peaks, curves


def _extent(values: NDArray[np.floating], peak: int, floor: float, most: int) -> tuple[int, int]:
    """Slice around a peak down to `floor` on both sides, at most `most` frames each way."""
    start, end = peak, peak
    while start > 0 and peak - start < most and values[start] > floor:
        start -= 1
    while end < len(values) - 1 and end - peak < most and values[end] > floor:
        end += 1
    return start, end + 1


def _bumps(shapes: Floats, kin: Sequence[str], leader: str, height: float, length: tuple[int, int]) -> list[Floats]:
    """Rises of `leader` with its kin, onset to offset, (K, 52), leader's peak 1; speech is smoothed away."""
    index = [SHAPE[name] for name in kin]
    smooth = signal.sosfiltfilt(signal.butter(2, 2.5, fs=FRAME_HZ, output="sos"), shapes[:, index], axis=0)
    lead = smooth[:, kin.index(leader)]
    above = np.flatnonzero(np.diff(np.r_[0, lead > 0.25 * height, 0]))
    found = []
    for start, end in zip(above[::2], above[1::2], strict=True):
        left, right = max(0, start - 8), min(len(lead), end + 8)
        if lead[start:end].max() < height or not length[0] <= right - left <= length[1]:
            continue
        curve = np.zeros((right - left, len(BLENDSHAPES)), np.float32)
        curve[:, index] = np.clip(smooth[left:right], 0, None) * edges(right - left, 12)[:, None]
        found.append(np.clip(curve / curve[:, SHAPE[leader]].max(), 0, 1))
    return found


def _quiet(shapes: Floats) -> list[Floats]:
    """Stretches of at least 1.6 s in which the mouth rests, without eyes and without their mean."""
    busy = np.abs(shapes[:, [SHAPE["jawOpen"], SHAPE["mouthSmileLeft"], SHAPE["mouthPucker"]]]).max(axis=1) > 0.05
    busy = np.convolve(busy, np.ones(9), "same") > 0
    bounds = np.flatnonzero(np.diff(np.r_[1, busy, 1]))
    still = _without_blinks(shapes)
    still[:, [SHAPE[name] for name in _EYES]] = 0
    return [
        (still[start:end] - still[start:end].mean(axis=0)).astype(np.float32)
        for start, end in zip(bounds[::2], bounds[1::2], strict=True)
        if end - start >= 40
    ]


def _without_blinks(shapes: Floats) -> Floats:
    """Straight lines where the lids move: cheeks and brows move with them."""
    lids = shapes[:, [SHAPE["eyeBlinkLeft"], SHAPE["eyeBlinkRight"]]].max(axis=1)
    keep = np.flatnonzero(np.convolve(lids > 0.12, np.ones(11), "same") == 0)
    frames = np.arange(len(shapes))
    return np.stack([np.interp(frames, keep, column[keep]) for column in shapes.T], axis=1).astype(np.float32)


def edges(length: int, ramp: int) -> Floats:
    """1 in the middle, raised-cosine to 0 at both ends."""
    ramp = min(ramp, length // 2)
    up = 0.5 - 0.5 * np.cos(np.pi * np.arange(ramp) / max(ramp, 1))
    return np.concatenate([up, np.ones(length - 2 * ramp), up[::-1]]).astype(np.float32)


# --- Recorded curves joined to what is there: one after the other, stretched, held, laid on frames ----------------

FADE: Final = FRAME_HZ
SMILE: Final = [SHAPE[name] for name in SMILE_CORNERS]


def tiled(pieces: Sequence[Floats], frames: int, rng: np.random.Generator, fade: int = FADE) -> Floats:
    """Random pieces (K, C) one after the other, each crossfaded over `fade` frames, cut to (frames, C)."""
    usable = [piece for piece in pieces if len(piece) > 2 * fade] or [max(pieces, key=len)]
    fade = min(fade, min(len(piece) for piece in usable) // 2)
    total = frames + 2 * fade
    out = np.zeros((total, usable[0].shape[1]), np.float32)
    at = 0
    while at < total:
        piece = usable[rng.integers(len(usable))]
        piece = piece[int(rng.integers(0, max(1, (len(piece) - 2 * fade) // 2))) :]
        piece = piece * edges(len(piece), fade)[:, None]
        out[at : at + len(piece)] += piece[: total - at]
        at += len(piece) - fade
    return out[fade : fade + frames]


def stretched(curve: Floats, frames: int) -> Floats:
    """A curve (K,) or (K, C) played over `frames` frames."""
    at = np.linspace(0, len(curve) - 1, max(2, frames))
    if curve.ndim == 1:
        return np.interp(at, np.arange(len(curve)), curve).astype(np.float32)
    low = np.minimum(at.astype(int), len(curve) - 2)
    part = (at - low)[:, None]
    return np.asarray(curve[low] * (1 - part) + curve[low + 1] * part, np.float32)


def held(curve: Floats, frames: int) -> Floats:
    """A rise and fall (K, 52) that is seen (mouthSmile above half of its height) for about `frames` frames.

    Longer ones rest at their height, as long smiles do; shorter ones are played faster, to 0.6 of their length at most.
    """
    height = curve[:, SMILE].mean(axis=1)
    peak, seen = int(height.argmax()), int((height > 0.5 * height.max()).sum())
    if frames >= seen:
        return np.concatenate(
            [curve[:peak], np.repeat(curve[peak : peak + 1], frames - seen + 1, axis=0), curve[peak + 1 :]]
        )
    return stretched(curve, int(len(curve) * max(0.6, frames / seen)))


def first_frame(start_s: float) -> int:
    """The frame that something begins with."""
    return int(round(start_s * FRAME_HZ))


def placed(curve: Floats, start_s: float, frames: int) -> Floats:
    """Zeros (frames,) or (frames, C) with the curve from `start_s` on."""
    out = np.zeros((frames, *curve.shape[1:]), np.float32)
    first = first_frame(start_s)
    low, high = max(0, first), min(frames, first + len(curve))
    if high > low:
        out[low:high] = curve[low - first : high - first]
    return out


def laid_event(kind: str, start_s: float, curve: Floats, size: float) -> ListenerEvent:
    """Of a curve that was laid with `placed`."""
    return ListenerEvent(kind, first_frame(start_s) * FRAME_S, len(curve) * FRAME_S, float(size))


def pick(pieces: Sequence[Floats], rng: np.random.Generator) -> Floats:
    return pieces[int(rng.integers(len(pieces)))]


def over(below: Floats, above: Floats) -> Floats:
    """Two activations of the same muscles: sums while small, saturates at 1, smooth."""
    return np.asarray(below + above - np.clip(below, 0, 1) * np.clip(above, 0, 1), np.float32)
