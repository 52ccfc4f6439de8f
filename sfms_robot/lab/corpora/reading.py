"""Arrays from files of other projects: headers first, and never code.

A pickle can run code. Those of data sets hold arrays and plain values, and only these are accepted.
"""

from __future__ import annotations

import csv
import gzip
import importlib
import io
import pickle
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, Floats
from sfms_robot.lab.corpora.clips import UNREADABLE, WIDTHS, Dyad, samples_of
from sfms_robot.lab.corpora.collection import ClipError, Kind
from sfms_robot.lab.evaluation.phrase_timing import listening_mask, voice_activity
from sfms_robot.signals.audio import read_audio

SOUND_SLACK_S: Final = 0.2  # sound may end this much before the face: containers round
FRAMES_SLACK: Final = 2  # two tracks of one clip may differ by this

# What numpy's arrays are rebuilt from, by the names of numpy 1 and 2; nothing here runs anything else.
_ARRAY_PARTS: Final = {
    (module, name)
    for part in ("numpy.core", "numpy._core")
    for module, name in (
        (f"{part}.multiarray", "_reconstruct"),
        (f"{part}.multiarray", "scalar"),
        (f"{part}.numeric", "_frombuffer"),
    )
} | {("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode"), ("collections", "OrderedDict")}


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ARRAY_PARTS:
            raise pickle.UnpicklingError(f"asks for {module}.{name}: only arrays and plain values are read")
        return getattr(_module(module), name)


def _module(name: str) -> Any:
    """Import one of numpy 1's modules by the name that it has in the installed numpy."""
    return importlib.import_module(name.replace("numpy.core", "numpy._core") if _NUMPY_2 else name)


_NUMPY_2: Final = int(np.__version__.split(".")[0]) >= 2


def unpickle(file: Path) -> Any:
    """Return arrays and plain values of a pickle. Raises UnpicklingError for one that asks for more, or is broken."""
    content = io.BytesIO(file.read_bytes())
    try:
        return _ArraysOnly(content).load()
    except (AttributeError, ImportError, OverflowError, MemoryError, AssertionError, *UNREADABLE) as error:
        raise pickle.UnpicklingError(str(error) or "broken") from error


def torch_load(file: Path) -> Any:
    """Return what torch saved: tensors, arrays and plain values, as `weights_only` allows.

    Raises ClipError for a file that needs more.
    """
    import torch

    arrays: list[Callable[..., Any] | tuple[Callable[..., Any], str]] = [
        (getattr(_module(module), name), f"{module}.{name}")
        for module, name in sorted(_ARRAY_PARTS)
        if _has(module, name)
    ]
    arrays += [type(np.dtype(kind)) for kind in ("f2", "f4", "f8", "i2", "i4", "i8", "u1", "?", "U1", "S1")]
    try:
        with torch.serialization.safe_globals(arrays), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # scrambled bytes look like a protocol of the future
            return torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        detail = "holds more than tensors, arrays and plain values; save it again with these alone"
        raise ClipError.of("unreadable", file, detail) from error
    except (RuntimeError, *UNREADABLE) as error:
        raise ClipError.of("unreadable", file, error) from error


def _has(module: str, name: str) -> bool:
    try:
        return hasattr(_module(module), name)
    except ImportError:
        return False


def present(problem: Kind, file: Path) -> None:
    """Raise ClipError, as this problem, for a file that does not exist."""
    if not file.is_file():
        raise ClipError.of(problem, file, "no such file")


def npy(file: Path) -> NDArray[Any]:
    """Map an array on disk into memory. Raises ClipError."""
    present("missing half", file)
    try:
        out: NDArray[Any] = np.load(file, mmap_mode="r", allow_pickle=False)
    except UNREADABLE as error:
        raise ClipError.of("unreadable", file, error) from error
    if not isinstance(out, np.ndarray):
        out.close()  # an archive of several
        raise ClipError.of("unreadable", file, "no array")
    if out.dtype.kind not in "fiu":
        raise ClipError.of("wrong dims", file, f"holds {out.dtype}, no numbers")
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
    """Return arrays of a .npz. Raises what `UNREADABLE` names."""
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
        raise ClipError.of("unreadable", file, error) from error
    return shapes


def frames_of(name: str, *tracks: tuple[int, ...], slack: int = FRAMES_SLACK) -> int:
    """Return the frames that tracks of these shapes share; singleton axes do not count. Raises ClipError."""
    lengths = [next((size for size in shape[:-1] if size != 1), 1) for shape in tracks]
    if max(lengths) - min(lengths) > slack:
        raise ClipError.of("lengths differ", name, f"{max(lengths)} frames beside {min(lengths)}")
    return min(lengths)


def track(name: str, values: NDArray[Any], frames: int, width: int, *, gaps: bool = False) -> Floats:
    """Return the first frames of a track (T, >= width) or with singleton axes, as (frames, width) float32.

    Raises ClipError for other shapes, and for values that are not finite unless `gaps` are allowed.
    """
    one_axis_of_time = values.ndim > 2 and sum(size != 1 for size in values.shape[:-1]) <= 1
    array = values.reshape(-1, values.shape[-1]) if one_axis_of_time else values
    if array.ndim != 2 or array.shape[1] != width or len(array) < frames:
        raise ClipError.of("wrong dims", name, f"shape {values.shape}, expected ({frames}, {width})")
    out = np.array(array[:frames], dtype=np.float32)
    bad = ~np.isfinite(out).all(axis=1)
    if bad.any() and not gaps:
        raise ClipError.of("not finite", name, f"{int(bad.sum())} of {frames} frames, first {int(bad.argmax())}")
    return out


def sound(file: Path, frames: int, fps: float) -> Floats:
    """Return a voice cut to the length of its face, or padded if it ends a little early. Raises ClipError."""
    present("missing sound", file)
    audio, wanted = read_audio(file), samples_of(frames, fps)
    if wanted - len(audio) > SOUND_SLACK_S * AUDIO_HZ:
        detail = f"{len(audio) / AUDIO_HZ:.2f} s of sound for {frames / fps:.2f} s of face"
        raise ClipError.of("lengths differ", file, detail)
    return np.pad(audio[:wanted], (0, max(0, wanted - len(audio))))


def voices_of(*files: Path) -> list[Path]:
    """Return the files of a clip's voices. Raises ClipError if the speaker's, the first, is missing."""
    present("missing sound", files[0])
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
    """Return a dyad of a data set without annotations: the two voices, where both are there, say who listens when.

    Without the listener's voice the listener listens all the time, as the role in the data says.

    Args:
        faces: Origin and rows (T, D) of the speaker, which may have gaps, and of the listener.
        voices: Files of the speaker's and the listener's voice; the second may be missing.
        own: Let the dyad carry the listener's voice.
    """
    speaker, listener = (
        track(str(origin), rows, frames, WIDTHS[space], gaps=gaps)
        for (origin, rows), gaps in zip(faces, (True, False), strict=True)
    )
    audio = sound(voices[0], frames, fps) if voices else None
    said = sound(voices[1], frames, fps) if voices and voices[1].is_file() else None
    listening = np.ones(frames, bool)
    if audio is not None and said is not None:
        listening = np.asarray(listening_mask(speaks(audio, frames, fps), fps, speaks(said, frames, fps)), bool)
    return Dyad(
        name=name, audio=audio, speaker=speaker, listener=listener, listening=listening, space=space, fps=fps, mel=mel,
        agent_audio=said if own else None,
    )  # fmt: skip


def speaks(voice: Floats, frames: int, fps: float) -> NDArray[np.bool_]:
    """Return (frames,) True in frames with speech; False after the end of the sound."""
    active = np.asarray(voice_activity(voice, AUDIO_HZ, 1 / fps), bool)[:frames]
    return np.pad(active, (0, frames - len(active)))


def numbers(values: Mapping[str, Any], key: str) -> NDArray[Any]:
    """Return an array or tensor of a dict. Raises KeyError, or TypeError for anything else."""
    found = values[key]
    array = np.asarray(found.numpy() if hasattr(found, "numpy") else found)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{key} holds no numbers")
    return array


def pose_last(values: NDArray[Any], pose_first: bool) -> NDArray[Any]:
    """Return channels with the six of the pose last, from files in which they stand first or already do."""
    return np.concatenate([values[..., 6:], values[..., :6]], axis=-1) if pose_first else values
