"""Training of ARIG: one phase, windows that begin as a stream does, teacher forcing, and the paper's curriculum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.lab.learning.arig.features import SCENES, ArigCorpus, cut, fit_scales, gather, open_scenes
from sfms_robot.lab.learning.arig.losses import LossParts, Student, augment, loss_parts, previous_states
from sfms_robot.lab.learning.job import Job, Run
from sfms_robot.lab.learning.training_loop import fit, optimizer
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.arig.model import ArigDyad, ArigModel
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS

HELD_OUT_WINDOWS, HELD_OUT_BATCH = 24, 4


def train_arig(
    settings: config.ArigTraining,
    data: Path,
    out: Path,
    run: Run = Run(),  # noqa: B008
) -> dict[str, Any]:
    """Train on `data`/train (and its speaking/ and interaction/) and write `out`/config.yaml and model.safetensors.

    Weights are written in 16 bits: a frame differs by less than a hundredth of its spread (a test).

    Returns the figures of the run. Ctrl-C leaves a checkpoint in `out`, from which `run.resume` continues.
    """
    listener, phase = settings.listener, settings.training
    torch.manual_seed(settings.seed)
    student = Student(ArigModel(listener))
    space = MotionSpace.of(listener)
    corpus, held_out = (
        gather(open_scenes(data, split), phase.window_frames, space, listener, run.staging(split))
        for split in ("train", "validation")
    )
    fit_scales(student.model, corpus, listener.channels)
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


def arig_job(
    settings: config.ArigTraining, student: Student, corpus: ArigCorpus, held_out: ArigCorpus, device: torch.device
) -> Job:
    """The training as the loop takes it, on a model whose scales are set; moves it to `device`."""
    phase = settings.training
    starts = corpus.starts_by_scene(phase.window_frames)
    eventful = starts_by_event(corpus, starts, phase.window_frames) if phase.event_windows else {}
    for stage in phase.stages:
        weights_of(stage, starts)
    fingerprint = corpus.fingerprint()
    student.to(device)
    corpus, held_out = corpus.to(device), held_out.to(device)

    def loss_of(step: int, generator: torch.Generator, batch: int) -> Tensor:
        chosen = draw(starts, weights_of(phase.stage(step), starts), batch, generator, eventful, phase.event_windows)
        dyad = cut(corpus, chosen.to(device), phase.window_frames)
        told, truth = augment(dyad, student.model, phase, generator)
        return _loss_parts(student, told, dyad.states, truth, phase, generator).total(phase)

    return Job(
        name="arig",
        model=student,
        optimizers=[optimizer(student.parameters(), phase.learning_rate, phase.weight_decay)],
        loss_of=loss_of,
        held_out=lambda: float(held_out_parts(student, held_out, phase).total(phase)),
        frames_per_step=phase.batch * phase.window_frames,
        phase=phase,
        seed=settings.seed,
        identity={
            "seed": settings.seed,
            "listener": settings.listener.model_dump(mode="json"),
            "training": phase.identity(),
            "data": fingerprint,
        },
    )


def weights_of(stage: config.Stage, starts: Mapping[str, Tensor]) -> Tensor:
    """(3,) how likely a window is of each of `SCENES`; those without windows are left out. Raises ConfigError."""
    weights = torch.tensor([getattr(stage, scene) * (scene in starts) for scene in SCENES], dtype=torch.float64)
    if not weights.any():
        wanted = ", ".join(scene for scene in SCENES if getattr(stage, scene))
        raise ConfigError(f"training.stages: a stage draws from {wanted} alone, the data have {', '.join(starts)}")
    return weights / weights.sum()


def starts_by_event(corpus: ArigCorpus, starts: Mapping[str, Tensor], window: int) -> dict[str, list[Tensor]]:
    """By scene, of every kind of event but blinks that there is in it, those of the `starts` whose window has one."""
    control, found = corpus.frames.control, {}
    if control is None or not control.shape[-1]:
        return {}
    active = [at for at, name in enumerate(COLUMNS) if name.endswith(".active") and name != "blink.active"]
    before = torch.zeros(len(control) + 1, len(active), dtype=torch.int32)  # frames with one, before each frame
    before[1:] = (control[:, active] > 0).cumsum(0)
    for scene, firsts in starts.items():
        has = before[firsts + window] > before[firsts]
        found[scene] = [firsts[one] for one in has.unbind(1) if one.any()]
    return found


def draw(
    starts: Mapping[str, Tensor],
    weights: Tensor,
    count: int,
    generator: torch.Generator,
    eventful: Mapping[str, Sequence[Tensor]] = MappingProxyType({}),
    share: float = 0.0,
) -> Tensor:
    """(count,) first frames: a scene by its weight, then any of its windows.

    `share` of them are of one of its `eventful` sets instead, any of these and then any of the set.
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
    """Losses on windows drawn with a fixed seed as the last stage draws them, without augmentation."""
    student.eval()
    generator = torch.Generator().manual_seed(0)
    starts = corpus.starts_by_scene(phase.window_frames)
    chosen = draw(starts, weights_of(phase.stages[-1], starts), HELD_OUT_WINDOWS, generator)
    found = []
    for some in torch.split(chosen, HELD_OUT_BATCH):
        dyad = cut(corpus, some.to(student.readout.weight.device), phase.window_frames)
        found.append(_loss_parts(student, dyad, dyad.states, dyad.agent_motion, phase, generator))
    mean = {name: torch.stack([getattr(one, name) for one in found]).mean() for name in ("motion", "state", "coarse")}
    return LossParts(**mean)


def _loss_parts(
    student: Student, told: ArigDyad, states: Tensor, truth: Tensor, phase: config.ArigPhase, generator: torch.Generator
) -> LossParts:
    """`losses.loss_parts` as the phase says, previous states drawn."""
    previous = previous_states(states, phase.state_noise, generator, len(student.model.settings.states))
    return loss_parts(student, told, states, truth, phase.draws, generator, previous, phase.group_weights)
