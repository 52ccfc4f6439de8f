"""Many dyads as a few long tensors, from which windows are cut without crossing from one dyad into the next.

What a frame holds is the family's own: a dataclass of tensors (N, ...), see `learning.sfms.features` and
`learning.arig.features`. Where one dyad ends and the next begins is known here alone, so every statistic that compares
a frame with its neighbour asks `Corpus.steps`.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from sfms_robot.config.listener import GAZE_CHANNELS
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import usable
from sfms_robot.lab.learning.staged_frames import Scratch, StagedFrames, read_staged
from sfms_robot.listeners.space import MotionSpace

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Frames = TypeVar("Frames", bound="DataclassInstance")

GAZE = [CHANNEL_INDEX[name] for name in GAZE_CHANNELS]
SOUND_SAMPLE = 20_000  # frames whose sound gives means and deviations
LEAST_SOUND_SPREAD = 1e-3

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Corpus(Generic[Frames]):
    """N frames of all dyads, one after another.

    Attributes:
        frames: tensors (N, ...).
        lengths: frames of each dyad.
        scenes: the kind of conversation each dyad is of.
        staged: they lie on disk, and only what is cut out of them goes to another device.
    """

    frames: Frames
    lengths: tuple[int, ...]
    scenes: tuple[str, ...]
    staged: bool = False

    @cached_property
    def begins(self) -> Tensor:
        """(N,) bool, the first frame of a dyad."""
        firsts = torch.zeros(sum(self.lengths), dtype=torch.bool)
        firsts[torch.tensor([0, *self.lengths[:-1]]).cumsum(0)] = True
        return firsts.to(getattr(self.frames, fields(self.frames)[0].name).device)

    def steps(self, values: Tensor) -> Tensor:
        """Differences (N - dyads, C) of values (N, C) from each frame to the next of the same dyad."""
        return torch.cat([dyad.diff(dim=0) for dyad in torch.split(values, list(self.lengths))])

    def starts(self, window: int) -> Tensor:
        """First frames of every window that lies in one dyad."""
        return first_frames(self.lengths, window)

    def starts_by_scene(self, window: int) -> dict[str, Tensor]:
        """`starts`, those of each scene apart; scenes without any are left out."""
        starts = self.starts(window)
        scene = np.repeat(np.array(self.scenes), self.lengths)[starts.numpy()]
        return {name: starts[torch.from_numpy(scene == name)] for name in dict.fromkeys(scene.tolist())}

    def cut(self, starts: Tensor, window: int) -> Frames:
        """The windows (B, window, ...) at (B,) starts, on their device."""
        return _each(self.frames, lambda part: windows(part, starts.to(part.device), window).to(starts.device))

    def to(self, device: torch.device) -> Corpus[Frames]:
        """The same frames on another device; staged ones stay where they are."""
        if self.staged:
            return self
        return replace(self, frames=_each(self.frames, lambda part: part.to(device)))

    def fingerprint(self) -> dict[str, Any]:
        """Return plain data that differ between corpora. The corpus must be on the CPU."""
        digest = hashlib.blake2b(repr((self.lengths, self.scenes)).encode(), digest_size=8)
        for field in fields(self.frames):
            digest.update(getattr(self.frames, field.name).contiguous().numpy().data)
        return {"dyads": len(self.lengths), "frames": sum(self.lengths), "digest": digest.hexdigest()}


def _each(frames: Frames, change: Callable[[Tensor], Tensor]) -> Frames:
    return replace(frames, **{field.name: change(getattr(frames, field.name)) for field in fields(frames)})


def gather(
    scenes: Mapping[str, Sequence[Dyad]],
    window: int,
    frames_of: Callable[[Dyad], Frames],
    scratch: Scratch | None = None,
) -> Corpus[Frames]:
    """Stack dyads, read one at a time; those shorter than a window are left out and counted.

    `scratch`: on disk, where the first process of each machine stages them and the others wait.

    Raises ConfigError when none is left, and whatever `frames_of` raises.
    """
    if scratch is None or scratch.group.local_rank == 0:
        corpus = _read(scenes, window, frames_of, scratch)
    if scratch is None:
        return corpus
    scratch.group.wait()
    if scratch.group.local_rank == 0:
        return corpus
    like = frames_of(next(iter(usable(next(iter(scenes.values()))))))
    found, lengths, named = read_staged(scratch.folder)
    return Corpus(replace(like, **found), lengths, named, staged=True)


def _read(
    scenes: Mapping[str, Sequence[Dyad]], window: int, frames_of: Callable[[Dyad], Frames], scratch: Scratch | None
) -> Corpus[Frames]:
    parts: list[Frames] = []
    files = None if scratch is None else StagedFrames(scratch.folder)
    lengths: list[int] = []
    named: list[str] = []
    short = 0
    for scene, dyads in scenes.items():
        for dyad in usable(dyads):
            if len(dyad.listener) < window:
                short += 1
                continue
            one = frames_of(dyad)
            if files is None:
                parts.append(one)
            else:
                files.add(one)
                parts = [one]
            lengths.append(len(dyad.listener))
            named.append(scene)
    total = sum(len(dyads) for dyads in scenes.values())
    left_out = f"{short} are shorter than a window of {window} frames, {total - len(lengths) - short} cannot be read"
    if not lengths:
        raise ConfigError(f"none of {total} dyads can be used: {left_out}")
    if len(lengths) < total:
        log.warning("%d of %d dyads are used: %s", len(lengths), total, left_out)
    if files is not None and scratch is not None:
        files.close(lengths, named)
        found, _, _ = read_staged(scratch.folder)
        return Corpus(replace(parts[0], **found), tuple(lengths), tuple(named), staged=True)
    joined = {field.name: torch.cat([getattr(part, field.name) for part in parts]) for field in fields(parts[0])}
    return Corpus(replace(parts[0], **joined), tuple(lengths), tuple(named))


def first_frames(lengths: Sequence[int], window: int, hop: int = 1) -> Tensor:
    """First frames of the windows that lie in one dyad, dyads of those lengths one after another."""
    firsts, at = [torch.empty(0, dtype=torch.int64)], 0
    for length in lengths:
        firsts.append(torch.arange(at, max(at, at + length - window + 1), hop))
        at += length
    return torch.cat(firsts)


def windows(values: Tensor, starts: Tensor, length: int) -> Tensor:
    """(N, ...) cut at (B,) starts -> (B, length, ...)."""
    return values[starts[:, None] + torch.arange(length, device=starts.device)]


def in_space(dyad: Dyad, motion: Floats, space: MotionSpace) -> Tensor:
    """Motion (N, D) of a dyad -> (N, C) in the space; rows that are not finite stay so.

    Raises ConfigError for a dyad in a space that cannot be turned into the wanted one.
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
    """Return the dyad without its gaze, for listeners that get events (`config.ListenerSettings.events`): eyeLook* are
    0, and the head's part of a gaze shift is removed from the pose, where it is known.

    Raises ConfigError for motion in another space than ours.
    """
    if dyad.space != "arkit58":
        raise ConfigError(f"dyad {dyad.name} is in {dyad.space}: gaze can be taken out of arkit58 alone")
    motion = dyad.listener.copy()
    motion[:, GAZE] = 0.0
    if dyad.head_of_gaze_rad is not None:
        motion[:, :3] -= dyad.head_of_gaze_rad
    return replace(dyad, listener=motion, head_of_gaze_rad=None)


def motion_scales(motion: Tensor, channels: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Return mean and deviation (C,) of motion (N, C).

    Deviations are clipped to a visible range: a still channel's noise is not amplified,
    and small movements of a channel that also makes large ones (a turning head) still count.
    """
    least, most = _spread_bounds(channels)
    return motion.mean(0), motion.std(0).clamp(min=least, max=most)


def some_sound(*tracks: tuple[Tensor, Tensor]) -> Tensor:
    """Rows (M, ...) of sounds (N, ...) where they are heard (N,), as many as `sound_scales` looks at and as evenly."""
    at = [heard.nonzero()[:, 0] for _, heard in tracks]
    step = max(1, sum(map(len, at)) // SOUND_SAMPLE)
    found, before = [], 0
    for (sound, _), index in zip(tracks, at, strict=True):
        found.append(sound[index[-before % step :: step]])
        before += len(index)
    return torch.cat(found)


def sound_scales(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and deviation (A,) of sound features (M, ..., A), M > 0; a feature that hardly moves is not blown up."""
    some = rows[:: max(1, len(rows) // SOUND_SAMPLE)].float().flatten(0, -2)
    spread = some.std(0)
    return some.mean(0), spread.clamp(min=max(LEAST_SOUND_SPREAD, 0.2 * float(spread.median())))


def _spread_bounds(channels: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Least and largest deviation (C,) that a channel is divided by: blendshapes, rotations [rad], places [m]."""
    bounds = []
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
    return least, most
