"""Dyads: a conversation from the view of one listener, as arrays; their files on disk; and the splits of our data."""

from __future__ import annotations

import pickle
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import (
    AUDIO_HZ,
    BLENDSHAPES,
    FRAME_HZ,
    MOTION_DIM,
    SPACE_CHANNELS,
    Doubles,
    Floats,
    ListenerEvent,
)
from sfms_robot.signals import mel as log_mel
from sfms_robot.signals.face_tables import SHAPES_OF_UNIT
from sfms_robot.signals.tracks import Take

# Facial action units (FACS: Ekman, Friesen and Hager 2002), one intensity for both sides of the face. Shapes without a
# unit stay 0, and units without a shape of their own are left out; `data check` and `data convert` report both.
# The 24 columns of `FAUValue` of Seamless Interaction. The data set does not document their order; this is the one
# that software written for it uses, and `lab.corpora.external.seamless` compares it with the key points of the files.
FAU_VALUE: Final = (1, 2, 4, 5, 6, 7, 9, 10, 12, 13, 14, 15, 16, 17, 18, 20, 22, 23, 24, 25, 26, 28, 30, 43)
FULL: Final = 2.0  # intensity at which its columns saturate; a blendshape of 1
# 23 (lip tightener) and 25 (lips part) have no shape of their own, 30 (jaw sideways) does not specify the side.
WITHOUT_SHAPE: Final = tuple(unit for unit in FAU_VALUE if unit not in SHAPES_OF_UNIT)
_SHOWN: Final = {shape for unit in FAU_VALUE for shape in SHAPES_OF_UNIT.get(unit, ())}
WITHOUT_UNIT: Final = tuple(shape for shape in BLENDSHAPES if shape not in _SHOWN)
# Channels of seamless27: rotation from the head at rest, axis-angle in FLAME's axes; intensities of action units.
SEAMLESS_CHANNELS: Final = (*(f"rotation_{axis}" for axis in "xyz"), *(f"AU{unit}" for unit in FAU_VALUE))
# Numbers per frame in every motion space of data: spaces that a listener can work in, and two that it cannot.
WIDTHS: Final[Mapping[str, int]] = {
    **{name: len(channels) for name, channels in SPACE_CHANNELS.items()},
    "deep3d73": 73,  # Deep3DFaceRecon: angle 3 | expression 64 | translation 3 | crop 3
    "seamless27": len(SEAMLESS_CHANNELS),
}
# Errors that reading a broken file may raise; numpy parses the headers of its files as Python literals.
UNREADABLE: Final = (
    OSError, ValueError, KeyError, IndexError, TypeError, EOFError, NotImplementedError, SyntaxError,
    tokenize.TokenError, pickle.UnpicklingError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
FEATURE: Final = "feature."  # key prefix on disk
_EVENT: Final = np.dtype(
    [(name, "f8") for name in ("start_s", "duration_s", "size")]
    + [("kind", "U16"), ("swings", "i4"), ("target_rad", "f8", 2)]
)
_VOICES: Final = ("audio", "agent_audio")
# Other optional arrays of a dyad: their type on disk, and their type once read.
_OPTIONAL: Final[Mapping[str, tuple[type, type]]] = {
    "states": (np.int8, np.int8),
    "mel": (np.float32, np.float32),
    "head_of_gaze_rad": (np.float16, np.float32),
    "attention": (np.float16, np.float32),
}
_Number = TypeVar("_Number", bound=np.generic)


@dataclass(frozen=True, kw_only=True)
class Dyad:
    """N frames of a speaker and of the listener. Sound is `audio`, or `mel`, or missing.

    Attributes:
        name: unique; contains the origin (meeting, listener).
        audio: (samples_of(N, fps),) speaker's voice, 16 kHz mono, or None if the data ship no waveform.
        speaker: (N, D) speaker's motion; a row of NaN where the face is not known.
        listener: (N, D) listener's motion, which is to be learned.
        listening: (N,) True where another person spoke in the last 2 s and the listener is silent.
        space: of both motions, a key of `WIDTHS`.
        fps: frames per second.
        mel: (4N, 128) natural log of the speaker's mel power, for data that ships this in place of a waveform.
        features: further arrays (N, F) about the frames, by name: "hubert", "attributes", ...
        agent_audio: (samples_of(N, fps),) the listener's own voice, or None if the data ship none.
        states: (N,) int8, the listener's conversational state, -1 where not known; None: not known anywhere.
        events: events of the listener, as `frames.ListenerEvent`, times from the first frame; None: not annotated.
        head_of_gaze_rad: (N, 3) roll, pitch, yaw: the part of `listener`'s pose that belongs to the gaze. For a
            listener with events, `signals.gaze_kinematics` computes it. None: not known separately.
        attention: (N,) 0..1, whether the speaker looks at the listener, NaN where not known; None: not known anywhere.
    """

    name: str
    audio: Floats | None
    speaker: Floats
    listener: Floats
    listening: NDArray[np.bool_]
    space: str = "arkit58"
    fps: float = float(FRAME_HZ)
    mel: Floats | None = None
    features: Mapping[str, Floats] = field(default_factory=dict)
    agent_audio: Floats | None = None
    states: NDArray[np.int8] | None = None
    events: tuple[ListenerEvent, ...] | None = None
    head_of_gaze_rad: Floats | None = None
    attention: Floats | None = None

    def __post_init__(self) -> None:
        if self.space not in WIDTHS:
            raise ValueError(f"{self.name}: motion space {self.space!r} is not known ({', '.join(WIDTHS)})")
        if not self.fps > 0:
            raise ValueError(f"{self.name}: fps {self.fps:g} must be above 0")
        frames = len(self.listener)
        sound, motion, each = (samples_of(frames, self.fps),), (frames, WIDTHS[self.space]), (frames,)
        expected: dict[str, tuple[int, ...]] = {
            "audio": sound,
            "speaker": motion,
            "listener": motion,
            "listening": each,
            "mel": (log_mel.ROWS_PER_FRAME * frames, log_mel.MEL_BINS),
            "agent_audio": sound,
            "states": each,
            "head_of_gaze_rad": (frames, 3),
            "attention": each,
        }
        for key, shape in expected.items():
            if (values := getattr(self, key)) is not None and values.shape != shape:
                raise ValueError(f"{self.name}: {key} has shape {values.shape}, expected {shape}")
        for key, rows in self.features.items():
            if rows.ndim != 2 or len(rows) != frames:
                raise ValueError(f"{self.name}: feature {key} has shape {rows.shape}, expected ({frames}, F)")
        for key in ("listener", "audio", "mel", "agent_audio"):
            values = getattr(self, key)
            if values is not None and not np.isfinite(values).all():
                raise ValueError(f"{self.name}: {key} must be finite")

    @property
    def voice(self) -> Floats | None:
        """Return the speaker's sound; None also for zeros, which mean a missing microphone, not a silent person."""
        return self.audio if self.audio is not None and self.audio.any() else None

    def mel_rows(self) -> Floats | None:
        """Return the natural log of mel power (4N, 128): `mel`, or made from `audio`; None without sound.

        At frame rates other than 25, each row is the latest of the 100 rows per second that is complete by its time.
        """
        if self.mel is not None or self.audio is None:
            return self.mel
        rows, _ = log_mel.log_mel(self.audio, log_mel.start())
        wanted = log_mel.ROWS_PER_FRAME * len(self.listener)
        return at_rate(rows, AUDIO_HZ / log_mel.HOP, wanted, log_mel.ROWS_PER_FRAME * self.fps)


def at_rate(rows: NDArray[_Number], rate_hz: float, wanted: int, wanted_hz: float) -> NDArray[_Number]:
    """Resample rows (M, ...) to (wanted, ...): for each time the latest row that is complete by then.

    Times before the first row is complete get the first row.
    """
    if rate_hz == wanted_hz:
        return rows[:wanted]
    newest = np.floor((np.arange(wanted) + 1) * rate_hz / wanted_hz + 1e-6).astype(int) - 1
    chosen: NDArray[_Number] = rows[newest.clip(0, len(rows) - 1)]
    return chosen


def samples_of(frames: int, fps: float) -> int:
    """Return the samples at 16 kHz in that many frames: 640 each at 25 fps."""
    return round(frames * AUDIO_HZ / fps)


def save(folder: Path, dyads: Sequence[Dyad]) -> None:
    """Write one NAME.npz per dyad: audio as int16, arkit58 motion as float16 (3 decimals are more than a servo shows).

    Motion in other spaces stays float32: as float16, angles near pi would be too coarse for a nod.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for dyad in dyads:
        kind = np.float16 if dyad.space == "arkit58" else np.float32
        arrays: dict[str, NDArray[np.generic]] = {
            "speaker": dyad.speaker.astype(kind),
            "listener": dyad.listener.astype(kind),
            "listening": dyad.listening,
        }
        for key in _VOICES:
            if (voice := getattr(dyad, key)) is not None:
                arrays[key] = np.round(voice * 32767).astype(np.int16)
        for key, (filed, _) in _OPTIONAL.items():
            if (values := getattr(dyad, key)) is not None:
                arrays[key] = values.astype(filed)
        if dyad.events is not None:
            none = (np.nan, np.nan)
            rows = [(e.start_s, e.duration_s, e.size, e.kind, e.swings, e.target_rad or none) for e in dyad.events]
            arrays["events"] = np.array(rows, _EVENT)  # without the random draws that decided them
        if (dyad.space, dyad.fps) != ("arkit58", FRAME_HZ):
            arrays |= {"space": np.array(dyad.space), "fps": np.array(dyad.fps)}
        arrays |= {FEATURE + name: rows for name, rows in dyad.features.items()}
        np.savez_compressed(folder / f"{dyad.name}.npz", **arrays)  # type: ignore[arg-type]


def read(file: Path) -> Dyad:
    """Return one dyad as `save` wrote it. Raises ConfigError."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            optional: dict[str, Any] = {
                key: arrays[key].astype(read) for key, (_, read) in _OPTIONAL.items() if key in arrays
            }
            voices = {key: arrays[key].astype(np.float32) / 32767 for key in _VOICES if key in arrays}
            if "space" in arrays:
                optional |= {"space": str(arrays["space"]), "fps": float(arrays["fps"])}
            if "events" in arrays:
                optional["events"] = tuple(
                    ListenerEvent(
                        kind,
                        start_s,
                        duration_s,
                        size,
                        swings,
                        None if np.isnan(target).any() else tuple(target.tolist()),
                    )
                    for start_s, duration_s, size, kind, swings, target in arrays["events"].astype(_EVENT).tolist()
                )
            return Dyad(
                name=file.stem,
                audio=voices.get("audio"),
                speaker=arrays["speaker"].astype(np.float32),
                listener=arrays["listener"].astype(np.float32),
                listening=arrays["listening"].astype(bool),
                features={key.removeprefix(FEATURE): arrays[key] for key in arrays if key.startswith(FEATURE)},
                agent_audio=voices.get("agent_audio"),
                **optional,
            )
    except UNREADABLE as error:
        raise ConfigError(f"{file}: not a dyad: {error}") from error


TAKE_STEP: Final = 2e-4  # resolution of whole takes on disk: a hundredth of what counts as stillness


def read_takes(file: Path) -> dict[str, list[Take]]:
    """Return whole recorded faces (`sim/listeners/takes.npz`) of the splits `train` and `held_out`.

    A take is kept as differences from frame to frame. Raises ConfigError for a file with other content.
    """
    found: dict[str, list[Take]] = {"train": [], "held_out": []}
    try:
        with np.load(file, allow_pickle=False) as arrays:
            for key, steps in arrays.items():
                split, name, _ = key.split("/")
                if steps.ndim != 2 or len(steps) != MOTION_DIM:
                    raise ValueError(f"{key} has shape {steps.shape}")
                found[split].append(Take(name, (steps.cumsum(axis=1).T * TAKE_STEP).astype(np.float32)))
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{file}: not a file of recorded takes: {error}") from error
    return found


# --- Splits: one table for composing, fitting and scoring -----------------------------------------------------------
#
# Meetings of a series share their people, so a whole series is in one split, and so is a whole recording of a voice or
# a face. The series were assigned by hand so that every split has people whose gaze was annotated, and meetings in
# which the form of nods was left blank. Voices of one person, or of people who talk in several recordings together, are
# in one split. Nothing is fitted, chosen or calibrated on test.

Split = Literal["train", "validation", "test"]
SPLITS: Final[tuple[Split, ...]] = ("train", "validation", "test")

SERIES: Final[Mapping[Split, tuple[str, ...]]] = {
    "train": ("ES2008", "IS1002", "IS1004", "IS1008", "IS1009", "TS3003"),
    "validation": ("IS1000", "IS1005", "TS3011"),
    "test": ("ES2003", "IS1001", "IS1006"),
}
# Recordings of voices, by the beginnings of their names; others are for training.
VOICES: Final[Mapping[Split, tuple[str, ...]]] = {
    "train": (
        "1114_2_01", "jfk", "audio_EN2001", "audio_EN2003", "audio_EN2004", "hvb_01cefd", "hvb_02e416", "hvb_03a17c",
        "lca_49",
    ),
    "validation": ("1114_3_15", "katie", "audio_EN2006", "hvb_a7ccc3", "hvb_eb82ec"),
    "test": ("1114_3_16", "steve", "audio_EN2005", "audio_EN2009", "audio_ES2003", "hvb_01f7ec"),
}  # fmt: skip
_Item = TypeVar("_Item")


def series(meeting: str) -> str:
    """Return the series of a meeting, whose meetings share their people: "IS1008c" -> "IS1008"."""
    return meeting.rstrip("abcdefgh")


def split_of(meeting: str) -> Split:
    """Return the split of a meeting; meetings of other series are for training."""
    return next((split for split in SPLITS if series(meeting) in SERIES[split]), "train")


def split_of_voice(name: str) -> Split:
    """Return the split of a recorded voice."""
    return next((split for split in SPLITS if name.startswith(VOICES[split])), "train")


def by_split(items: Iterable[tuple[Split, _Item]]) -> dict[Split, list[_Item]]:
    """Return items in their order, by split; every split is a key."""
    parts: dict[Split, list[_Item]] = {split: [] for split in SPLITS}
    for split, item in items:
        parts[split].append(item)
    return parts


def blendshapes_of(intensities: Floats | Doubles) -> Floats:
    """Return blendshapes (N, 52) within 0..1 of intensities (N, 24) in the order of `FAU_VALUE`."""
    out = np.zeros((len(intensities), len(BLENDSHAPES)), np.float32)
    for column, unit in enumerate(FAU_VALUE):
        for shape in SHAPES_OF_UNIT.get(unit, ()):
            out[:, BLENDSHAPES.index(shape)] = np.clip(intensities[:, column] / FULL, 0.0, 1.0)
    return out
