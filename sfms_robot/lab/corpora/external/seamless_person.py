"""One person of Seamless Interaction: three files in, his motion, his voice and when he speaks out."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import AUDIO_HZ, Floats
from sfms_robot.lab.corpora.action_units import FAU_VALUE
from sfms_robot.lab.corpora.clips import UNREADABLE, WIDTHS, samples_of
from sfms_robot.lab.corpora.collection import ClipError, guarded
from sfms_robot.lab.corpora.external import seamless_evidence as evidence
from sfms_robot.lab.corpora.reading import npz_shapes, track
from sfms_robot.lab.evaluation.phrase_timing import voice_activity
from sfms_robot.signals.audio import AudioFile, read_audio

FPS: Final = 30.0
SPACE: Final = "seamless27"  # rotation 3 | action units 24
PREFIXES: Final = ("movement_v4", "movement")  # the newer first: it replaces the other
ROTATION, UNITS, VALID = "alignment_head_rotation", "FAUValue", "is_valid"
KEYS: Final[Mapping[str, int]] = {ROTATION: 3, UNITS: len(FAU_VALUE), VALID: 1}
KEYPOINTS: Final = "boxes_and_keypoints:keypoints"
FILES: Final = (".npz", ".json", ".wav")
VAD: Final = "metadata:vad"
SLACK_S: Final = 0.5  # by which the ends of sound, face, annotation and partner may differ
LARGEST_LAG_S: Final = 0.25  # between a voice and what is annotated of it
_LAGS_S: Final = 2.0  # looked for
_LAG_GAIN: Final = 0.15  # by which another lag has to agree better


@dataclass(frozen=True)
class Person:
    """One person's part of an interaction, from headers and flags.

    Attributes:
        prefix: of his rows in the .npz.
        valid: (T,) whose rows hold something.
        speech_s: (start, end) of what he says.
    """

    name: str
    npz: Path
    wav: Path
    prefix: str
    valid: NDArray[np.bool_]
    speech_s: Sequence[tuple[float, float]]

    @property
    def seconds(self) -> float:
        return len(self.valid) / FPS

    def speaks(self, first: int, frames: int) -> NDArray[np.bool_]:
        """(frames,) from that frame on."""
        out = np.zeros(len(self.valid), bool)
        for start_s, end_s in self.speech_s:
            out[int(start_s * FPS) : int(np.ceil(end_s * FPS))] = True
        return out[first : first + frames]


def person_of(name: str, files: Mapping[str, Path]) -> Person:
    """From files by their ending. Raises ClipError for one that is missing, and for ends that do not fit together."""
    somewhere = next(iter(files.values()))
    for ending in FILES:
        if ending not in files:
            kind: Any = "missing sound" if ending == ".wav" else "missing half"
            raise ClipError.of(kind, somewhere.with_suffix(ending), "no such file")
    prefix = prefix_of(files[".npz"])
    valid = guarded(str(files[".npz"]), lambda: _flags(files[".npz"], prefix))
    person = Person(name, files[".npz"], files[".wav"], prefix, valid, _speech(files[".json"]))
    sound_s = guarded(str(person.wav), lambda: _sound_s(person.wav))
    if abs(sound_s - person.seconds) > SLACK_S:
        detail = f"{sound_s:.2f} s of sound for {person.seconds:.2f} s of face"
        raise ClipError.of("lengths differ", person.wav, detail)
    for index, (_, end_s) in enumerate(person.speech_s):
        if end_s > person.seconds + SLACK_S:
            detail = f"{VAD}[{index}] ends at {end_s:.2f} s, the interaction at {person.seconds:.2f} s"
            raise ClipError.of("time stamps", files[".json"], detail)
    return person


def _flags(file: Path, prefix: str) -> NDArray[np.bool_]:
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        flags: NDArray[np.bool_] = np.asarray(arrays[f"{prefix}:{VALID}"], np.float32).reshape(-1) > 0.5
    return flags


def prefix_of(file: Path) -> str:
    """The newest that has all that is needed. Raises ClipError naming what is missing."""
    shapes = npz_shapes(file)
    for prefix in PREFIXES:
        if any(f"{prefix}:{key}" not in shapes for key in KEYS):
            continue
        for key, width in KEYS.items():
            shape = shapes[f"{prefix}:{key}"]
            fits = len(shape) == 2 and shape[1] == width or len(shape) == width == 1
            if not fits or shape[0] != shapes[f"{prefix}:{ROTATION}"][0]:
                rows = shapes[f"{prefix}:{ROTATION}"][0] if shapes[f"{prefix}:{ROTATION}"] else "T"
                raise ClipError.of("wrong dims", file, f"{prefix}:{key} has shape {shape}, expected ({rows}, {width})")
        return prefix
    lacking = ", ".join(f"{PREFIXES[-1]}:{key}" for key in KEYS if f"{PREFIXES[-1]}:{key}" not in shapes)
    held = ", ".join(sorted({key.split(":")[0] for key in shapes})) or "nothing"
    raise ClipError.of("missing half", file, f"has no {lacking} (only {held}; only vendor V00 has movement)")


def _speech(file: Path) -> tuple[tuple[float, float], ...]:
    """When he speaks. Raises ClipError for what is no annotation, or goes back in time."""
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        spans = [(float(one["start"]), float(one["end"])) for one in told[VAD]]
    except (RecursionError, *UNREADABLE) as error:
        raise ClipError.of("unreadable", file, f"{VAD}: {type(error).__name__}: {error}") from error
    before = 0.0
    for index, (start_s, end_s) in enumerate(spans):
        if not 0.0 <= start_s <= end_s < np.inf:
            raise ClipError.of("time stamps", file, f"{VAD}[{index}] goes from {start_s:g} to {end_s:g} s")
        if start_s < before:
            raise ClipError.of("time stamps", file, f"{VAD}[{index}] begins at {start_s:g} s, before the one before it")
        before = start_s
    return tuple(spans)


def _sound_s(file: Path) -> float:
    sound = AudioFile(file)
    sound.close()
    return sound.length / AUDIO_HZ


def motion_of(person: Person, mirrored: bool) -> Floats:
    """(T, 27): rotation about the head at rest, action units; NaN where the face was not tracked."""
    from scipy.spatial.transform import Rotation

    frames, known = len(person.valid), person.valid.copy()
    rotation, units = (_rows(person, key, frames) for key in (ROTATION, UNITS))
    known &= np.isfinite(rotation).all(axis=1) & np.isfinite(units).all(axis=1) & units.any(axis=1)
    out = np.full((frames, WIDTHS[SPACE]), np.nan, np.float32)
    if known.any():
        vectors = rotation[known].astype(np.float64) * ((1, -1, -1) if mirrored else (1, 1, 1))
        rest = Rotation.from_rotvec(np.median(vectors, axis=0))
        out[known, :3] = (rest.inv() * Rotation.from_rotvec(vectors)).as_rotvec()
        out[known, 3:] = units[known]
    return out


def _rows(person: Person, key: str, frames: int) -> Floats:
    where = f"{person.prefix}:{key}"
    with person.npz.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        return track(f"{person.npz} {where}", arrays[where], frames, KEYS[key], gaps=True)


def voice_of(person: Person, first: int, frames: int) -> Floats:
    """Mono 16 kHz, from that frame on; silence where it ends a little early."""
    start, wanted = samples_of(first, FPS), samples_of(frames, FPS)
    heard = read_audio(person.wav)[start : start + wanted]
    return np.pad(heard, (0, wanted - len(heard)))


def lag_s(active: NDArray[np.bool_], voice: Floats) -> float:
    """By how much a voice comes after what is annotated of it, (N,) at 30 Hz; 0 where it cannot be told."""
    heard = np.asarray(voice_activity(voice, AUDIO_HZ, 1 / FPS), bool)
    told = np.pad(active, (0, max(0, len(heard) - len(active))))[: len(heard)]
    reach = int(_LAGS_S * FPS)
    if min(told.sum(), (~told).sum(), heard.sum(), (~heard).sum()) < reach or len(told) < 4 * reach:
        return 0.0

    def agreement(lag: int) -> float:
        ours = told[max(0, -lag) : len(told) - max(0, lag)]
        theirs = heard[max(0, lag) : len(heard) - max(0, -lag)]
        return float(np.mean(ours == theirs))

    lags = range(-reach, reach + 1)
    best = max(lags, key=lambda lag: (agreement(lag), -abs(lag)))
    return best / FPS if agreement(best) > agreement(0) + _LAG_GAIN else 0.0


def correlations(file: Path) -> dict[str, float] | None:
    """Of one .npz, between motion and key points; None where it has none, or too few. Raises as a broken file does."""
    prefix = prefix_of(file)
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        if KEYPOINTS not in arrays:
            return None
        rotation, units = (np.asarray(arrays[f"{prefix}:{key}"], np.float64) for key in (ROTATION, UNITS))
        valid = np.asarray(arrays[f"{prefix}:{VALID}"]).reshape(-1) > 0.5
        points = np.asarray(arrays[KEYPOINTS])
    if points.shape[1:] != (133, 3) or len(points) != len(valid):
        return None
    return evidence.correlations(rotation[valid], units[valid], points[valid])
