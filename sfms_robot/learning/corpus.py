"""Dyads as a few long tensors, from which windows are cut without crossing from one dyad into the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, FRAME_SAMPLES, Floats
from sfms_robot.learning.datasets.clips import Dyad
from sfms_robot.listeners.sfms.model import SfmsModel, Tokenizer
from sfms_robot.listeners.sfms.predictor import Context
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals import mel

STRETCH_WINDOWS = 10  # exact placement shares its keyframes among this many windows


@dataclass(frozen=True)
class Corpus:
    """N frames of all dyads, one after another.

    Attributes:
        motion: (N, C) listener, in the motion space of the model.
        face: (N, C) speaker, likewise, 0 where unknown; face_known: (N,) bool.
        mel: (N, 4, 128) half precision, natural log.
        heard: (N,) bool.
        lengths: frames of each dyad.
    """

    motion: Tensor
    face: Tensor
    face_known: Tensor
    mel: Tensor
    heard: Tensor
    lengths: tuple[int, ...]

    def starts(self, window: int) -> Tensor:
        """First frames of every window that lies in one dyad."""
        firsts, at = [], 0
        for length in self.lengths:
            firsts.append(torch.arange(at, at + length - window + 1))
            at += length
        return torch.cat(firsts)


def gather(dyads: Sequence[Dyad], window: int, space: MotionSpace) -> Corpus:
    """Stack dyads in one motion space; those shorter than a window are left out.

    Raises ConfigError when none is left, or one is in a space that cannot be turned into the wanted one.
    """
    kept = [dyad for dyad in dyads if len(dyad.listener) >= window]
    if not kept:
        raise ConfigError(f"none of {len(dyads)} dyads is as long as a window of {window} frames")
    face = torch.cat([_in_space(dyad, dyad.speaker, space) for dyad in kept])
    known = face.isfinite().all(-1)
    rows = [torch.from_numpy(mel.log_mel(dyad.audio, mel.start())[0]).half() for dyad in kept]
    return Corpus(
        motion=torch.cat([_in_space(dyad, dyad.listener, space) for dyad in kept]),
        face=torch.where(known[:, None], face, 0.0),
        face_known=known,
        mel=torch.cat(rows).view(-1, mel.ROWS_PER_FRAME, mel.MEL_BINS),
        heard=torch.cat([_heard(dyad) for dyad in kept]),
        lengths=tuple(len(dyad.listener) for dyad in kept),
    )


def _in_space(dyad: Dyad, motion: Floats, space: MotionSpace) -> Tensor:
    """(N, C); rows that are not finite stay so."""
    if dyad.space == space.name:
        return torch.from_numpy(motion)
    if dyad.space != "arkit58":
        raise ConfigError(f"dyad {dyad.name} is in {dyad.space}, the listener in {space.name}: set motion_space to it")
    known = np.isfinite(motion).all(axis=1)
    out = np.full((len(motion), space.dim), np.nan, dtype=np.float32)
    out[known] = space.encode(motion[known])
    return torch.from_numpy(out)


def _heard(dyad: Dyad) -> Tensor:
    """A dyad without any sound has no voice, rather than a silent one."""
    frames = len(dyad.audio) // FRAME_SAMPLES
    return torch.full((frames,), bool(dyad.audio.any()))


def fit_scales(model: SfmsModel, corpus: Corpus, channels: Sequence[str]) -> None:
    """Set the model's means, deviations and speeds.

    Deviations are kept between what an eye just sees and what nobody misses: a still channel's noise is not blown up,
    and small movements of a channel that also makes large ones (a turning head) still count.
    """
    least, most = _spread(channels)
    model.motion_mean.copy_(corpus.motion.mean(0))
    model.motion_std.copy_(corpus.motion.std(0).clamp(min=least, max=most))
    steps = (corpus.motion.diff(dim=0) / model.motion_std).abs()
    model.motion_speed.copy_(
        torch.stack([one.sort().values[int(0.9995 * len(one))] for one in steps.T]).clamp(min=0.05)
    )
    rows = corpus.mel[:: max(1, len(corpus.mel) // 20_000)].float().flatten(0, 1)
    model.mel_mean.copy_(rows.mean(0))
    model.mel_std.copy_(rows.std(0).clamp(min=0.5))


def _spread(channels: Sequence[str]) -> tuple[Tensor, Tensor]:
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


def windows(values: Tensor, starts: Tensor, length: int) -> Tensor:
    """(N, ...) cut at (B,) starts -> (B, length, ...)."""
    return values[starts[:, None] + torch.arange(length)]


def context(model: SfmsModel, corpus: Corpus, tokens: Tensor, starts: Tensor, past: int) -> Context:
    """What the predictor sees before the future of each window; `tokens` (N, G)."""
    sound = windows(corpus.mel, starts, past).float().flatten(1, 2)
    return Context(
        face=model.standardise(windows(corpus.face, starts, past)),
        face_known=windows(corpus.face_known, starts, past),
        mel=model.standardise_mel(sound),
        heard=windows(corpus.heard, starts, past),
        tokens=windows(tokens, starts, past),
    )
