"""Many dyads as a few long tensors, from which windows are cut without crossing from one dyad into the next.

Each family of listeners has its own frames: a dataclass of tensors (N, ...), see `learning.sfms.features` and
`learning.arig.features`. Only this module has the borders between dyads, so every statistic that compares a frame with
its neighbour uses `Corpus.steps`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from sfms_robot import config
from sfms_robot.config.listener import GAZE_CHANNELS
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, FRAME_HZ, Doubles, Floats, ListenerEvent
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import usable
from sfms_robot.lab.learning.job import ALONE, Run
from sfms_robot.lab.learning.training_loop import write_whole
from sfms_robot.listeners.idle import BANDS, BANDS_HZ, LATERAL, among_head, head_channels
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS, control_track

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from sfms_robot.listeners.arig.model import ArigModel
    from sfms_robot.listeners.sfms.model import SfmsModel

AnyTraining = config.Training | config.ArigTraining
Frames = TypeVar("Frames", bound="DataclassInstance")

GAZE = [CHANNEL_INDEX[name] for name in GAZE_CHANNELS]
# Columns of control rows that are above 0 while an event other than a blink is under way.
ACTIVE = [at for at, name in enumerate(COLUMNS) if name.endswith(".active") and name != "blink.active"]
SOUND_SAMPLE = 20_000  # frames whose sound gives means and deviations
LEAST_SOUND_SPREAD = 1e-3

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Corpus(Generic[Frames]):
    """N frames of all dyads, one after another.

    Attributes:
        frames: tensors (N, ...).
        lengths: frames of each dyad.
        scenes: the kind of conversation of each dyad.
        staged: device to which windows are sent, if the frames lie on disk. None: frames in memory.
    """

    frames: Frames
    lengths: tuple[int, ...]
    scenes: tuple[str, ...]
    staged: torch.device | None = None

    @cached_property
    def begins(self) -> Tensor:
        """Return (N,) bool, True in the first frame of a dyad."""
        firsts = torch.zeros(sum(self.lengths), dtype=torch.bool)
        firsts[torch.tensor([0, *self.lengths[:-1]]).cumsum(0)] = True
        return firsts.to(next(iter(vars(self.frames).values())).device)

    def by_dyad(self, values: Tensor) -> list[Tensor]:
        """Split values (N, ...) of all frames into those of each dyad."""
        return list(torch.split(values, list(self.lengths)))

    def steps(self, values: Tensor) -> Tensor:
        """Return the differences (N - dyads, C) of values (N, C) from each frame to the next of the same dyad."""
        return torch.cat([dyad.diff(dim=0) for dyad in self.by_dyad(values)])

    def starts(self, window: int) -> Tensor:
        """Return the first frame of every window that lies in one dyad."""
        return first_frames(self.lengths, window)

    def starts_by_scene(self, window: int) -> dict[str, Tensor]:
        """Return `starts` by scene; scenes without any are left out."""
        starts = self.starts(window)
        scene = np.repeat(np.array(self.scenes), self.lengths)[starts.numpy()]
        return {name: starts[torch.from_numpy(scene == name)] for name in dict.fromkeys(scene.tolist())}

    def cut(self, starts: Tensor, window: int) -> Frames:
        """Return the windows (B, window, ...) at (B,) starts, on the device set by `to`; the starts are on the CPU."""
        to = self.staged or self.begins.device
        if self.staged is None:
            starts = starts.to(to, non_blocking=True)

        def sent(part: Tensor) -> Tensor:
            found = windows(part, starts, window)
            # Only from pinned memory can a window be sent while the next one is read.
            return (found.pin_memory() if found.device != to else found).to(to, non_blocking=True)

        return _each(self.frames, sent)

    def to(self, device: torch.device) -> Corpus[Frames]:
        """Return the same frames on another device; staged ones stay on disk."""
        if self.staged:
            return replace(self, staged=device)
        return replace(self, frames=_each(self.frames, lambda part: part.to(device)))

    def fingerprint(self) -> Figures:
        """Return plain data that differ between corpora. The corpus must be on the CPU."""
        digest = hashlib.blake2b(repr((self.lengths, self.scenes)).encode(), digest_size=8)
        for tensor in vars(self.frames).values():
            digest.update(tensor.contiguous().numpy().data)
        return {"dyads": len(self.lengths), "frames": sum(self.lengths), "digest": digest.hexdigest()}

    def identity(self, settings: AnyTraining, name: str, phase: config.Phase) -> Figures:
        """Return the `Job.identity` of a phase that learns from these frames. The corpus must be on the CPU."""
        return {
            "seed": settings.seed,
            "listener": settings.listener.model_dump(mode="json"),
            name: phase.identity(),
            "data": self.fingerprint(),
        }


def _each(frames: Frames, change: Callable[[Tensor], Tensor]) -> Frames:
    return replace(frames, **{name: change(tensor) for name, tensor in vars(frames).items()})


def gather(
    scenes: Mapping[str, Sequence[Dyad]],
    window: int,
    frames_of: Callable[[Dyad], Frames],
    run: Run = ALONE,
    split: str = "",
) -> Corpus[Frames]:
    """Stack dyads, read one at a time; those shorter than a window are left out and counted.

    With `run.scratch` they are stacked on disk, in its folder `split`: the first process of each machine writes them
    there, and the others wait.

    Raises ConfigError when no dyad is left, and the errors of `frames_of`.
    """
    folder = None if run.scratch is None else run.scratch / split
    if folder is not None and run.group.local_rank:
        run.group.wait()
        return read_staged(frames_of(next(iter(usable(next(iter(scenes.values())))))), folder)
    parts: list[Frames] = []
    lengths: list[int] = []
    named: list[str] = []
    short = 0
    for scene, dyads in scenes.items():
        for dyad in usable(dyads):
            if len(dyad.listener) < window:
                short += 1
                continue
            one = frames_of(dyad)
            if folder is None:
                parts.append(one)
            else:
                _stage(one, folder, first=not lengths)
            lengths.append(len(dyad.listener))
            named.append(scene)
    total = sum(map(len, scenes.values()))
    left_out = f"{short} are shorter than a window of {window} frames, {total - len(lengths) - short} cannot be read"
    if not lengths:
        raise ConfigError(f"none of {total} dyads can be used: {left_out}")
    if len(lengths) < total:
        log.warning("%d of %d dyads are used: %s", len(lengths), total, left_out)
    if folder is not None:
        with _writing(folder):
            (folder / _INDEX).write_text(json.dumps({"lengths": lengths, "scenes": named}), encoding="utf-8")
        run.group.wait()
        return read_staged(one, folder)
    joined = {name: torch.cat([vars(part)[name] for part in parts]) for name in vars(one)}
    return Corpus(replace(one, **joined), tuple(lengths), tuple(named))


def first_frames(lengths: Sequence[int], window: int, hop: int = 1) -> Tensor:
    """Return the first frames of the windows that lie within one of the dyads, which follow one another."""
    firsts, at = [torch.empty(0, dtype=torch.int64)], 0
    for length in lengths:
        firsts.append(torch.arange(at, max(at, at + length - window + 1), hop))
        at += length
    return torch.cat(firsts)


def windows(values: Tensor, starts: Tensor, length: int) -> Tensor:
    """Cut values (N, ...) at (B,) starts into (B, length, ...)."""
    starts = starts.to(values.device, non_blocking=values.is_cuda)
    return values[starts[:, None] + torch.arange(length, device=starts.device)]


def in_space(dyad: Dyad, motion: Floats, space: MotionSpace) -> Tensor:
    """Encode motion (N, D) of a dyad in the space, (N, C); rows that are not finite stay so.

    Raises ConfigError for a dyad in a space that cannot be converted to the wanted one.
    """
    if dyad.space == space.name:
        return torch.from_numpy(motion)
    if dyad.space != "arkit58":
        raise ConfigError(f"dyad {dyad.name} is in {dyad.space}, the listener in {space.name}: set motion_space to it")
    known = np.isfinite(motion).all(axis=1)
    out = np.full((len(motion), space.dim), np.nan, dtype=np.float32)
    out[known] = space.encode(motion[known])
    return torch.from_numpy(out)


def without_gaze(dyad: Dyad) -> Dyad:
    """Return the dyad without its gaze, for listeners with events (`config.ListenerSettings.events`).

    eyeLook* are 0, and the head's part of a gaze shift is removed from the pose, where it is known.
    Raises ConfigError for motion in another space than ours.
    """
    if dyad.space != "arkit58":
        raise ConfigError(f"dyad {dyad.name} is in {dyad.space}: gaze can be taken out of arkit58 alone")
    motion = dyad.listener.copy()
    motion[:, GAZE] = 0.0
    if dyad.head_of_gaze_rad is not None:
        motion[:, :3] -= dyad.head_of_gaze_rad
    return replace(dyad, listener=motion, head_of_gaze_rad=None)


def shared_frames(
    dyad: Dyad, space: MotionSpace, settings: config.Sfms | config.Arig | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the tensors that every family of listeners uses of a dyad of N frames.

    They are the speaker's face (N, C), 0 where unknown, and a mask (N,) of where it is known; the listener's motion
    (N, C), its sway (N, S), if that is not in the motion, and the control rows (N, K) of its events. Without sway or
    events, S or K is 0.

    `settings`: of the listener; None: one without events and sway. Raises ConfigError for a motion space that cannot be
    converted, and for a listener with events where the dyad has none, or not at our rate.
    """
    frames = len(dyad.listener)
    control, sway = torch.zeros(frames, 0), torch.zeros(frames, 0)
    if settings is not None and settings.events:
        if dyad.events is None:
            raise ConfigError(f"dyad {dyad.name}: expected events of its listener, which a listener with events needs")
        if dyad.fps != FRAME_HZ:
            raise ConfigError(
                f"dyad {dyad.name}: {dyad.fps:g} frames a second; a listener with events needs {FRAME_HZ}"
            )
        control, dyad = torch.from_numpy(control_track(dyad.events, 0, frames)), without_gaze(dyad)
    face, motion = in_space(dyad, dyad.speaker, space), in_space(dyad, dyad.listener, space)
    known = face.isfinite().all(-1)
    if settings is not None and settings.sway:
        head = head_channels(settings.channels)
        slow = torch.from_numpy(slow_part(motion[:, head].numpy(), dyad.events or ()))
        sway, motion = slow - torch.tensor(space.neutral, dtype=torch.float32)[head], motion.clone()
        motion[:, head] -= sway
    return torch.where(known[:, None], face, 0.0), known, motion, sway, control


def motion_scales(motion: Tensor, channels: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Return mean and deviation (C,) of motion (N, C).

    Deviations are clipped to a visible range: a still channel's noise is not amplified,
    and small movements of a channel that also makes large ones (a turning head) still count.
    """
    bounds = []  # least and largest deviation: blendshapes, rotations [rad], places [m]
    for name in channels:
        if name in BLENDSHAPES:
            bounds.append((0.04, 0.12))
        elif name in ("roll", "pitch", "yaw") or name.startswith(("rotation", "head", "jaw_")):
            bounds.append((0.01, 0.03))
        elif name.startswith("expression"):  # FLAME's components, in units of their own deviation
            bounds.append((0.1, 1e6))
        else:
            bounds.append((0.01, 0.01))
    least, most = torch.tensor(bounds).T
    return motion.mean(0), motion.std(0).clamp(min=least, max=most)


def fit_sound(model: SfmsModel | ArigModel, *tracks: tuple[Tensor, Tensor]) -> None:
    """Set the means and deviations of the sound of tracks: sound (N, ..., A) where it is heard (N,).

    A feature that hardly varies is not amplified. Without any sound the model's values are unchanged.
    """
    at = [heard.nonzero()[:, 0] for _, heard in tracks]
    total = sum(map(len, at))
    if not total:
        return
    step, some, before = max(1, total // SOUND_SAMPLE), [], 0
    for (sound, _), index in zip(tracks, at, strict=True):
        some.append(sound[index[-before % step :: step]])
        before += len(index)
    rows = torch.cat(some).float().flatten(0, -2)
    spread = rows.std(0)
    model.sound_mean.copy_(rows.mean(0))
    model.sound_std.copy_(spread.clamp(min=max(LEAST_SOUND_SPREAD, 0.2 * float(spread.median()))))


# --- Frames on disk --------------------------------------------------------------------------------------------------
#
# The processes of a machine share the system's file cache; the first process writes. A folder with frames of an earlier
# run is overwritten.

_INDEX = "index.json"


def _stage(frames: DataclassInstance, folder: Path, first: bool) -> None:
    """Append the tensors (N, ...) of one dyad to the files of a folder; `first`: replace their content."""
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, tensor in vars(frames).items():
            with (folder / f"{name}.frames").open("wb" if first else "ab") as opened:
                opened.write(tensor.contiguous().numpy().tobytes())


def read_staged(like: Frames, folder: Path) -> Corpus[Frames]:
    """Return the corpus whose frames lie in a folder, with the fields and types of `like`. Raises ConfigError."""
    try:
        index: Figures = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{folder}: the first process of this machine has staged no frames ({error})") from error
    rows, found = sum(index["lengths"]), {}
    for name, tensor in vars(like).items():
        shape = (rows, *tensor.shape[1:])
        flat, size = torch.zeros(0, dtype=tensor.dtype), math.prod(shape)
        if size:
            flat = torch.from_file(str(folder / f"{name}.frames"), shared=False, size=size, dtype=tensor.dtype)
        found[name] = flat.view(shape)
    return Corpus(replace(like, **found), tuple(index["lengths"]), tuple(index["scenes"]), torch.device("cpu"))


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigError(f"--scratch: {folder} cannot be written: {error.strerror or error}") from error


# --- Packs: all data that a trainer reads, in one file ---------------------------------------------------------------
#
# A safetensors file of tensors SPLIT.FIELD. Its metadata hold, as JSON, the version, the settings it was made for, and
# of each split the lengths and scenes of its dyads.

PACK_VERSION: Final = 1
_MADE_FOR: Final = ("kind", "motion_space", "neutral", "metres_per_unit", "sound", "audio", "phase", "events", "sway")


def _made_for(settings: AnyTraining) -> Figures:
    """Return the settings that frames depend on, as plain data."""
    windows = settings.training if isinstance(settings, config.ArigTraining) else settings.listener
    known = settings.listener.model_dump(mode="json")
    return {name: known.get(name) for name in _MADE_FOR} | {"window": windows.window_frames}


def write_pack(file: Path, corpora: Mapping[str, Corpus[Any]], settings: AnyTraining) -> None:
    """Write corpora by split to a file, which is replaced in one move. Raises ConfigError."""
    tensors = {
        f"{split}.{name}": tensor.contiguous()
        for split, corpus in corpora.items()
        for name, tensor in vars(corpus.frames).items()
    }
    about = {"version": PACK_VERSION, "made for": _made_for(settings)}
    about |= {split: [corpus.lengths, corpus.scenes] for split, corpus in corpora.items()}
    write_whole(file, tensors, {"pack": json.dumps(about)})


def training_data(
    data: Path,
    frames: type[Frames],
    settings: AnyTraining,
    read: Callable[[str], Corpus[Frames]],
) -> dict[str, Corpus[Frames]]:
    """Return the frames of train and validation: from the pack `data`, or read by `read` from a folder.

    Raises ConfigError.
    """
    splits = ("train", "validation")
    if not data.is_file():
        return {split: read(split) for split in splits}
    again = "pack again: sfms-robot train pack"
    try:
        with safe_open(data, framework="pt") as opened:
            about = json.loads((opened.metadata() or {})["pack"])
            if about["version"] != PACK_VERSION:
                raise ConfigError(f"{data}: version: expected {PACK_VERSION}, got {about['version']}; {again}")
            for key, ours in _made_for(settings).items():
                if (theirs := about["made for"].get(key)) != ours:
                    raise ConfigError(f"{data}: {key}: expected {ours!r}, got {theirs!r}; {again}")
            found = {}
            for split in splits:
                lengths, scenes = about[split]
                named = {field.name: opened.get_tensor(f"{split}.{field.name}") for field in fields(frames)}
                found[split] = Corpus(frames(**named), tuple(lengths), tuple(scenes))
            return found
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{data}: not a pack of training data ({error}); {again}") from error


# --- Slow motion of a head -------------------------------------------------------------------------------------------

CUT_HZ: Final = 1.0
HEAD_KINDS: Final = ("nod", "shake", "tilt")  # events that move the head
MARGIN_FRAMES: Final = 2  # around an event that may still belong to it
UNKNOWN: Final = 1e-4  # weight of a frame in which sway cannot be seen; below 0.1 Hz it still counts
LONGEST: Final = 2048  # most frames of a spectrum
ROUNDS: Final = 8  # most rounds of choosing between people and their mirror images


def slow_part(motion: Floats, events: Sequence[ListenerEvent]) -> Floats:
    """Return the slow part (N, S) of motion (N, S): below `CUT_HZ`, and smooth across the events that move the head.

    Whittaker's smoother, the z with the least sum of w |x - z|^2 + mu |second difference of z|^2. Frames of a nod have
    the small weight `UNKNOWN`, since sway cannot be seen in them: a low-pass alone would take the mean of a nod for
    sway, and give the nod a swing in the opposite direction before it begins.
    """
    from scipy.linalg import solveh_banded

    n = len(motion)
    if n < 3:
        return motion.copy()
    weight = np.ones(n)
    for event in events:
        if event.kind in HEAD_KINDS:
            first = int(np.floor(event.start_s * FRAME_HZ)) - MARGIN_FRAMES
            last = int(np.ceil(event.end_s * FRAME_HZ)) + MARGIN_FRAMES
            weight[max(0, first) : max(0, last)] = UNKNOWN
    mu = (2 * np.sin(np.pi * CUT_HZ / FRAME_HZ)) ** -4.0  # half of the motion passes at the cut
    bands = np.zeros((3, n))
    difference = (1.0, -2.0, 1.0)
    for a, left in enumerate(difference):
        for b, right in enumerate(difference[a:]):
            bands[b, a : n - 2 + a] += mu * left * right
    bands[0] += weight
    slow: Doubles = solveh_banded(bands, weight[:, None] * motion.astype(np.float64), lower=True)
    return slow.astype(np.float32)


def fit_sway(model: SfmsModel | ArigModel, slow: Sequence[Tensor]) -> None:
    """Set a model's sway by `sway_of` slow motion (N, S) of people."""
    mixture, spread = sway_of(slow, among_head(model.settings.channels, LATERAL))
    model.sway_mixture.copy_(mixture)
    model.sway_spread.copy_(spread)


def sway_of(slow: Sequence[Tensor], lateral: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
    """Return mixtures (BANDS, S, S) of `draw_sway` and spread () of sizes, fitted to slow motion (N, S) of people.

    Each person is scaled to the mean size before powers are computed; `spread` is the deviation of the sizes. Of a
    person and the mirror image, with `lateral` channels inverted, the one nearer to the other people is used.
    """
    tracks = [one.double() - one.double().mean(0) for one in slow if len(one) >= 2 * FRAME_HZ]
    if not tracks:
        raise ValueError("no motion of 2 s or more to fit sway on")
    sizes = torch.stack([track.square().mean(0).sqrt().clamp(min=1e-9).log() for track in tracks])  # (K, S)
    common = (sizes - sizes.mean(0)).mean(1)  # size of the whole head's motion
    spread = common.std(correction=0)
    powers = torch.stack(
        [band_powers(track / one.exp()) * len(track) for track, one in zip(tracks, common, strict=True)]
    )
    powers = _one_side(powers, lateral).sum(0) / sum(map(len, tracks))
    value, vector = torch.linalg.eigh(powers)
    root = vector * value.clamp(min=0).sqrt()[:, None] @ vector.mT  # symmetric
    return root.float(), spread.float()


def _one_side(powers: Tensor, lateral: Sequence[int]) -> Tensor:
    """Return powers (K, BANDS, S, S) of people or of their mirror images, whichever are more alike."""
    turned = torch.ones(powers.shape[-1], dtype=powers.dtype)
    turned[list(lateral)] = -1
    mirror = turned[:, None] * turned
    size = powers.sum((0, 1)).diagonal().clamp(min=1e-30).sqrt()
    alike = powers.sum(1) / size / size[:, None]  # (K, S, S), every channel with the same weight
    mirrored = torch.zeros(len(powers), 1, 1, dtype=torch.bool)
    for _ in range(ROUNDS):
        mean = torch.where(mirrored, alike * mirror, alike).sum(0)
        likeness = (alike * mean * (1 - mirror)).sum((1, 2))  # of the entries that a mirror changes
        before, mirrored = mirrored, (likeness < 0)[:, None, None]
        if torch.equal(before, mirrored):
            break
    return torch.where(mirrored[:, None], powers * mirror, powers)


def band_powers(track: Tensor) -> Tensor:
    """Return the co-spectrum (BANDS, S, S) of a track (N, S) by band of `BANDS_HZ`; the first has slower parts too."""
    from scipy import signal

    length, values = min(len(track), LONGEST), track.T.numpy()
    frequency_hz, density = signal.csd(values[:, None], values[None], FRAME_HZ, nperseg=length, detrend="constant")
    band = np.clip(np.searchsorted(BANDS_HZ, frequency_hz, side="right") - 1, 0, BANDS)
    powers = np.zeros((BANDS + 1, *density.shape[:2]))
    np.add.at(powers, band, np.moveaxis(density.real, -1, 0) * (frequency_hz[1] - frequency_hz[0]))
    return torch.from_numpy(powers[:BANDS])
