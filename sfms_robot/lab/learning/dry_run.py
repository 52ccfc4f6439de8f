"""`train ... --dry-run`: one step of every stage of a training file, on made-up frames, and what all of it would take.

Operations, bytes and calls are counted, not guessed: of a piece of the batch that is small enough for this machine,
forward and backward, as often as the batch has such pieces, and of the update of all weights. A GPU's time for a step
is then the longest of three: operations at a share of its peak, bytes at a share of its bandwidth, calls at what one
costs the processor that makes them. Random numbers are drawn on the GPU (`learning.job`): bytes and calls like others.
The shares are assumptions, told with the figures.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from sfms_robot import config
from sfms_robot.config.listener import STATES
from sfms_robot.frames import EVENT_KINDS, FRAME_HZ, MOTION_DIM, ListenerEvent
from sfms_robot.lab.bench.measure import memory_mb
from sfms_robot.lab.bench.operation_count import OperationCount
from sfms_robot.lab.corpora.clips import Dyad, samples_of
from sfms_robot.lab.learning.arig import features as arig
from sfms_robot.lab.learning.arig.trainer import Student, arig_job
from sfms_robot.lab.learning.corpus import fit_sound
from sfms_robot.lab.learning.job import Job, ProcessGroup
from sfms_robot.lab.learning.sfms import features as sfms
from sfms_robot.lab.learning.sfms.predictor_trainer import listener_job
from sfms_robot.lab.learning.sfms.tokenizer_trainer import tokenizer_job
from sfms_robot.lab.learning.training_loop import Gradients
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.audio_frontend import AudioFrontend
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.space import MotionSpace

MOST_FRAMES: Final = 1200  # of a piece: what a small machine holds
REACHED: Final = 0.3  # of a GPU's peak, and `STREAMED` of its bandwidth
STREAMED: Final = 0.7
CALL_US: Final = 8.0  # one call of torch from Python
_DYADS: Final = 2
CPU: Final = torch.device("cpu")


@dataclass(frozen=True)
class Gpu:
    """Peaks as its maker states them: dense bf16 and fp32 (TF32) operations [1/s], memory [byte/s]."""

    bf16: float
    fp32: float
    memory: float


GPUS: Final = {
    "A100": Gpu(312e12, 156e12, 2.0e12),
    "H100": Gpu(989e12, 494e12, 3.35e12),
    "RTX 4090": Gpu(165e12, 82e12, 1.0e12),
}
ASSUMED: Final = (
    f"assumed of a GPU: {REACHED:.0%} of its peak, {STREAMED:.0%} of its bandwidth, {CALL_US:g} us a call of torch "
    "(nothing compiled); looks at held-out data are not counted"
)


def dry_run(settings: config.Training | config.ArigTraining) -> dict[str, Any]:
    """Return figures of every stage, and hours of all their steps.

    Blocks: up to minutes at the paper's sizes on a small machine, most of it backward passes.
    """
    stages = [_measured(job) for job in jobs_of(settings)]
    hours = {gpu: round(sum(stage["hours"][gpu] for stage in stages), 2) for gpu in GPUS}
    return {"stages": stages, "hours": hours, "assumed": ASSUMED, "rows": [_row(stage) for stage in stages]}


def jobs_of(settings: config.Training | config.ArigTraining) -> Iterator[Job]:
    """Yield the job of each stage, on initial weights and made-up frames."""
    torch.manual_seed(settings.seed)
    listener = settings.listener
    space = MotionSpace.of(listener)
    if isinstance(settings, config.ArigTraining):
        phase = settings.training
        student = Student(ArigModel(settings.listener))
        dyads = _made_up(phase.window_frames + FRAME_HZ, listener)
        corpus = arig.gather(dict.fromkeys(arig.SCENES, dyads), phase.window_frames, space, settings.listener)
        arig.fit_scales(student.model, corpus)
        yield arig_job(settings, student, corpus, corpus, CPU)
        return
    window = settings.listener.window_frames
    dyads = _made_up(2 * window, listener)
    plain = sfms.gather(dyads, window, space, None, settings.listener)
    model = SfmsModel(settings.listener)
    sfms.fit_scales(model, plain)
    yield tokenizer_job(settings, model, plain, plain, CPU)
    heard = sfms.gather(dyads, window, space, AudioFrontend.of(settings.listener), settings.listener)
    fit_sound(model.cpu(), (heard.frames.sound, heard.frames.heard))
    yield listener_job(settings, model, heard, heard, CPU)


def _made_up(frames: int, listener: config.Sfms | config.Arig) -> list[Dyad]:
    """Make conversations of noise, in the listener's space, or where it has events in arkit58.

    The cost of a step does not depend on the content.
    """
    rng, space = np.random.default_rng(0), MotionSpace.of(listener)
    name, rest = ("arkit58", np.full(MOTION_DIM, 0.1)) if listener.events else (space.name, space.neutral)
    found = []
    for index in range(_DYADS):
        motion, face = (rng.normal(rest, 0.05, (frames, len(rest))).astype(np.float32) for _ in range(2))
        voice, own = (rng.normal(0, 0.05, samples_of(frames, FRAME_HZ)).astype(np.float32) for _ in range(2))
        sizes = {"wav2vec2": 768, "agent_wav2vec2": 768, "mfcc78": 78}
        found.append(
            Dyad(
                name=f"made up {index}",
                audio=voice,
                speaker=face,
                listener=motion,
                listening=np.ones(frames, bool),
                space=name,
                agent_audio=own,
                features={key: rng.normal(size=(frames, size)).astype(np.float32) for key, size in sizes.items()},
                states=rng.integers(0, len(STATES), frames).astype(np.int8),
                events=tuple(ListenerEvent(kind, 0.4 + 0.1 * k, 0.4, 0.1, 1) for k, kind in enumerate(EVENT_KINDS)),
                head_of_gaze_rad=np.zeros((frames, 3), np.float32),
            )
        )
    return found


def _measured(job: Job) -> dict[str, Any]:
    """Measure one piece of a batch and the update after it; all pieces of a batch are alike."""
    batch, window = job.phase.batch, job.frames_per_step // job.phase.batch
    samples = max((n for n in range(1, batch + 1) if batch % n == 0 and n * window <= MOST_FRAMES), default=1)
    pieces = batch // samples
    piece = replace(job, phase=job.phase.model_copy(update={"batch": samples}))
    job.model.train()
    began_s = time.perf_counter()
    gradients = Gradients(piece, ProcessGroup(), 1, Path())
    with OperationCount() as count:
        loss = gradients.of(0, torch.Generator().manual_seed(job.seed))
    with OperationCount() as update:
        for one in job.optimizers:
            one.step()
    half = job.phase.precision == "bf16"
    figures = {
        "operations": pieces * count.operations + update.operations,
        "bytes": pieces * count.bytes + update.bytes,
        "calls": count.calls + update.calls,  # on a GPU the batch is one piece
        "drawn": pieces * count.drawn,
    }
    return {
        "stage": job.name,
        "steps": job.phase.steps,
        "batch": batch,
        "window_frames": window,
        "pieces": pieces,
        "params": sum(each.numel() for each in job.model.parameters()),
        "precision": job.phase.precision,
        "loss": float(loss),
        **figures,
        "here_s": round(time.perf_counter() - began_s, 2),
        "here_peak_mb": round(memory_mb("VmHWM"), 1),
        "hours": {gpu: round(job.phase.steps * _step_s(figures, of, half) / 3600, 3) for gpu, of in GPUS.items()},
    }


def _step_s(figures: dict[str, int], gpu: Gpu, half: bool) -> float:
    return max(
        figures["operations"] / (REACHED * (gpu.bf16 if half else gpu.fp32)),
        figures["bytes"] / (STREAMED * gpu.memory),
        figures["calls"] * CALL_US * 1e-6,
    )


def _row(stage: dict[str, Any]) -> dict[str, Any]:
    return {
        "stage": stage["stage"],
        "million weights": round(stage["params"] / 1e6, 1),
        "steps": stage["steps"],
        "frames a step": stage["batch"] * stage["window_frames"],
        "GFLOP a step": round(stage["operations"] / 1e9, 1),
        "GB a step": round(stage["bytes"] / 1e9, 2),
        "calls": stage["calls"],
        "here s": stage["here_s"],
        **{f"{gpu} h": hours for gpu, hours in stage["hours"].items()},
    }
