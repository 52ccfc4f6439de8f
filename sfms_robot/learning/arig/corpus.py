"""Both tracks of many dyads as a few long tensors, from which windows are cut that begin as a stream does."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from sfms_robot.corpora import clips
from sfms_robot.corpora.collection import Dataset, usable
from sfms_robot.corpora.formats import open_dataset
from sfms_robot.corpora.states import UNKNOWN
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Floats
from sfms_robot.learning.sfms.corpus import in_space, spread_bounds, windows
from sfms_robot.listeners.arig import sound
from sfms_robot.listeners.arig.diffusion import Denoiser
from sfms_robot.listeners.arig.model import ArigModel, Dyad
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals import mel, phase
from sfms_robot.signals.voice_activity import levels_db

SCENES: Final = ("speaking", "listening", "interaction")
LEAST_STEP: Final = 0.01  # of a frame, in deviations of the motion
_SAMPLE: Final = 20_000  # frames whose sound gives means and deviations

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Corpus:
    """N frames of all dyads, one after another: what `model.Dyad` holds, and more.

    Attributes:
        user_sound, agent_sound: (N, A) half precision; user_heard, agent_heard: (N,) bool.
        user_motion, agent_motion: (N, C); user_seen: (N,) bool.
        voiced: (N, 2) bool, speech of agent, user.
        states: (N,) int64, -1 where not labelled.
        lengths: frames of each dyad; scenes: which of `SCENES` each belongs to.
    """

    user_sound: Tensor
    user_heard: Tensor
    agent_sound: Tensor
    agent_heard: Tensor
    user_motion: Tensor
    user_seen: Tensor
    agent_motion: Tensor
    voiced: Tensor
    states: Tensor
    lengths: tuple[int, ...]
    scenes: tuple[str, ...]

    def starts(self, window: int) -> dict[str, Tensor]:
        """First frames of every window that lies in one dyad, by scene; scenes without any are left out."""
        found: dict[str, list[Tensor]] = {}
        at = 0
        for length, scene in zip(self.lengths, self.scenes, strict=True):
            if length >= window:
                found.setdefault(scene, []).append(torch.arange(at, at + length - window + 1))
            at += length
        return {scene: torch.cat(firsts) for scene, firsts in found.items()}

    def cut(self, starts: Tensor, window: int) -> tuple[Dyad, Tensor]:
        """Windows at (B,) starts as the model takes them, and their states (B, window)."""
        parts = {field.name: windows(getattr(self, field.name), starts, window) for field in fields(Dyad)}
        parts["user_sound"], parts["agent_sound"] = parts["user_sound"].float(), parts["agent_sound"].float()
        return Dyad(**parts), windows(self.states, starts, window)

    def to(self, device: torch.device) -> Corpus:
        """The same frames on another device."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), Tensor)}
        return replace(self, **{name: value.to(device) for name, value in tensors.items()})

    def fingerprint(self) -> dict[str, Any]:
        """What tells one corpus from another, as plain data. The corpus must be on the CPU."""
        digest = hashlib.blake2b(digest_size=8)
        for field in fields(self):
            value = getattr(self, field.name)
            digest.update(value.contiguous().numpy().data if isinstance(value, Tensor) else repr(value).encode())
        return {"dyads": len(self.lengths), "frames": sum(self.lengths), "digest": digest.hexdigest()}


def open_scenes(data: Path, split: str) -> dict[str, Dataset]:
    """The set in `data` is listening; data/speaking and data/interaction, where they are, the other two."""
    found = {"listening": open_dataset(data, split)}
    for scene in ("speaking", "interaction"):
        if any((data / scene).glob(f"{split}/*.npz")):
            found[scene] = open_dataset(data / scene, split)
        else:
            log.warning("%s: no %s, the curriculum goes on without it", data / scene, split)
    return found


def gather(scenes: Mapping[str, Sequence[clips.Dyad]], window: int, space: MotionSpace, width: int) -> Corpus:
    """Stack dyads that are as long as a window; `width` is that of the sound features.

    Raises ConfigError when none is left, or one is in a space that cannot be turned into the wanted one.
    """
    parts: dict[str, list[Tensor]] = {name: [] for name in (*(field.name for field in fields(Dyad)), "states")}
    lengths, named = [], []
    for scene, dyads in scenes.items():
        for dyad in usable(dyads):
            if len(dyad.listener) < window:
                continue
            for name, values in _tensors(dyad, space, width).items():
                parts[name].append(values)
            lengths.append(len(dyad.listener))
            named.append(scene)
    total = sum(len(dyads) for dyads in scenes.values())
    if not lengths:
        raise ConfigError(f"none of {total} dyads is as long as a window of {window} frames")
    if len(lengths) < total:
        log.warning("%d of %d dyads are learned from: the others are under %d frames or cannot be used",
                    len(lengths), total, window)  # fmt: skip
    return Corpus(
        **{name: torch.cat(each) for name, each in parts.items()}, lengths=tuple(lengths), scenes=tuple(named)
    )


def _tensors(dyad: clips.Dyad, space: MotionSpace, width: int) -> dict[str, Tensor]:
    frames = len(dyad.listener)
    face = in_space(dyad, dyad.speaker, space)
    seen = face.isfinite().all(-1)
    user, user_voiced, heard = _heard(dyad, "user", width)
    agent, agent_voiced, says = _heard(dyad, "agent", width)
    states = np.full(frames, UNKNOWN) if dyad.states is None else dyad.states
    return {
        "user_sound": user,
        "user_heard": torch.full((frames,), heard),
        "agent_sound": agent,
        "agent_heard": torch.full((frames,), says),
        "user_motion": torch.where(seen[:, None], face, 0.0),
        "user_seen": seen,
        "agent_motion": in_space(dyad, dyad.listener, space),
        "voiced": torch.stack([agent_voiced, user_voiced], dim=-1),
        "states": torch.from_numpy(states.astype(np.int64)),
    }


def _heard(dyad: clips.Dyad, track: str, width: int) -> tuple[Tensor, Tensor, bool]:
    """Features (N, A) in half precision, speech (N,), and whether the track is there at all.

    A user's track of zeros is no microphone; an agent's is a robot that says nothing. wav2vec2 features come with the
    data, as features `wav2vec2` and `agent_wav2vec2`, and take the place of the mel rows.
    """
    frames = len(dyad.listener)
    audio = dyad.audio if track == "user" else dyad.agent_audio
    if track == "user" and audio is not None and not audio.any():
        audio = None
    shipped = dyad.features.get("wav2vec2" if track == "user" else "agent_wav2vec2")
    if width != sound.WIDTHS["mel"] and shipped is not None:
        rows = _beside_phase(shipped, audio)
        voiced = np.zeros(frames, bool) if audio is None else np.array(phase.hear(levels_db(audio)))
    elif width != sound.WIDTHS["mel"] and audio is not None:
        raise ConfigError(f"{dyad.name}: sound = wav2vec2 needs the feature wav2vec2, agent_wav2vec2 with the data")
    elif audio is not None and dyad.fps == FRAME_HZ:
        rows, voiced = sound.track(audio)
    elif track == "user" and dyad.mel is not None:
        rows, voiced = sound.of_mel(dyad.mel.reshape(frames, mel.ROWS_PER_FRAME, mel.MEL_BINS))
    else:
        return torch.zeros(frames, width, dtype=torch.half), torch.zeros(frames, dtype=torch.bool), False
    return torch.from_numpy(rows).half(), torch.from_numpy(voiced), True


def _beside_phase(rows: Floats, audio: Floats | None) -> Floats:
    place = np.zeros((len(rows), phase.FEATURES), np.float32) if audio is None else phase.of_audio(audio)
    return np.concatenate([rows, place], axis=1).astype(np.float32)


def fit_scales(model: ArigModel, corpus: Corpus, channels: Sequence[str]) -> None:
    """Set means and deviations of motion and sound, and the range that the sampler keeps to."""
    least, most = spread_bounds(channels)
    motion = corpus.agent_motion
    model.motion_mean.copy_(motion.mean(0))
    model.motion_std.copy_(motion.std(0).clamp(min=least, max=most))
    standard = model.standardise(motion)
    model.motion_low.copy_(standard.amin(0))
    model.motion_high.copy_(standard.amax(0))
    steps = standard.diff(dim=0)
    last = torch.tensor(corpus.lengths).cumsum(0)[:-1] - 1
    steps[last] = 0.0  # from one dyad into the next
    model.step_std.copy_(steps.std(0).clamp(min=LEAST_STEP))
    if isinstance(model.head, Denoiser):
        drawn = standard if model.settings.draws == "motion" else steps / model.step_std
        model.head.low.copy_(drawn.amin(0))
        model.head.high.copy_(drawn.amax(0))
    rows = torch.cat([corpus.user_sound[corpus.user_heard], corpus.agent_sound[corpus.agent_heard]])
    if len(rows):
        rows = rows[:: max(1, len(rows) // _SAMPLE)].float()
        model.sound_mean.copy_(rows.mean(0))
        spread = rows.std(0)
        model.sound_std.copy_(spread.clamp(min=max(1e-3, 0.2 * float(spread.median()))))
