"""Dyads as a few long tensors, from which windows are cut without crossing from one dyad into the next."""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sfms_robot.corpora.clips import Dyad, at_rate
from sfms_robot.corpora.collection import usable
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, FRAME_SAMPLES, Floats
from sfms_robot.listeners.sfms.hearing import Hearing
from sfms_robot.listeners.sfms.model import SfmsModel, Tokenizer
from sfms_robot.listeners.sfms.predictor import UNDECIDED, Context
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals import mel
from sfms_robot.signals import phase as phases

STRETCH_WINDOWS = 10  # exact placement shares its keyframes among this many windows

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Corpus:
    """N frames of all dyads, one after another.

    Attributes:
        motion: (N, C) listener, in the motion space of the model.
        face: (N, C) speaker, likewise, 0 where unknown; face_known: (N,) bool.
        sound: (N, R, bins) half precision, features of the speaker's voice; heard: (N,) bool.
        phase: (N, F) where he is in a phrase.
        begins: (N,) bool, the first frame of a dyad.
        lengths: frames of each dyad.
    """

    motion: Tensor
    face: Tensor
    face_known: Tensor
    sound: Tensor
    heard: Tensor
    phase: Tensor
    begins: Tensor
    lengths: tuple[int, ...]

    def starts(self, window: int) -> Tensor:
        """First frames of every window that lies in one dyad."""
        return first_frames(self.lengths, window)

    def to(self, device: torch.device) -> Corpus:
        """The same frames on another device."""
        tensors = ("motion", "face", "face_known", "sound", "heard", "phase", "begins")
        return replace(self, **{name: getattr(self, name).to(device) for name in tensors})

    def fingerprint(self) -> dict[str, Any]:
        """What tells one corpus from another, as plain data. The corpus must be on the CPU."""
        digest = hashlib.blake2b(digest_size=8)
        for part in (self.motion, self.face, self.sound, self.heard, self.phase):
            digest.update(part.contiguous().numpy().data)
        return {"dyads": len(self.lengths), "frames": len(self.motion), "digest": digest.hexdigest()}


def gather(dyads: Sequence[Dyad], window: int, space: MotionSpace, hearing: Hearing | None = None) -> Corpus:
    """Stack dyads in one motion space, read one at a time; those shorter than a window are left out and counted.

    `hearing` says what is taken from the sound; None: nothing, and nobody is heard, which is enough for a tokenizer.
    Raises ConfigError when none is left, or one is in a space that cannot be turned into the wanted one.
    """
    listeners, faces, sound, phase = [], [], [], []
    short = 0
    for dyad in usable(dyads):
        if len(dyad.listener) < window:
            short += 1
        else:
            listeners.append(in_space(dyad, dyad.listener, space))
            faces.append(in_space(dyad, dyad.speaker, space))
            rows, place = _heard(dyad, hearing)
            sound.append(rows)
            phase.append(place)
    if not listeners:
        raise ConfigError(
            f"none of {len(dyads)} dyads can be used: {short} are shorter than a window of {window} frames, "
            f"{len(dyads) - short} cannot be read"
        )
    if len(listeners) < len(dyads):
        log.warning(
            "%d of %d dyads are used: %d are shorter than a window of %d frames, %d cannot be read",
            len(listeners), len(dyads), short, window, len(dyads) - len(listeners) - short,
        )  # fmt: skip
    face = torch.cat(faces)
    known = face.isfinite().all(-1)
    return Corpus(
        motion=torch.cat(listeners),
        face=torch.where(known[:, None], face, 0.0),
        face_known=known,
        sound=torch.cat(sound),
        heard=torch.cat([torch.full((len(rows),), bool(rows.any())) for rows in sound]),
        phase=torch.cat(phase),
        begins=torch.cat([torch.arange(len(listener)) == 0 for listener in listeners]),
        lengths=tuple(len(listener) for listener in listeners),
    )


def in_space(dyad: Dyad, motion: Floats, space: MotionSpace) -> Tensor:
    """(N, C); rows that are not finite stay so."""
    if dyad.space == space.name:
        return torch.from_numpy(motion)
    if dyad.space != "arkit58":
        raise ConfigError(f"dyad {dyad.name} is in {dyad.space}, the listener in {space.name}: set motion_space to it")
    known = np.isfinite(motion).all(axis=1)
    out = np.full((len(motion), space.dim), np.nan, dtype=np.float32)
    out[known] = space.encode(motion[known])
    return torch.from_numpy(out)


def _heard(dyad: Dyad, hearing: Hearing | None) -> tuple[Tensor, Tensor]:
    """Sound (N, R, bins) in half precision and phase (N, F): zeros without sound, which then nobody hears."""
    frames = len(dyad.listener)
    if hearing is None:
        return torch.zeros(frames, 0, 0, dtype=torch.half), torch.zeros(frames, 0)
    audio = dyad.audio if dyad.audio is not None and dyad.audio.any() else None  # zeros are no voice, not a still one
    found: Floats | None = dyad.features.get(hearing.audio)
    if found is None and hearing.audio == "mel" and (audio is not None or dyad.mel is not None):
        found = dyad.mel_rows()
    elif found is None and audio is not None:
        found = at_rate(hearing.rows(_whole(audio)), FRAME_HZ, frames, dyad.fps)
    phase = np.zeros((frames, hearing.phase_features), np.float32)
    if hearing.phased and audio is not None:
        phase = at_rate(phases.of_audio(_whole(audio)), FRAME_HZ, frames, dyad.fps)
    elif hearing.phased and dyad.mel is not None:
        rows = dyad.mel.reshape(frames, mel.ROWS_PER_FRAME, mel.MEL_BINS)
        ours = at_rate(rows, dyad.fps, math.ceil(frames * FRAME_HZ / dyad.fps), FRAME_HZ)  # phases count our frames
        phase = at_rate(phases.of_mel(ours), FRAME_HZ, frames, dyad.fps)
    sound = (
        torch.zeros(frames, *hearing.shape) if found is None else torch.from_numpy(found).view(frames, *hearing.shape)
    )
    return sound.half(), torch.from_numpy(phase)


def _whole(audio: Floats) -> Floats:
    """Samples up to a whole number of our frames, the last one ending in silence."""
    return np.pad(audio, (0, -len(audio) % FRAME_SAMPLES))


def fit_scales(model: SfmsModel, corpus: Corpus, channels: Sequence[str]) -> None:
    """Set the means, deviations and speeds of the model's motion.

    Deviations are kept between what an eye just sees and what nobody misses: a still channel's noise is not blown up,
    and small movements of a channel that also makes large ones (a turning head) still count.
    """
    least, most = spread_bounds(channels)
    model.motion_mean.copy_(corpus.motion.mean(0))
    model.motion_std.copy_(corpus.motion.std(0).clamp(min=least, max=most))
    steps = (corpus.motion.diff(dim=0) / model.motion_std).abs()
    model.motion_speed.copy_(
        torch.stack([one.sort().values[int(0.9995 * len(one))] for one in steps.T]).clamp(min=0.05)
    )


def fit_hearing(model: SfmsModel, corpus: Corpus) -> None:
    """Set the means and deviations of the sound, a bin that hardly moves not blown up; without any they stay."""
    rows = corpus.sound[corpus.heard]
    if len(rows):
        rows = rows[:: max(1, len(rows) // 20_000)].float().flatten(0, 1)
        model.sound_mean.copy_(rows.mean(0))
        spread = rows.std(0)
        model.sound_std.copy_(spread.clamp(min=0.2 * float(spread.median())))


def spread_bounds(channels: Sequence[str]) -> tuple[Tensor, Tensor]:
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


@torch.no_grad()
def place_all(tokenizer: Tokenizer, motion: Tensor, lengths: Sequence[int]) -> Tensor:
    """Keyframe masks (N, G) of all dyads, placed stretch by stretch so that busy seconds may borrow from quiet ones."""
    size = tokenizer.window * (STRETCH_WINDOWS if tokenizer.strategy == "exact" else 1)
    masks = []
    for dyad in torch.split(motion, list(lengths)):
        for stretch in torch.split(dyad, _stretches(len(dyad), size, tokenizer.window)):
            masks.append(tokenizer.place(stretch[None])[0])
    return torch.cat(masks)


def _stretches(frames: int, size: int, least: int) -> list[int]:
    """Lengths that add up to `frames`, none under `least` unless there is only one."""
    whole, rest = divmod(frames, size)
    sizes = [size] * whole
    if rest and (rest >= least or not sizes):
        sizes.append(rest)
    elif rest:
        sizes[-1] += rest
    return sizes


def first_frames(lengths: Sequence[int], window: int, hop: int = 1) -> Tensor:
    """First frames of the windows that lie in one dyad, dyads of those lengths one after another."""
    firsts, at = [torch.empty(0, dtype=torch.int64)], 0
    for length in lengths:
        firsts.append(torch.arange(at, max(at, at + length - window + 1), hop))
        at += length
    return torch.cat(firsts)


def windows(values: Tensor, starts: Tensor, length: int) -> Tensor:
    """(N, ...) cut at (B,) starts -> (B, length, ...)."""
    return values[starts[:, None] + torch.arange(length)]


def context(
    model: SfmsModel,
    corpus: Corpus,
    tokens: Tensor,
    starts: Tensor,
    past: int,
    future: int,
    louder: Tensor | None = None,
) -> Context:
    """What the predictor sees at the seam of each window; `tokens` (N, G), those of the future undecided.

    `louder` (B,): what is added to the sound before it is standardised, for features that are logarithms.
    """
    index = (starts[:, None] + torch.arange(-1, past)).clamp(min=0)  # one frame more: convolution looks back on it
    heard = corpus.heard[index]
    heard[:, 0] &= ~corpus.begins[starts]
    sound = corpus.sound[index].float()
    if louder is not None:
        sound = sound + louder.view(-1, 1, 1, 1)
    sound = torch.where(heard[..., None, None], model.standardise_sound(sound), 0.0)
    own = windows(tokens, starts, past)
    undecided = own.new_full((len(own), future, own.shape[2]), UNDECIDED)
    return Context(
        face=model.standardise(windows(corpus.face, starts, past)),
        face_known=windows(corpus.face_known, starts, past),
        voice=model.predictor.speaker.listen(sound.flatten(1, 2)),
        heard=heard[:, 1:],
        phase=windows(corpus.phase, starts, past),
        tokens=torch.cat([own, undecided], dim=1),
    )
