"""Training of ARIG: one phase, windows that begin like a stream, teacher forcing, and the paper's curriculum."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES, POSE_CHANNELS
from sfms_robot.lab.learning.arig.features import (
    SCENES,
    ArigCorpus,
    LabelledDyad,
    cut,
    fit_scales,
    gather,
    open_scenes,
)
from sfms_robot.lab.learning.corpus import ACTIVE, training_data
from sfms_robot.lab.learning.job import ALONE, Job, Run, is_drawn, noise_of, normal, uniform
from sfms_robot.lab.learning.training_loop import fit, optimizer
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.arig.model import ArigDyad, ArigModel
from sfms_robot.listeners.arig.stream import FIRST
from sfms_robot.listeners.audio_frontend import MEL_WIDTH, track
from sfms_robot.listeners.layers import weighted_mean
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals import mel

HELD_OUT_WINDOWS, HELD_OUT_BATCH = 24, 4


def train_arig(
    settings: config.ArigTraining,
    data: Path,
    out: Path,
    run: Run = ALONE,
) -> dict[str, Any]:
    """Train on `data`/train (and its speaking/ and interaction/) and write `out`/config.yaml and model.safetensors.

    Weights are written in 16 bits: a test checks that a frame differs by less than a hundredth of its spread.

    Returns the figures of the run. Ctrl-C leaves a checkpoint in `out`, from which `run.resume` continues.
    """
    listener, phase = settings.listener, settings.training
    torch.manual_seed(settings.seed)
    student = Student(ArigModel(listener))
    corpus, held_out = corpora(settings, data, run).values()
    fit_scales(student.model, corpus)
    job = arig_job(settings, student, corpus, held_out, run.device)
    outcome = fit(job, out, run)
    if run.group.first:
        checkpoint.save_config(out, listener)
        checkpoint.save_weights(out / checkpoint.WEIGHTS, student.model.cpu(), bits=16)
    parts = held_out_parts(student.to(run.device), held_out.to(run.device), phase)
    return {
        **asdict(outcome),
        "held_out_noise": float(parts.motion),
        "held_out_state": float(parts.state),
        "held_out_coarse": float(parts.coarse),
    }


def corpora(settings: config.ArigTraining, data: Path, run: Run) -> dict[str, ArigCorpus]:
    """Return the frames of train and validation, from a folder or a pack."""
    window, listener = settings.training.window_frames, settings.listener

    def read(split: str) -> ArigCorpus:
        return gather(open_scenes(data, split), window, MotionSpace.of(listener), listener, run, split)

    return training_data(data, LabelledDyad, settings, read)


def arig_job(
    settings: config.ArigTraining, student: Student, corpus: ArigCorpus, held_out: ArigCorpus, device: torch.device
) -> Job:
    """Return the job of a model whose scales are set; move the model to `device`."""
    phase = settings.training
    starts = corpus.starts_by_scene(phase.window_frames)
    eventful = starts_by_event(corpus, starts, phase.window_frames) if phase.event_windows else {}
    for stage in phase.stages:
        weights_of(stage, starts)
    identity = corpus.identity(settings, "training", phase)
    student.to(device)
    corpus, held_out = corpus.to(device), held_out.to(device)

    def loss_of(step: int, generator: Generator, batch: int) -> Tensor:
        chosen = draw(starts, weights_of(phase.stage(step), starts), batch, generator, eventful, phase.event_windows)
        dyad = cut(corpus, chosen, phase.window_frames)
        noise = noise_of(generator, device)
        told, truth = augment(dyad, student.model, phase, noise)
        return loss_parts(student, told, dyad.states, truth, phase, noise).total(phase)

    return Job(
        name="arig",
        model=student,
        optimizers=[optimizer(student.parameters(), phase.learning_rate, phase.weight_decay)],
        loss_of=loss_of,
        held_out=lambda: float(held_out_parts(student, held_out, phase).total(phase)),
        frames_per_step=phase.batch * phase.window_frames,
        phase=phase,
        seed=settings.seed,
        identity=identity,
    )


def weights_of(stage: config.Stage, starts: Mapping[str, Tensor]) -> Tensor:
    """Return the probabilities (3,) of windows of `SCENES`, 0 for those without windows. Raises ConfigError."""
    weights = torch.tensor([getattr(stage, scene) * (scene in starts) for scene in SCENES], dtype=torch.float64)
    if not weights.any():
        wanted = ", ".join(scene for scene in SCENES if getattr(stage, scene))
        raise ConfigError(f"training.stages: a stage draws from {wanted} alone, the data have {', '.join(starts)}")
    return weights / weights.sum()


def starts_by_event(corpus: ArigCorpus, starts: Mapping[str, Tensor], window: int) -> dict[str, list[Tensor]]:
    """Return by scene, for every kind of event in it except blinks, the `starts` whose window has such an event."""
    control, found = corpus.frames.control, {}
    if control is None or not control.shape[-1]:
        return {}
    before = torch.zeros(len(control) + 1, len(ACTIVE), dtype=torch.int32)  # number of frames with one before it
    before[1:] = (control[:, ACTIVE] > 0).cumsum(0)
    for scene, firsts in starts.items():
        has = before[firsts + window] > before[firsts]
        found[scene] = [firsts[one] for one in has.unbind(1) if one.any()]
    return found


def draw(
    starts: Mapping[str, Tensor],
    weights: Tensor,
    count: int,
    generator: Generator,
    eventful: Mapping[str, Sequence[Tensor]] = MappingProxyType({}),
    share: float = 0.0,
) -> Tensor:
    """Draw first frames (count,): a scene by its weight, then any of its windows.

    A `share` of them is drawn from the scene's `eventful` sets: any of these sets, then any of its windows.
    """
    scenes = torch.multinomial(weights, count, replacement=True, generator=generator)
    places, kinds, busy = torch.rand(3, count, generator=generator, dtype=torch.float64).tolist()
    found = []
    for scene, place, kind, lot in zip([SCENES[int(scene)] for scene in scenes], places, kinds, busy, strict=True):
        sets = eventful.get(scene, ()) if lot < share else ()
        of = sets[int(kind * len(sets))] if sets else starts[scene]
        found.append(of[int(place * len(of))])
    return torch.stack(found)


@torch.no_grad()
def held_out_parts(student: Student, corpus: ArigCorpus, phase: config.ArigPhase) -> LossParts:
    """Return the losses, without augmentation, on windows drawn with a fixed seed and the last stage's weights."""
    student.eval()
    generator = Generator().manual_seed(0)
    starts = corpus.starts_by_scene(phase.window_frames)
    chosen = draw(starts, weights_of(phase.stages[-1], starts), HELD_OUT_WINDOWS, generator)
    found = []
    for some in torch.split(chosen, HELD_OUT_BATCH):
        dyad = cut(corpus, some, phase.window_frames)
        found.append(loss_parts(student, dyad, dyad.states, dyad.agent_motion, phase, generator))
    return LossParts(*(torch.stack(each).mean() for each in zip(*found, strict=True)))


# --- Losses ----------------------------------------------------------------------------------------------------------
#
# loss = L(3) + state_weight * CE(states, 3.3) + coarse_weight * |coarse motion - motion|^2 (3.4)
#
# Every frame gets the true past (teacher forcing). The paper states (3) and the cross-entropy. Ours: the coarse motion
# is compared with the motion itself, through a linear layer that is discarded afterwards, so that lips follow sounds
# after fewer steps. Also ours: weights of groups of channels, since most channels in (3) belong to the mouth.

RETURN = 0.1  # share of the slow part of the noise on the past that one frame removes
COLOURS = 4  # waves over the bands that make up another microphone's colour
JUMPS = 0.04  # share of frames at which the slow part moves to another value
GLIDE = 12  # most frames that this takes
COLD = 0.5  # share of windows whose past is exact
SPOKEN = ("jaw", "mouth", "tongue")  # channels that the agent's own sounds determine while it speaks
# Groups of channels, by the beginnings of their names; the mouth has the rest.
GROUPS: Final = {
    "head": (*POSE_CHANNELS, "rotation", "translation", "head"),
    "lids": ("eye",),
    "brows": ("brow",),
    "mouth": ("",),
}


class Student(nn.Module):
    """The model, and the layer that maps its coarse motion to motion during training."""

    def __init__(self, model: ArigModel) -> None:
        super().__init__()
        self.model = model
        self.readout = nn.Linear(model.settings.width, model.channels)


class LossParts(NamedTuple):
    """Means over frames: equation (3), cross-entropy of labelled frames, squared error of the coarse motion."""

    motion: Tensor
    state: Tensor
    coarse: Tensor

    def total(self, phase: config.ArigPhase) -> Tensor:
        return self.motion + phase.state_weight * self.state + phase.coarse_weight * self.coarse


def loss_parts(
    student: Student, told: ArigDyad, states: Tensor, truth: Tensor, phase: config.ArigPhase, generator: Generator
) -> LossParts:
    """Return the losses of frames 1..N-1.

    Args:
        student: The model and its readout.
        told: Inputs of the model, the past possibly noisy.
        states: (B, N) int64, -1 where not labelled.
        truth: (B, N, C) motion to be predicted after this past.
        phase: Its `group_weights` weigh `GROUPS` in equation (3); None: every channel counts the same.
        generator: Draws noise levels and previous states.
    """
    model = student.model
    weights = None
    if phase.group_weights is not None:
        listener = model.settings
        weights = sent(channel_weights(listener.channels, listener.drawn_channels, phase.group_weights), truth.device)
    before = previous_states(states, phase.state_noise, generator, len(model.settings.states))
    found = model.condition(told, None if phase.own_states else before)
    target = model.standardise(truth[:, 1:])
    to_draw = model.moved(target, model.standardise(told.agent_motion[:, :-1]), model.rows(told))
    motion = model.sample_loss(found.z.flatten(0, 1), to_draw.flatten(0, 1), phase.draws, generator, weights).mean()
    coarse = weighted_mean((student.readout(found.outline) - target).square(), weights).mean()
    state = motion.new_zeros(()) if found.states is None else state_loss(found.states, states[:, 1:])
    return LossParts(motion, state, coarse)


def state_loss(logits: Tensor, states: Tensor, selected: bool | None = None) -> Tensor:
    """Return the cross-entropy of labelled frames, 0 without any; logits (B, T, S), states (B, T), -1 not labelled.

    `selected`: the rows of those frames are selected first, which makes the host wait for a GPU; None: only on a CPU.
    The two ways add in different orders.
    """
    known = states >= 0
    if not (logits.device.type == "cpu" if selected is None else selected):
        total = F.cross_entropy(logits.flatten(0, 1), states.flatten(), ignore_index=-1, reduction="sum")
        return total / known.sum().clamp(min=1)
    return F.cross_entropy(logits[known], states[known]) if bool(known.any()) else logits.new_zeros(())


def group_of(channel: str) -> str:
    """Return the group of `GROUPS` that a channel belongs to."""
    return next(group for group, begins in GROUPS.items() if channel.startswith(begins))


@lru_cache(maxsize=8)
def channel_weights(channels: tuple[str, ...], drawn: tuple[str, ...], groups: config.GroupWeights) -> Tensor:
    """Return weights (C,) that add up to 1: a group's weight, divided among those of its channels that are `drawn`."""
    members = Counter(group_of(name) for name in drawn)
    weights = torch.zeros(len(channels))
    for index, name in enumerate(channels):
        if name in drawn:
            weights[index] = getattr(groups, group_of(name)) / members[group_of(name)]
    return weights / weights.sum()


def augment(dyad: ArigDyad, model: ArigModel, phase: config.ArigPhase, generator: Generator) -> tuple[ArigDyad, Tensor]:
    """Return windows with missing modalities, other microphones and a noisy past; and the motion (B, N, C) after it.

    The noise on the past has a slow part, of which the next frame removes a tenth, and a fast part, which it removes
    completely. Removing everything at once would be a jump that no sound and no state explains, and streams would learn
    to jitter. A head whose past is not an input of the model gets no noise.
    Lips differ while the agent speaks: its sounds determine their place, so their past has more noise, in every window,
    and all of it is removed at once.
    """
    b, n = dyad.user_heard.shape
    device = dyad.agent_motion.device

    def dropped(share: float) -> Tensor:
        if not is_drawn(generator, share):
            return torch.zeros(b, 1, dtype=torch.bool, device=device)
        return (uniform(generator, b, 1) < share).to(device)

    deaf, blind = dropped(phase.drop_audio), dropped(phase.drop_face)
    silent = dropped(phase.silent_user)
    mute = dropped(phase.drop_agent) & ~dyad.voiced[..., 0].any(1, keepdim=True)
    voiced = torch.stack([dyad.voiced[..., 0], dyad.voiced[..., 1] & ~deaf & ~silent], dim=-1)
    user_off, agent_off = (_microphone(b, n, model, phase, generator).to(device) for _ in range(2))
    off = model.motion_std * model.is_recalled
    slow, fast = (each.to(device) * off for each in _wander(b, n, model.channels, phase, generator))
    spoken = dyad.voiced[..., :1] & sent(_lips(model.settings.channels), device)
    missed = torch.zeros((), device=device)
    if is_drawn(generator, phase.speaking_noise):
        missed = uniform(generator, b, 1, 1) * phase.speaking_noise
        missed = missed * normal(generator, b, n, model.channels)
        missed = missed.to(device) * model.motion_std
    told = replace(
        dyad,
        user_sound=_in_a_room(dyad.user_sound + user_off, voiced[..., 1:], silent, model, phase, generator),
        agent_sound=dyad.agent_sound + agent_off,
        user_heard=dyad.user_heard & ~deaf,
        agent_heard=dyad.agent_heard & ~mute,
        user_seen=dyad.user_seen & ~blind,
        agent_motion=dyad.agent_motion + slow + fast * model.step_std + torch.where(spoken, missed, 0.0),
        voiced=voiced,
    )
    carried = (1 - RETURN) * torch.cat([slow[:, :1], slow[:, :-1]], dim=1)
    return told, dyad.agent_motion + torch.where(spoken, 0.0, carried)


# Returns a constant on a device; it is sent there once and then kept.
sent: Final = lru_cache(maxsize=32)(Tensor.to)


@lru_cache(maxsize=8)
def _lips(channels: tuple[str, ...]) -> Tensor:
    return torch.tensor([name.startswith(SPOKEN) for name in channels])


@lru_cache(maxsize=1)
def _colours() -> Tensor:
    """Return the waves over the bands (COLOURS, bands) that make up a microphone's colour."""
    place = torch.arange(mel.MEL_BINS) / mel.MEL_BINS
    return torch.cos(torch.pi * torch.arange(1, COLOURS + 1)[:, None] * place)


@lru_cache(maxsize=8)
def _silence(frames: int) -> Tensor:
    """Return the features (frames, A) of silence since the start of a stream."""
    return torch.from_numpy(track(np.zeros(frames * FRAME_SAMPLES, np.float32))[0])


def _microphone(b: int, n: int, model: ArigModel, phase: config.ArigPhase, generator: Generator) -> Tensor:
    """Draw the offsets (B, N, A) of another microphone to logarithms of power; 0 for other features."""
    place = generator.device
    off = torch.zeros(b, n, model.sound_width, device=place)
    if model.settings.sound != "mel" or not is_drawn(generator, phase.gain_db, phase.colour_db, phase.grain_db):
        return off
    size = uniform(generator, b, 1, 2) * mel.LN_PER_DB
    waves = normal(generator, b, 1, COLOURS) / COLOURS**0.5
    colour = waves @ sent(_colours(), place)
    grain = torch.zeros((), device=place).expand(b, n, mel.ROWS_PER_FRAME, mel.MEL_BINS)
    if is_drawn(generator, phase.grain_db):
        grain = normal(generator, *grain.shape)
    gain = uniform(generator, b, 1, 1) * 2 - 1
    bands = gain * mel.LN_PER_DB * phase.gain_db + size[..., :1] * phase.colour_db * colour
    off[..., :MEL_WIDTH] = (bands[:, :, None] + size[..., 1:2, None] * phase.grain_db * grain).flatten(2)
    return off


def _in_a_room(
    sound: Tensor, voiced: Tensor, silent: Tensor, model: ArigModel, phase: config.ArigPhase, generator: Generator
) -> Tensor:
    """Return the user's sound (B, N, A), weaker without speech (voiced (B, N, 1)), or all silence (silent (B, 1)).

    Silence has the features of a stream's start. Features other than logarithms of power are unchanged.
    """
    if model.settings.sound != "mel":
        return sound
    b, n = sound.shape[:2]
    quieter = sound
    if is_drawn(generator, phase.quiet_room):
        share, lot = (uniform(generator, b, 1, 1) for _ in range(2))
        bands = sound[..., :MEL_WIDTH]
        less = (share * (lot < phase.quiet_room)).to(sound.device) * (bands - math.log(mel.FLOOR)).clamp(min=0)
        quieter = torch.cat([torch.where(voiced, bands, bands - less), sound[..., MEL_WIDTH:]], dim=-1)
    return torch.where(silent[..., None], sent(_silence(n), sound.device), quieter)


def _wander(b: int, n: int, channels: int, phase: config.ArigPhase, generator: Generator) -> tuple[Tensor, Tensor]:
    """Return slow and fast noise (B, N, C) on the past of half of the windows.

    The slow part is in deviations of the motion, the fast part in those of its steps.
    The slow part jumps or glides to a new value about once a second, and decays by a tenth per frame. A glide resembles
    the drift of a stream: its speed does not continue in the frames after it.
    """
    if not is_drawn(generator, phase.history_noise):
        nothing = torch.zeros(b, n, 1, device=generator.device)
        return nothing, nothing
    size = uniform(generator, b, 1, 1) * phase.history_noise
    size = size * (uniform(generator, b, 1, 1) >= COLD)
    jumps = normal(generator, b, n, channels)
    jumps = jumps * (uniform(generator, b, n, 1) < JUMPS)
    # Each jump is spread evenly over the next 1 to `GLIDE` frames, a number drawn for each window.
    frames = torch.randint(1, GLIDE + 1, (b, 1), generator=generator, device=jumps.device)
    total = torch.cat([torch.zeros_like(jumps[:, :1]), jumps.cumsum(1)], dim=1)  # sum of the jumps before each frame
    before = (torch.arange(1, n + 1, device=jumps.device) - frames).clamp(min=0)
    jumps = (total[:, 1:] - total.gather(1, before[..., None].expand(-1, -1, channels))) / frames[..., None]
    fast = normal(generator, b, n, channels)
    return size * decayed(jumps), size * fast


def decayed(jumps: Tensor, at_once: bool | None = None) -> Tensor:
    """Return for each frame the sum (B, N, C) of the jumps so far, each of which decays by `RETURN` a frame.

    `at_once`: compute it as one product, for a GPU; None: only on a GPU. The two ways add in different orders.
    """
    n = jumps.shape[1]
    if jumps.device.type != "cpu" if at_once is None else at_once:
        return sent(_left(n), jumps.device) @ jumps
    slow = jumps.clone()
    for frame in range(1, n):
        slow[:, frame] += (1 - RETURN) * slow[:, frame - 1]
    return slow


@lru_cache(maxsize=8)
def _left(frames: int) -> Tensor:
    """Return (frames, frames): the share of a jump of one frame (column) that is left in another (row)."""
    frame = torch.arange(frames)
    return ((1 - RETURN) ** (frame[:, None] - frame).double()).tril().float()


def previous_states(states: Tensor, share: float, generator: Generator, count: int) -> Tensor:
    """Return the previous states (B, N) as inputs of the model.

    Unlabelled ones count as `waiting`; a `share` is drawn at random from `count` states.
    """
    known = torch.where(states < 0, FIRST, states)
    if not is_drawn(generator, share):
        return known
    drawn = torch.randint(count, states.shape, generator=generator, device=generator.device).to(states.device)
    replaced = (uniform(generator, *states.shape) < share).to(states.device)
    return torch.where(replaced, drawn, known)
