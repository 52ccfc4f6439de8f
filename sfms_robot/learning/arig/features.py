"""What ARIG is trained on, frame by frame: both people's sounds and motions, and the state of the conversation."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor

from sfms_robot.corpora.clips import Dyad as Conversation
from sfms_robot.corpora.collection import Dataset
from sfms_robot.corpora.conversational_states import UNKNOWN
from sfms_robot.corpora.formats import open_dataset
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Floats
from sfms_robot.learning import corpus as dyads
from sfms_robot.learning.corpus import Corpus, in_space, motion_scales, sound_scales
from sfms_robot.listeners.arig import audio_frontend
from sfms_robot.listeners.arig.diffusion import Denoiser
from sfms_robot.listeners.arig.model import ArigModel, Dyad
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals import mel, phase
from sfms_robot.signals.voice_activity import levels_db

SCENES: Final = ("speaking", "listening", "interaction")
LEAST_STEP: Final = 0.01  # of a frame, in deviations of the motion

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LabelledDyad(Dyad):
    """What the model takes, sound in half precision while it is kept, and states (..., N) int64, -1 unlabelled."""

    states: Tensor


ArigCorpus = Corpus[LabelledDyad]


def open_scenes(data: Path, split: str) -> dict[str, Dataset]:
    """The set in `data` is listening; data/speaking and data/interaction, where they are, the other two."""
    found = {"listening": open_dataset(data, split)}
    for scene in ("speaking", "interaction"):
        if any((data / scene).glob(f"{split}/*.npz")):
            found[scene] = open_dataset(data / scene, split)
        else:
            log.warning("%s: no %s, the curriculum goes on without it", data / scene, split)
    return found


def gather(scenes: Mapping[str, Sequence[Conversation]], window: int, space: MotionSpace, width: int) -> ArigCorpus:
    """`corpus.gather` in one motion space; `width` is that of the sound features."""
    return dyads.gather(scenes, window, partial(frames_of, space=space, width=width))


def cut(corpus: ArigCorpus, starts: Tensor, window: int) -> LabelledDyad:
    """Windows at (B,) starts as the model takes them."""
    found = corpus.cut(starts, window)
    return replace(found, user_sound=found.user_sound.float(), agent_sound=found.agent_sound.float())


def frames_of(dyad: Conversation, space: MotionSpace, width: int) -> LabelledDyad:
    """One conversation (N, ...). Raises ConfigError for a motion space or sound that does not fit."""
    frames = len(dyad.listener)
    face = in_space(dyad, dyad.speaker, space)
    seen = face.isfinite().all(-1)
    user, user_voiced, heard = _audio_features(dyad, "user", width)
    agent, agent_voiced, says = _audio_features(dyad, "agent", width)
    states = np.full(frames, UNKNOWN) if dyad.states is None else dyad.states
    return LabelledDyad(
        user_sound=user,
        user_heard=torch.full((frames,), heard),
        agent_sound=agent,
        agent_heard=torch.full((frames,), says),
        user_motion=torch.where(seen[:, None], face, 0.0),
        user_seen=seen,
        agent_motion=in_space(dyad, dyad.listener, space),
        voiced=torch.stack([agent_voiced, user_voiced], dim=-1),
        states=torch.from_numpy(states.astype(np.int64)),
    )


def _audio_features(dyad: Conversation, track: str, width: int) -> tuple[Tensor, Tensor, bool]:
    """Features (N, A) in half precision, speech (N,), and whether the track is there at all.

    A user's track of zeros is no microphone; an agent's is a robot that says nothing. wav2vec2 features come with the
    data, as features `wav2vec2` and `agent_wav2vec2`, and take the place of the mel rows.
    """
    frames = len(dyad.listener)
    audio = dyad.audio if track == "user" else dyad.agent_audio
    if track == "user" and audio is not None and not audio.any():
        audio = None
    shipped = dyad.features.get("wav2vec2" if track == "user" else "agent_wav2vec2")
    if width != audio_frontend.WIDTHS["mel"] and shipped is not None:
        rows = _beside_phase(shipped, audio)
        voiced = np.zeros(frames, bool) if audio is None else np.array(phase.hear(levels_db(audio)))
    elif width != audio_frontend.WIDTHS["mel"] and audio is not None:
        raise ConfigError(f"{dyad.name}: sound = wav2vec2 needs the feature wav2vec2, agent_wav2vec2 with the data")
    elif audio is not None and dyad.fps == FRAME_HZ:
        rows, voiced = audio_frontend.track(audio)
    elif track == "user" and dyad.mel is not None:
        rows, voiced = audio_frontend.of_mel(dyad.mel.reshape(frames, mel.ROWS_PER_FRAME, mel.MEL_BINS))
    else:
        return torch.zeros(frames, width, dtype=torch.half), torch.zeros(frames, dtype=torch.bool), False
    return torch.from_numpy(rows).half(), torch.from_numpy(voiced), True


def _beside_phase(rows: Floats, audio: Floats | None) -> Floats:
    place = np.zeros((len(rows), phase.FEATURES), np.float32) if audio is None else phase.of_audio(audio)
    return np.concatenate([rows, place], axis=1).astype(np.float32)


def fit_scales(model: ArigModel, corpus: ArigCorpus, channels: Sequence[str]) -> None:
    """Set means and deviations of motion and sound, and the range that the sampler keeps to."""
    frames = corpus.frames
    mean, spread = motion_scales(frames.agent_motion, channels)
    model.motion_mean.copy_(mean)
    model.motion_std.copy_(spread)
    standard = model.standardise(frames.agent_motion)
    model.motion_low.copy_(standard.amin(0))
    model.motion_high.copy_(standard.amax(0))
    steps = corpus.steps(standard)
    model.step_std.copy_(steps.std(0).clamp(min=LEAST_STEP))
    if isinstance(model.head, Denoiser):
        drawn = standard if model.settings.draws == "motion" else steps / model.step_std
        model.head.low.copy_(drawn.amin(0))
        model.head.high.copy_(drawn.amax(0))
    rows = torch.cat([frames.user_sound[frames.user_heard], frames.agent_sound[frames.agent_heard]])
    if len(rows):
        mean, spread = sound_scales(rows)
        model.sound_mean.copy_(mean)
        model.sound_std.copy_(spread)
