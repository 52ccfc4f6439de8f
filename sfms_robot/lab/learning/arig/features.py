"""Training data of ARIG, frame by frame: both people's sounds and motions, and the state of the conversation."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.config.listener import STATES
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, LATERAL_POSE, Floats
from sfms_robot.lab.corpora.clips import Dyad as Conversation
from sfms_robot.lab.corpora.collection import Dataset
from sfms_robot.lab.corpora.conversational_states import UNKNOWN
from sfms_robot.lab.corpora.formats import open_dataset
from sfms_robot.lab.learning import corpus as dyads
from sfms_robot.lab.learning.corpus import (
    Corpus,
    fit_sound,
    fit_sway,
    motion_scales,
    shared_frames,
)
from sfms_robot.lab.learning.job import ALONE, Run
from sfms_robot.listeners import audio_frontend
from sfms_robot.listeners.arig import event_curves
from sfms_robot.listeners.arig.model import ArigDyad, ArigModel
from sfms_robot.listeners.arig.modules import StateUnderstanding
from sfms_robot.listeners.arig.sampler import Denoiser
from sfms_robot.listeners.arig.stream import FEEDBACK, LISTENING, NODDING, QUANTILES, with_feedback
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals import mel, phase
from sfms_robot.signals.events import runs
from sfms_robot.signals.voice_activity import levels_db

SCENES: Final = ("speaking", "listening", "interaction")
LEAST_STEP: Final = 0.01  # from frame to frame, in deviations of the motion
LEAST_SPREAD: Final = 0.25  # of companded innovations: channels that hardly move do not weigh more than others
COMPANDED: Final = 4  # innovations above the deviation over this are companded: between rest and movement
LARGEST_RHO: Final = 0.98  # from one frame to the next: errors in what was drawn are forgotten within 2 s
AT_REST: Final = 0.99  # quantile of the distance of faces at rest; beyond it a face is returning to rest
LEAST_REST: Final = 10 * FRAME_HZ  # frames at rest that are needed to measure this distance
PAUSE_FRAMES: Final = FRAME_HZ // 2  # before and after a word that do not count as rest
RARE: Final = 0.02  # share of the frames with the same voices; a rarer state is only the edge of a label

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class LabelledDyad(ArigDyad):
    """Inputs of the model, with sound stored in half precision, and states (..., N) int64, -1 if unlabelled.

    `control` is (..., N, 0) for a listener without events. `sway` (..., N, S) is the agent's slow motion, if that is
    not in `agent_motion`; S = 0 without sway.
    """

    states: Tensor
    sway: Tensor


ArigCorpus = Corpus[LabelledDyad]


def open_scenes(data: Path, split: str) -> dict[str, Dataset]:
    """Open the sets of a split by scene: `data` itself is listening, data/speaking and data/interaction the others."""
    found = {"listening": open_dataset(data, split)}
    for scene in ("speaking", "interaction"):
        if any((data / scene).glob(f"{split}/*.npz")):
            found[scene] = open_dataset(data / scene, split)
        else:
            log.warning("%s: no %s, the curriculum continues without it", data / scene, split)
    return found


def gather(
    scenes: Mapping[str, Sequence[Conversation]],
    window: int,
    space: MotionSpace,
    settings: config.Arig,
    run: Run = ALONE,
    split: str = "",
) -> ArigCorpus:
    """Run `corpus.gather` in one motion space, for a listener of these settings."""
    return dyads.gather(scenes, window, partial(frames_of, space=space, settings=settings), run, split)


def cut(corpus: ArigCorpus, starts: Tensor, window: int) -> LabelledDyad:
    """Return the windows at (B,) starts as inputs of the model, with sound in single precision."""
    found = corpus.cut(starts, window)
    return replace(found, user_sound=found.user_sound.float(), agent_sound=found.agent_sound.float())


def frames_of(dyad: Conversation, space: MotionSpace, settings: config.Arig) -> LabelledDyad:
    """Return the frames of one conversation. Raises ConfigError for a motion space, sound or events that do not fit."""
    frames, width = len(dyad.listener), audio_frontend.WIDTHS[settings.sound]
    face, seen, motion, sway, control = shared_frames(dyad, space, settings)
    user, user_voiced, heard = _audio_features(dyad, dyad.voice, "wav2vec2", width, dyad.mel)
    agent, agent_voiced, says = _audio_features(dyad, dyad.agent_audio, "agent_wav2vec2", width)
    states = torch.from_numpy((np.full(frames, UNKNOWN) if dyad.states is None else dyad.states).astype(np.int64))
    if settings.events:
        quiet = torch.where((states == FEEDBACK) & ~agent_voiced, LISTENING, states)
        states = torch.from_numpy(with_feedback(quiet.numpy(), control.numpy()))
    return LabelledDyad(
        user_sound=user,
        user_heard=torch.full((frames,), heard),
        agent_sound=agent,
        agent_heard=torch.full((frames,), says),
        user_motion=face,
        user_seen=seen,
        agent_motion=motion,
        voiced=torch.stack([agent_voiced, user_voiced], dim=-1),
        control=control,
        states=states,
        sway=sway,
    )


def _audio_features(
    dyad: Conversation, audio: Floats | None, shipped: str, width: int, mel_rows: Floats | None = None
) -> tuple[Tensor, Tensor, bool]:
    """Return features (N, A) of a track in half precision, speech (N,), and whether there is a track.

    A missing track of the user means a missing microphone; zeros in the agent's mean a silent robot. wav2vec2 features
    come with the data, as the feature `shipped`, and replace the mel rows.
    """
    frames, wide = len(dyad.listener), width != audio_frontend.WIDTHS["mel"]
    if wide and shipped in dyad.features:
        place, voiced = np.zeros((frames, phase.FEATURES), np.float32), np.zeros(frames, bool)
        if audio is not None:
            place, voiced = phase.of_audio(audio), np.array(phase.hear(levels_db(audio)))
        rows = np.concatenate([dyad.features[shipped], place], axis=1).astype(np.float32)
    elif wide and audio is not None:
        raise ConfigError(f"{dyad.name}: sound = wav2vec2 needs the feature wav2vec2, agent_wav2vec2 with the data")
    elif audio is not None and dyad.fps == FRAME_HZ:
        rows, voiced = audio_frontend.track(audio)
    elif mel_rows is not None:
        rows, voiced = audio_frontend.of_mel(mel_rows.reshape(frames, mel.ROWS_PER_FRAME, mel.MEL_BINS))
    else:
        return torch.zeros(frames, width, dtype=torch.half), torch.zeros(frames, dtype=torch.bool), False
    return torch.from_numpy(rows).half(), torch.from_numpy(voiced), True


def reflection(before: Tensor, after: Tensor) -> Tensor:
    """Return Burg's coefficient (C,) of values of mean 0, (M, C) each.

    It is the share of one in the other, in either direction, within -1..1: no autoregression with such coefficients
    grows (J. P. Burg, 1967). A constant channel has coefficient 1.
    """
    power = (before.double().square() + after.double().square()).sum(0)
    found = 2 * (before.double() * after.double()).sum(0) / power.clamp(min=1e-9)
    return torch.where(power > 0, found, 1.0).float()


def _fit_steps(model: ArigModel, of_dyads: Sequence[Tensor], remains: Tensor | None) -> Tensor:
    """Fit the steps on standardised motion (M, C) of every dyad without its events; return the part (N, C) to draw.

    `remains` (N, C): from `event_curves.remains`; None without events.
    """
    last, now = (torch.cat([one[part] for one in of_dyads]) for part in (slice(None, -1), slice(1, None)))
    if remains is not None:
        last = remains * last
    if model.settings.draws != "innovation":
        model.step_std.copy_((now - last).std(0).clamp(min=LEAST_STEP))
        return model.moved(now, last)
    rho = reflection(last, now).clamp(0.0, LARGEST_RHO)
    model.rho.copy_(rho)
    left = now - rho * last
    model.step_std.copy_((left.std(0) / COMPANDED).clamp(min=LEAST_STEP))
    model.spread.copy_((left / model.step_std).asinh().std(0).clamp(min=LEAST_SPREAD))
    return model.companded(left / model.step_std)


def _fit_events(model: ArigModel, standard: Tensor, control: Tensor, corpus: ArigCorpus) -> tuple[list[Tensor], Tensor]:
    """Fit the average motion of events, and the distance from it of faces at rest, without events and speech.

    Return the motion (M, C) of every dyad minus that of its events, from standardised motion (N, C), and
    `event_curves.remains` of every frame except the first of a dyad.
    """
    model.told.copy_(event_curves.fit(control, standard))
    sides = [name in LATERAL_POSE for name in model.settings.channels]
    model.told[:, sides] = 0.0  # no input has the side to which a shake begins, so the average has none
    controls, still = corpus.by_dyad(control), []
    of_dyads = [motion - event_curves.features(rows) @ model.told
                for motion, rows in zip(corpus.by_dyad(standard), controls, strict=True)]  # fmt: skip
    for rows, talk in zip(controls, corpus.by_dyad(corpus.frames.voiced[:, 0].float()), strict=True):
        near = F.max_pool1d(talk[None], 2 * PAUSE_FRAMES + 1, 1, PAUSE_FRAMES)[0] > 0
        still.append(~(event_curves.moved_channels(rows, model.moves) | near[:, None]))
    rests, off = torch.cat(still), torch.cat(of_dyads).abs()
    for channel in range(model.channels):
        found = off[rests[:, channel], channel]
        if len(found) >= LEAST_REST:
            model.rest_range[channel] = found.kthvalue(math.ceil(AT_REST * len(found))).values
    return of_dyads, torch.cat([event_curves.remains(rows[:-1], rows[1:], model.moves) for rows in controls])


def _fit_states(states: StateUnderstanding, corpus: ArigCorpus) -> None:
    """Set the durations of the paper's states, and which states are possible with which voices."""
    labels = corpus.frames.states
    labels = torch.where(labels >= NODDING, LISTENING, labels)  # visible feedback counts as listening
    of_dyads = corpus.by_dyad(labels)
    places = torch.linspace(0, 1, QUANTILES)
    for state in range(len(STATES)):
        lasted = [float(end - start) for one in of_dyads for start, end in runs(one == state)]
        if lasted:
            states.durations[state] = torch.quantile(torch.tensor(lasted), places)
    known = labels >= 0
    voices = corpus.frames.voiced[known].long()
    found = torch.zeros(2, 2, len(STATES))
    found.index_put_((voices[:, 0], voices[:, 1], labels[known]), torch.ones(()), accumulate=True)
    share = found / found.sum(-1, keepdim=True).clamp(min=1)
    states.possible.copy_((share >= RARE) | (share == share.amax(-1, keepdim=True)))


def fit_scales(model: ArigModel, corpus: ArigCorpus) -> None:
    """Set means and deviations of motion and sound, and the range of the sampler."""
    frames, channels = corpus.frames, model.settings.channels
    mean, spread = motion_scales(frames.agent_motion, channels)
    if frames.user_seen.any():  # channels not drawn, or made separately, are still inputs
        whole = model.is_drawn & model.is_recalled
        spread = torch.where(whole, spread, motion_scales(frames.user_motion[frames.user_seen], channels)[1])
    model.motion_mean.copy_(mean)
    model.motion_std.copy_(spread)
    standard = model.standardise(frames.agent_motion)
    model.motion_low.copy_(standard.amin(0))
    model.motion_high.copy_(standard.amax(0))
    of_dyads, remains = corpus.by_dyad(standard), None
    if model.is_told and frames.control is not None:
        of_dyads, remains = _fit_events(model, standard, frames.control, corpus)
    drawn = _fit_steps(model, of_dyads, remains)
    if model.settings.sway:  # of listening if there is any: speakers sway further, and no input marks them
        slow = corpus.by_dyad(frames.sway)
        listening = [one for one, scene in zip(slow, corpus.scenes, strict=True) if scene == "listening"]
        fit_sway(model, listening or slow)
    if isinstance(model.head, Denoiser) and model.settings.diffusion.clamp:
        model.head.low.copy_(drawn.amin(0))
        model.head.high.copy_(drawn.amax(0))
    if model.settings.events and model.states is not None:
        _fit_states(model.states, corpus)
    fit_sound(model, (frames.user_sound, frames.user_heard), (frames.agent_sound, frames.agent_heard))
