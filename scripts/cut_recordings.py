"""Cut `motions.npz` and `takes.npz` from a folder of the recordings that SOURCE.md lists.

    python scripts/cut_recordings.py RECORDINGS

Primitives are neutral-calibrated and brought to 25 fps. Nothing is done to whole takes but resampling: resting faces
differ from person to person, and a tokenizer has to cope. Whole recordings are kept apart for validation and test.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, SHAPES, Floats
from sfms_robot.lab.corpora.clips import TAKE_STEP, Split
from sfms_robot.lab.corpora.collection import columns
from sfms_robot.lab.corpora.compose.motions import SHAPE, edges, slow
from sfms_robot.lab.corpora.compose.voices import at_25_hz, facegood_mouth
from sfms_robot.signals.motion_primitives import STEP
from sfms_robot.signals.tracks import Take, face_stretches, read_track, resample, stretches

CYCLE: Final = 24  # samples of one normalised nod

# Recordings of faces and heads that listeners and speakers are composed of, by name; others are for training.
TAKES: Final[Mapping[Split, tuple[str, ...]]] = {
    "train": (
        "yes1", "yes_sad1", "understanding1", "attentive1", "listening1", "no_excited1", "reprimand2", "thoughtful1",
        "serenity1", "S07-001", "d0", "d6", "d19", "1114_2_01",
    ),
    "validation": ("yes_excited1", "attentive2", "no_sad1", "apfel", "d3", "d12", "1114_3_15"),
    "test": ("understanding2", "listening2", "displeased2", "inquiring2", "facial", "d18", "1114_3_16"),
}  # fmt: skip
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


def _split(take: str) -> Split:
    return next((split for split, names in TAKES.items() if take in names), "train")


def save_primitives(file: Path, named: Iterable[tuple[str, str, Floats]]) -> None:
    """Write (kind, take, array) triples as `primitives` yields them, in steps of 0.001."""
    count: dict[str, int] = {}
    arrays: dict[str, NDArray[np.int16]] = {}
    for kind, take, array in named:
        stem = f"{_split(take)}/{kind}/{take}"
        count[stem] = count.get(stem, -1) + 1
        arrays[f"{stem}/{count[stem]}"] = np.round(array / STEP).astype(np.int16)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def primitives(data: Path) -> Iterator[tuple[str, str, Floats]]:
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


# --- recordings ---


def _reachy(file: Path) -> dict[str, Floats]:
    rows = columns(file)
    take = np.array(rows["recording"])
    times = np.array(rows["t_s"], np.float64)
    pose = np.deg2rad(
        np.stack([np.array(rows[f"head_{axis}_deg"], np.float32) for axis in ("roll", "pitch", "yaw")], axis=1)
    )
    return {str(name): at_25_hz(times[take == name], pose[take == name]) for name in np.unique(take)}


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


# --- cutting ---


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


# --- whole takes ---

_WHOLE: Final = {
    "livelinkface_alexdjulin": ("S07-001", "alex_rom_3", "facial"),
    "faces_mediapipe_liveportrait": ("d0", "d3", "d6", "d19"),
}
_WHOLE_HELD_OUT: Final = {"livelinkface_alexdjulin": ("apfel",), "faces_mediapipe_liveportrait": ("d12", "d18")}
_HALVED: Final = ("livelinkface_alexdjulin", "alex_rom_4")


def whole_takes(data: Path) -> Iterator[tuple[str, Take]]:
    """(split, take) from a folder of recordings. Raises ConfigError naming the file that is missing or broken."""
    for split, folders in (("train", _WHOLE), ("held_out", _WHOLE_HELD_OUT)):
        for folder, names in folders.items():
            for name in names:
                yield from ((split, take) for take in face_stretches(data / folder / f"{name}.csv.gz", name))
    folder, name = _HALVED
    motion = resample(read_track(data / folder / f"{name}.csv.gz"), FRAME_HZ).motion
    middle = len(motion) // 2
    yield from (("train", take) for take in stretches(motion[:middle], name))
    yield from (("held_out", take) for take in stretches(motion[middle:], name))


def save_takes(file: Path, takes: Iterable[tuple[str, Take]]) -> None:
    """Write (split, take) pairs as differences from frame to frame, which are small numbers."""
    arrays: dict[str, NDArray[np.int16]] = {}
    for split, take in takes:
        part = sum(key.startswith(f"{split}/{take.name}/") for key in arrays)
        whole = np.round(take.motion / TAKE_STEP).astype(np.int16)
        arrays[f"{split}/{take.name}/{part}"] = np.ascontiguousarray(np.diff(whole, axis=0, prepend=np.int16(0)).T)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    here, recordings = Path(__file__).parent, Path(sys.argv[1])
    save_primitives(here / "motions.npz", primitives(recordings))
    save_takes(here / "takes.npz", whole_takes(recordings))
