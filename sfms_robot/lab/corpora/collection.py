"""Data sets too big for memory: clips listed by name and length, read one at a time, and a list of problems.

Every layout of files on disk is one `Layout`. Its `scan` reads names and headers only, where the format allows it. A
clip that cannot be used is left out and listed by name as a `Problem`, never silently.

Arrays come from files of other projects: headers are read first, and code is never run. A pickle can run code. Those of
data sets hold arrays and plain values, and only these are accepted.
"""

from __future__ import annotations

import csv
import gzip
import importlib
import io
import logging
import pickle
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from sfms_robot.app.progress import tracked
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, Floats
from sfms_robot.lab.corpora.clips import UNREADABLE, WIDTHS, Dyad, samples_of
from sfms_robot.lab.corpora.phrase_timing import listening_mask, voice_activity
from sfms_robot.signals.audio import read_audio

_T = TypeVar("_T")
Order = Literal["exp-first", "pose-first"]
Kind = Literal[
    "missing half", "missing sound", "missing feature", "wrong dims", "lengths differ", "not finite", "too short",
    "unreadable", "swapped order", "time stamps",
]  # fmt: skip

OUR_NAMES: Final = {"val": "validation", "valid": "validation", "dev": "validation"}  # of splits, by other names
WITH_VAL: Final = {"train": "train", "validation": "val", "test": "test"}  # names in REACT and lm-listener, by ours
_NAMED: Final = 5  # most problems that a warning lists

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Problem:
    """Something that makes a clip, a file or a feature unusable."""

    kind: Kind
    where: str
    detail: str

    def __str__(self) -> str:
        return f"{self.where}: {self.detail}"


class ClipError(ConfigError):
    """One clip cannot be used; the others can."""

    def __init__(self, kind: Kind, where: Path | str, detail: object) -> None:
        first_line = str(detail).splitlines()[0] if str(detail) else type(detail).__name__
        self.problem = Problem(kind, str(where), first_line)
        super().__init__(str(self.problem))


@dataclass(frozen=True, kw_only=True)
class Clip:
    """One listener's clip: its name, frames, and how to read it.

    Attributes:
        read: Returns the dyad without features; raises ClipError or one of `UNREADABLE`.
        features: Readers of the other arrays (N, F) about the frames that the layout ships.
        row: Place in the layout's own list, before clips are left out (the row in REACT's appropriateness matrix).
            Set by `formats.scan_split`.
    """

    name: str
    frames: int
    read: Callable[[], Dyad]
    features: Mapping[str, Callable[[], Floats]] = field(default_factory=dict)
    row: int = 0


@dataclass(frozen=True, kw_only=True)
class Dataset(Sequence[Dyad]):
    """Dyads of one split, each read when it is accessed.

    Attributes:
        features: Names of the shipped features that each dyad has.
        problems: Clips and files that were left out, and why.
        notes: Lines of text for the user.
        licence: The licence stated by the data; None if they state none.
    """

    layout: str
    split: str
    space: str
    fps: float
    clips: tuple[Clip, ...]
    problems: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()
    features: tuple[str, ...] = ()
    licence: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(clip.name for clip in self.clips)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Return the number of frames of each clip."""
        return tuple(clip.frames for clip in self.clips)

    @property
    def minutes(self) -> float:
        return sum(self.lengths) / self.fps / 60

    def __len__(self) -> int:
        return len(self.clips)

    @overload
    def __getitem__(self, index: int) -> Dyad: ...

    @overload
    def __getitem__(self, index: slice) -> Dataset: ...

    def __getitem__(self, index: int | slice) -> Dyad | Dataset:
        """Return one dyad, read now, or a part of the set. Raises ClipError for a clip that cannot be used."""
        if isinstance(index, slice):
            return replace(self, clips=self.clips[index])
        clip = self.clips[index]
        dyad = guarded(clip.name, clip.read)
        if not self.features:
            return dyad
        shipped = {name: guarded(clip.name, clip.features[name]) for name in self.features if name in clip.features}
        if missing := [name for name in self.features if name not in shipped]:
            raise ClipError("missing feature", clip.name, f"has no {', '.join(missing)}")
        return guarded(clip.name, lambda: replace(dyad, features={**dyad.features, **shipped}))

    def map(self, change: Callable[[Dyad], Dyad], space: str | None = None) -> Dataset:
        """Return the same set with every dyad changed when it is read (smoothed, in another space, with features)."""

        def changed(clip: Clip) -> Clip:
            return replace(clip, read=lambda: change(guarded(clip.name, clip.read)))

        return replace(self, space=space or self.space, clips=tuple(changed(clip) for clip in self.clips))


def usable(dyads: Sequence[Dyad]) -> Iterator[Dyad]:
    """Yield every dyad that can be read; the others are counted and listed in one warning at the end."""
    left_out = []
    for index in tracked(range(len(dyads)), "reading dyads"):
        try:
            dyad = dyads[index]
        except ClipError as error:
            left_out.append(str(error))
        else:
            yield dyad
    if left_out:
        named = "; ".join(left_out[:_NAMED]) + ("; ..." if len(left_out) > _NAMED else "")
        log.warning("%d of %d clips cannot be used: %s", len(left_out), len(dyads), named)


def guarded(where: Path | str, read: Callable[[], _T]) -> _T:
    """Return the result of `read`; an error caused by a broken file becomes a ClipError."""
    try:
        return read()
    except ClipError:
        raise
    except (ConfigError, *UNREADABLE) as error:
        raise ClipError("unreadable", where, error) from error


Found = Clip | Problem | str  # str: a note for the user


def attempt(items: Iterable[_T], build: Callable[[_T], Clip]) -> Iterator[Found]:
    """Build the clip of every item; yield it, or the problem of an item that cannot be used."""
    for item in items:
        try:
            yield build(item)
        except ClipError as error:
            yield error.problem


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Layout of one family of data sets on disk.

    Attributes:
        space, fps: Motion space and frame rate of the motion.
        splits: Names of the splits in a folder, by ours (train, validation, test, ...); empty for another layout.
        scan: (root, their name of a split) -> clips, problems and notes. Reads headers only where the format allows
            it.
        below: Folders in which the data may lie, relative to the given one.
        order: Order of the channels in the files as they are shipped; None if there is only one.
        held_out: Share of train that serves as validation if the layout ships none.
        facts: (root, their name of a split) -> space, fps or licence where these differ from folder to folder.
    """

    name: str
    about: str
    space: str
    fps: float
    splits: Callable[[Path], Mapping[str, str]]
    scan: Callable[[Path, str], Iterable[Found]]
    below: tuple[str, ...] = ("", "data")
    order: Order | None = None
    held_out: float = 0.0
    licence: str | None = None
    facts: Callable[[Path, str], Mapping[str, Any]] = lambda place, split: {}

    def root(self, folder: Path) -> Path | None:
        """Return the folder that holds the data, the given one or one below it; None for another layout."""
        return next((place for name in self.below if self.splits(place := folder / name)), None)


# --- Arrays from files of other projects ------------------------------------------------------------------------------

SOUND_SLACK_S: Final = 0.2  # sound may end this much before the face, since containers round
FRAMES_SLACK: Final = 2  # two tracks of one clip may differ by this

# Names, in numpy 1 and 2, from which a pickle rebuilds arrays; none of these runs other code.
_ARRAY_PARTS: Final = {
    (module, name)
    for part in ("numpy.core", "numpy._core")
    for module, name in (
        (f"{part}.multiarray", "_reconstruct"),
        (f"{part}.multiarray", "scalar"),
        (f"{part}.numeric", "_frombuffer"),
    )
} | {("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode"), ("collections", "OrderedDict")}


_CORE: Final = "numpy.core" if np.__version__.startswith("1.") else "numpy._core"


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ARRAY_PARTS:
            raise pickle.UnpicklingError(f"asks for {module}.{name}: only arrays and plain values are read")
        return getattr(_module(module), name)


def _module(name: str) -> Any:
    """Import one of numpy's modules, whose names differ between numpy 1 and 2."""
    return importlib.import_module(re.sub(r"numpy\._?core", _CORE, name))


def unpickle(file: Path) -> Any:
    """Return arrays and plain values of a pickle. Raises UnpicklingError for one that needs more, or is broken."""
    content = io.BytesIO(file.read_bytes())
    try:
        return _ArraysOnly(content).load()
    except (AttributeError, ImportError, OverflowError, MemoryError, AssertionError, *UNREADABLE) as error:
        raise pickle.UnpicklingError(str(error) or "broken") from error


def torch_load(file: Path) -> Any:
    """Load a file saved by torch: tensors, arrays and plain values, as `weights_only` allows.

    Raises ClipError for a file that needs more.
    """
    import torch

    arrays: list[Any] = [(getattr(_module(module), name), f"{module}.{name}") for module, name in sorted(_ARRAY_PARTS)]
    arrays += [type(np.dtype(kind)) for kind in ("f2", "f4", "f8", "i2", "i4", "i8", "u1", "?", "U1", "S1")]
    try:
        with torch.serialization.safe_globals(arrays), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # broken bytes can look like a later pickle protocol
            return torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        detail = "holds more than tensors, arrays and plain values; save it again with these alone"
        raise ClipError("unreadable", file, detail) from error
    except (RuntimeError, *UNREADABLE) as error:
        raise ClipError("unreadable", file, error) from error


def existing(file: Path, kind: Kind = "missing half") -> Path:
    """Return the file if it exists. Raises ClipError of this kind."""
    if not file.is_file():
        raise ClipError(kind, file, "no such file")
    return file


def npy(file: Path) -> NDArray[Any]:
    """Map an array on disk into memory. Raises ClipError."""
    out: NDArray[Any] = guarded(file, lambda: np.load(existing(file), mmap_mode="r", allow_pickle=False))
    if not isinstance(out, np.ndarray):
        out.close()  # an archive of several arrays
        raise ClipError("unreadable", file, "no array")
    if out.dtype.kind not in "fiu":
        raise ClipError("wrong dims", file, f"holds {out.dtype}, no numbers")
    return out


def table(file: Path) -> list[list[str]]:
    """Return the rows of a CSV file, gzipped or not, with its header, without empty rows. Raises ConfigError."""
    try:
        with gzip.open(file, "rb") if file.suffix == ".gz" else file.open("rb") as stream:
            lines = io.TextIOWrapper(stream, encoding="utf-8-sig", newline="")
            return [row for row in csv.reader(lines) if row]
    except (OSError, EOFError, ValueError, csv.Error) as error:
        raise ConfigError(f"{file}: not a table: {error}") from error


def columns(file: Path) -> dict[str, list[str]]:
    """Return the columns of a CSV file by their names in the header. Raises ConfigError."""
    try:
        header, *rows = table(file)
        return dict(zip(header, map(list, zip(*rows, strict=True)) if rows else ([] for _ in header), strict=True))
    except ValueError as error:
        raise ConfigError(f"{file}: not a table: {error}") from error


def npz(file: Path, *keys: str) -> list[NDArray[Any]]:
    """Return arrays of a .npz. Raises one of `UNREADABLE`."""
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        return [arrays[key] for key in keys]


def npz_shapes(file: Path) -> dict[str, tuple[int, ...]]:
    """Read the shapes of the arrays of a .npz from their headers. Raises ClipError."""
    shapes = {}
    try:
        with zipfile.ZipFile(file) as archive:
            for member in archive.namelist():
                with archive.open(member) as stream:
                    version = np.lib.format.read_magic(stream)
                    header = (
                        np.lib.format.read_array_header_1_0
                        if version == (1, 0)
                        else np.lib.format.read_array_header_2_0
                    )
                    shapes[member.removesuffix(".npy")] = header(stream)[0]
    except UNREADABLE as error:
        raise ClipError("unreadable", file, error) from error
    return shapes


def frames_of(name: str, *tracks: tuple[int, ...], slack: int = FRAMES_SLACK) -> int:
    """Return the number of frames shared by tracks of these shapes, without singleton axes. Raises ClipError."""
    lengths = [next((size for size in shape[:-1] if size != 1), 1) for shape in tracks]
    if max(lengths) - min(lengths) > slack:
        raise ClipError("lengths differ", name, f"{max(lengths)} frames beside {min(lengths)}")
    return min(lengths)


def track(name: str, values: NDArray[Any], frames: int, width: int, *, gaps: bool = False) -> Floats:
    """Return the first frames of a track (T, width), perhaps with singleton axes, as (frames, width) float32.

    Raises ClipError for other shapes, and for values that are not finite unless `gaps` are allowed.
    """
    one_axis_of_time = values.ndim > 2 and sum(size != 1 for size in values.shape[:-1]) <= 1
    array = values.reshape(-1, values.shape[-1]) if one_axis_of_time else values
    if array.ndim != 2 or array.shape[1] != width or len(array) < frames:
        raise ClipError("wrong dims", name, f"shape {values.shape}, expected ({frames}, {width})")
    out = np.array(array[:frames], dtype=np.float32)
    bad = ~np.isfinite(out).all(axis=1)
    if bad.any() and not gaps:
        raise ClipError("not finite", name, f"{int(bad.sum())} of {frames} frames, first {int(bad.argmax())}")
    return out


def sound(file: Path, frames: int, fps: float) -> Floats:
    """Return a voice cut to the length of its face, or padded if it ends a little early. Raises ClipError."""
    audio, wanted = read_audio(existing(file, "missing sound")), samples_of(frames, fps)
    if wanted - len(audio) > SOUND_SLACK_S * AUDIO_HZ:
        detail = f"{len(audio) / AUDIO_HZ:.2f} s of sound for {frames / fps:.2f} s of face"
        raise ClipError("lengths differ", file, detail)
    return np.pad(audio[:wanted], (0, max(0, wanted - len(audio))))


def voices_of(*files: Path) -> list[Path]:
    """Return the files of a clip's voices. Raises ClipError if the speaker's, the first, is missing."""
    existing(files[0], "missing sound")
    return list(files)


def dyad_of(
    name: str,
    faces: Sequence[tuple[object, NDArray[Any]]],
    frames: int,
    space: str,
    fps: float,
    *,
    voices: Sequence[Path] = (),
    mel: Floats | None = None,
    own: bool = False,
) -> Dyad:
    """Return a dyad of a data set without annotations; its listening time is derived from the two voices.

    If either voice is missing, the listener listens all the time, which is its role in the data.

    Args:
        faces: Origin and rows (T, D) of the speaker, which may have gaps, and of the listener.
        voices: Files of the speaker's and the listener's voice; the second may be missing.
        own: Store the listener's voice in the dyad.
    """
    speaker, listener = (
        track(str(origin), rows, frames, WIDTHS[space], gaps=gaps)
        for (origin, rows), gaps in zip(faces, (True, False), strict=True)
    )
    audio = sound(voices[0], frames, fps) if voices else None
    said = sound(voices[1], frames, fps) if voices and voices[1].is_file() else None
    listening = np.ones(frames, bool)
    if audio is not None and said is not None:
        listening = listening_mask(speaks(audio, frames, fps), speaks(said, frames, fps), fps)
    return Dyad(
        name=name, audio=audio, speaker=speaker, listener=listener, listening=listening, space=space, fps=fps, mel=mel,
        agent_audio=said if own else None,
    )  # fmt: skip


def speaks(voice: Floats, frames: int, fps: float) -> NDArray[np.bool_]:
    """Return (frames,) True in frames with speech; False after the end of the sound."""
    active = voice_activity(voice, 1 / fps)[:frames]
    return np.pad(active, (0, frames - len(active)))


def numbers(values: Mapping[str, Any], key: str) -> NDArray[Any]:
    """Return an array or tensor of numbers in a dict. Raises KeyError, or TypeError for anything else."""
    found = values[key]
    array = np.asarray(found.numpy() if hasattr(found, "numpy") else found)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{key} holds no numbers")
    return array
