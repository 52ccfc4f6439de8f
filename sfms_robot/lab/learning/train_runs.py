"""Functions behind `train`: train with a configuration and a data folder, write weights, return figures.

`train ... --dry-run`: measure one step of every stage of a training file, on made-up frames, and estimate all steps.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.app.progress import Progress, bar, no_progress
from sfms_robot.config import load_training, parse_training
from sfms_robot.config.listener import STATES
from sfms_robot.errors import ConfigError
from sfms_robot.frames import (
    CHANNEL_INDEX,
    EVENT_KINDS,
    FRAME_HZ,
    FRAME_S,
    MOTION_DIM,
    SMILE_CORNERS,
    Doubles,
    ListenerEvent,
)
from sfms_robot.lab import Figures
from sfms_robot.lab.bench.measure import memory_mb
from sfms_robot.lab.bench.operation_count import OperationCount
from sfms_robot.lab.corpora.clips import Dyad, samples_of
from sfms_robot.lab.corpora.collection import Dataset, Order, usable
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.evaluation.rollout import offline_rollout
from sfms_robot.lab.learning.arig import features as arig_features
from sfms_robot.lab.learning.arig.trainer import Student, arig_job, train_arig
from sfms_robot.lab.learning.arig.trainer import corpora as arig_corpora
from sfms_robot.lab.learning.corpus import AnyTraining, Corpus, fit_sound, without_gaze, write_pack
from sfms_robot.lab.learning.job import (
    ALONE,
    Job,
    ProcessGroup,
    Run,
    Watch,
    joined,
    local_rank,
    progress_bar,
    tensorboard,
)
from sfms_robot.lab.learning.sfms import predictor_trainer as listener
from sfms_robot.lab.learning.sfms import tokenizer_trainer as tokenizer
from sfms_robot.lab.learning.sfms.features import corpora, fit_scales, gather, tokenise
from sfms_robot.lab.learning.sfms.predictor_trainer import corrected
from sfms_robot.lab.learning.training_loop import Gradients, checkpoint_file
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.audio_frontend import AudioFrontend
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.listeners.torch_engine import torch_engine

DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options of the command line.

    `seed`, `steps`, `changes` of the listener and `phase_changes` of ARIG's training replace values of the file.
    `tensorboard` None: if installed. `order` is that of the channels in the data, if not its layout's own. `overwrite`:
    files of an earlier training in `out` may be lost. `accumulate` and `scratch`: see `learning.job.Run`.

    Several processes train together if `torchrun` starts them; only the first returns figures. Processes that torchrun
    restarts after one of them died resume from the checkpoint.
    """

    file: Path
    data: Path
    out: Path
    resume: bool = False
    device: str = "auto"
    steps: int | None = None
    seed: int | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)
    phase_changes: Mapping[str, Any] = field(default_factory=dict)
    tensorboard: bool | None = None
    order: Order | None = None
    overwrite: bool = False
    accumulate: int | None = None
    scratch: Path | None = None


def train_tokenizer(options: TrainOptions) -> Figures:
    """Train phase 1. Returns its figures and minutes."""
    settings, began_s = train_settings(options, "tokenizer"), time.monotonic()
    if isinstance(settings, config.ArigTraining):
        raise ConfigError(f"{options.file}: listener.kind = 'arig' has no tokenizer; `train listener` is all of it")
    with run_of(options, "tokenizer", tokenizer.WEIGHTS, checkpoint.WEIGHTS, checkpoint.CONFIG) as run:
        figures = tokenizer.train_tokenizer(settings, options.data, options.out, run, options.order)
    return _told(figures, run, began_s)


def train_listener(options: TrainOptions) -> Figures:
    """Train SFMS: phase 2, on the tokenizer in `options.out`; or all of ARIG. Returns its figures and minutes."""
    settings, began_s = train_settings(options, "predictor"), time.monotonic()
    if isinstance(settings, config.ArigTraining):
        if options.order is not None:
            where = "an arig listener is trained on files in their layout's own order"
            raise ConfigError(f"--order {options.order}: {where}")
        with run_of(options, "arig", checkpoint.WEIGHTS) as run:
            figures = train_arig(settings, options.data, options.out, run)
        return _told(figures, run, began_s)
    packed = options.data.is_file()
    if packed and settings.predictor.calibration_rounds:
        told = "a pack holds no dyads for the roll-outs of predictor.calibration_rounds"
        raise ConfigError(f"{options.data}: {told}: expected 0 of them, or the folder as --data")
    with run_of(options, "listener", checkpoint.WEIGHTS) as run:
        figures = listener.train_listener(settings, options.data, options.out, run, options.order)
    if run.group.first and not packed:
        calibrate(settings, options.data, options.out, options.order)
    return _told(figures, run, began_s)


def _told(figures: Figures, run: Run, began_s: float) -> Figures:
    """Return the figures and the minutes they took; {} in all processes except the first."""
    return {**figures, "minutes": round((time.monotonic() - began_s) / 60, 2)} if run.group.first else {}


def pack_data(file: Path, data: Path, out: Path, order: Order | None = None) -> Figures:
    """Write all data that training by a file reads to the pack `out`. Returns dyads, frames and bytes."""
    settings = load_training(file)
    found: Mapping[str, Corpus[Any]] = (
        arig_corpora(settings, data, ALONE)
        if isinstance(settings, config.ArigTraining)
        else corpora(settings, data, ALONE, order)
    )
    write_pack(out, found, settings)
    counts = {split: {"dyads": len(one.lengths), "frames": sum(one.lengths)} for split, one in found.items()}
    return {"out": str(out), **counts, "bytes": out.stat().st_size}


def device_of(name: str) -> torch.device:
    """Return the device of `cpu`, `cuda`, or `auto`: the GPU if there is one. Raises ConfigError."""
    if name not in DEVICES:
        raise ConfigError(f"--device {name!r} is not one of {', '.join(DEVICES)}")
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise ConfigError("--device cuda: torch sees no CUDA device here (auto, cpu)")
    return torch.device("cuda" if there and name != "cpu" else "cpu")


def train_settings(options: TrainOptions, phase: str = "training") -> AnyTraining:
    """Read the training file and apply the options; `phase` is the one whose steps they set."""
    settings = load_training(options.file)
    raw = settings.model_dump(mode="json")
    if isinstance(settings, config.ArigTraining):
        phase = "training"
    for key, value in options.changes.items():
        raw["listener"][key] = raw["listener"][key] | value if isinstance(value, Mapping) else value
    raw[phase] |= options.phase_changes
    raw["seed"] = settings.seed if options.seed is None else options.seed
    if options.steps is not None:
        raw[phase]["steps"] = options.steps
    return parse_training(raw, options.file)


@contextmanager
def run_of(options: TrainOptions, job: str, weights: str, *others: str) -> Iterator[Run]:
    """Yield the run of a job with the settings of the command line, and a progress bar.

    After a restart by torchrun it resumes from its checkpoint. Raises ConfigError if files of an earlier training of
    this job, or of `others`, would be replaced.
    """
    device, kept = device_of(options.device), checkpoint_file(options.out, job)
    with ExitStack() as stack:
        if device.type == "cuda":
            device = torch.device("cuda", local_rank())
        group = stack.enter_context(joined(device))
        watches: list[Watch] = []
        if group.first:
            installed = importlib.util.find_spec("tensorboard") is not None
            if installed if options.tensorboard is None else options.tensorboard:
                watches.append(stack.enter_context(tensorboard(options.out / "tensorboard")))
            watches.append(stack.enter_context(progress_bar()))
        if not (group.restarts or options.resume or options.overwrite):
            group.wait()  # no process has written anything yet
            for file in (options.out / weights, kept, *(options.out / name for name in others)):
                if file.exists():
                    raise ConfigError(
                        f"{file} is of an earlier training: --resume continues it, --overwrite starts again"
                    )
            group.wait()
        yield Run(
            resume=kept.exists() if group.restarts else options.resume,
            device=device,
            watches=tuple(watches),
            group=group,
            accumulate=options.accumulate,
            scratch=options.scratch,
        )


# --- Calibration of sampling -----------------------------------------------------------------------------------------
#
# Teacher forcing never shows the model its own mistakes, so in a roll-out it places keyframes somewhat too often or too
# rarely, and looks restless or frozen. A bias on class 0 per group corrects that rate. For a listener with a fixed
# course of nods and smiles, the course is the median of the data's.

DYADS = 8  # dyads that are rolled out
COURSE_DYADS = 128  # dyads whose nods and smiles are measured, without roll-outs
LEAST = 10  # events of a kind that are needed to measure its course
LARGEST_STEP = 1.0  # of a bias, per round
STREAMS = 4  # streams of every dyad, in parallel


def calibrate(training: config.Training, data: Path, out: Path, order: Order | None = None) -> None:
    """Calibrate the listener trained in `out` on some training dyads, and rewrite `out`/config.yaml.

    Blocks for minutes and shows its progress.
    """
    settings, space = training.listener, MotionSpace.of(training.listener)
    model = SfmsModel(settings)
    checkpoint.load_weights(out / checkpoint.WEIGHTS, model)
    every = open_for(space.name, data, "train", order, [settings.audio])
    some, rounds = _some(every, settings.window_frames), training.predictor.calibration_rounds
    found = corrected(training)
    with bar("calibrating by roll-outs") as moved:
        for number in range(rounds):

            def played(done: float, dyads: float, what: str, number: int = number) -> None:
                moved(number * dyads + done, rounds * dyads, f"round {number + 1} of {rounds}, {what}")

            found = placing(found, model, some, played)
    if rounds and found.events:
        found = coursed(found, _some(every, settings.window_frames, COURSE_DYADS))
    checkpoint.save_config(out, found)


def _some(dyads: Dataset, window: int, count: int = DYADS) -> list[Dyad]:
    """Return a few dyads, spread over a set, that are as long as a window; or else the first dyad that is."""
    chosen = [*usable(dyads[:: max(1, len(dyads) // count)])][:count]
    long = [dyad for dyad in chosen if len(dyad.listener) >= window]
    return long or [next(dyad for dyad in usable(dyads) if len(dyad.listener) >= window)]


def placing(
    settings: config.Sfms, model: SfmsModel, dyads: Sequence[Dyad], moved: Progress = no_progress
) -> config.Sfms:
    """Return `settings` with biases that would have given a roll-out the keyframe rates of the data.

    The model is left in evaluation mode.
    """
    listener = SfmsListener(settings, torch_engine(model.eval()))
    wanted = _rates(tokenise(model, gather(dyads, settings.window_frames, listener.space, None, settings)))
    rolled = []
    for index, dyad in enumerate(dyads):
        moved(index, len(dyads), f"dyad {index + 1} of {len(dyads)}")
        rolled.append(offline_rollout(listener, dyad, range(1 + STREAMS * index, 1 + STREAMS * (index + 1))))
    rates = _rates(torch.cat([one.tokens.flatten(0, 1) for one in rolled]))
    groups = {}
    for (name, group), has, wants in zip(settings.groups.items(), rates, wanted, strict=True):
        step = math.log(max(has, 1e-4) / (1 - has) * (1 - wants) / wants)
        bias = group.transition_bias + max(-LARGEST_STEP, min(LARGEST_STEP, step))
        groups[name] = group.model_copy(update={"transition_bias": round(bias, 3)})
    return settings.model_copy(update={"groups": groups})


def coursed(settings: config.Sfms, dyads: Sequence[Dyad]) -> config.Sfms:
    """Return `settings` with the median course of nods and smiles of `dyads`, for kinds that have enough of them."""
    nod, smile = settings.sampling.nod, settings.sampling.smile
    if nod is not None:
        falls = [fall for dyad in dyads for fall in _falls(dyad)]
        if len(falls) >= LEAST:
            nod = config.NodCourse(spread=nod.spread, fall=round(float(np.clip(np.median(falls), 0, 1)), 3))
    if smile is not None:
        found = [np.array(rows) for rows in zip(*(row for dyad in dyads for row in _smiles(dyad)), strict=True)]
        if found and len(found[0]) >= LEAST:
            rise, fall = (np.clip(np.median(rows, axis=0), 0, 1).round(3).tolist() for rows in found)
            smile = config.SmileCourse(spread=smile.spread, rise=tuple(rise), fall=tuple(fall))
    sampling = settings.sampling.model_copy(update={"nod": nod, "smile": smile})
    return settings.model_copy(update={"sampling": sampling})


def _falls(dyad: Dyad) -> Iterator[float]:
    """Yield the size of the second swing over that of the first, of each nod that has one."""
    pitch = without_gaze(dyad).listener[:, CHANNEL_INDEX["pitch"]]
    for event in dyad.events or ():
        swing = event.duration_s / event.swings / FRAME_S
        bounds = [round(event.start_s / FRAME_S + swing * number) for number in range(3)]
        if event.kind == "nod" and event.swings > 1 and bounds[0] >= 0 and bounds[2] <= len(pitch):
            first, second = (float(np.ptp(pitch[low:high])) for low, high in pairwise(bounds))
            yield second / max(first, 1e-6)


def _smiles(dyad: Dyad) -> Iterator[tuple[Doubles, Doubles]]:
    """Yield the shares of its size at `RISE_S` and `FALL_S` of each smile long enough for both, without a laugh."""
    corners = dyad.listener[:, [CHANNEL_INDEX[name] for name in SMILE_CORNERS]].mean(axis=1)
    times_s = (1 + np.arange(len(corners))) * FRAME_S
    rise_s, fall_s = np.array(config.SmileCourse.RISE_S), np.array(config.SmileCourse.FALL_S)
    laughs = [event for event in dyad.events or () if event.kind == "laugh"]
    for event in dyad.events or ():
        whole = event.duration_s >= rise_s[-1] + fall_s[-1] and event.start_s >= 0 and event.end_s <= times_s[-1]
        alone = not any(one.start_s < event.end_s and one.end_s > event.start_s for one in laughs)
        if event.kind == "smile" and whole and alone:
            at = (event.start_s + rise_s, event.end_s - fall_s)
            first, last = (np.interp(when, times_s, corners) / event.size for when in at)
            yield first, last


def _rates(tokens: Tensor) -> list[float]:
    """Return keyframes per frame of each group, in tokens (N, G)."""
    return [float(rate) for rate in (tokens > 0).float().mean(0)]


# --- Behind `--dry-run` ---------------------------------------------------------------------------------------------
#
# Operations, bytes and calls are counted, not guessed: forward and backward of a piece of the batch that is small
# enough for this machine, times the number of such pieces, and the update of all weights. A GPU's time for a step
# is then the longest of three: operations at a share of its peak, bytes at a share of its bandwidth, calls at the cost
# of one for the processor that makes them. Random numbers are drawn on the GPU (`learning.job`), with bytes and calls
# like others. The shares are assumptions and are reported with the figures.

MOST_FRAMES: Final = 1200  # largest piece: fits a small machine
REACHED: Final = 0.3  # share of a GPU's peak that is reached
STREAMED: Final = 0.7  # share of its bandwidth
CALL_US: Final = 8.0  # time of one call of torch from Python
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


def dry_run(settings: AnyTraining) -> Figures:
    """Return figures of every stage, and hours of all their steps.

    Blocks for up to minutes at the paper's sizes on a small machine, most of it for backward passes.
    """
    stages = [_measured(job) for job in jobs_of(settings)]
    hours = {gpu: round(sum(stage["hours"][gpu] for stage in stages), 2) for gpu in GPUS}
    return {"stages": stages, "hours": hours, "assumed": ASSUMED, "rows": [_row(stage) for stage in stages]}


def jobs_of(settings: AnyTraining) -> Iterator[Job]:
    """Yield the job of each stage, on initial weights and made-up frames."""
    torch.manual_seed(settings.seed)
    space = MotionSpace.of(settings.listener)
    if isinstance(settings, config.ArigTraining):
        arig, window = settings.listener, settings.training.window_frames
        student = Student(ArigModel(arig))
        scenes = dict.fromkeys(arig_features.SCENES, _made_up(window + FRAME_HZ, arig))
        corpus = arig_features.gather(scenes, window, space, arig)
        arig_features.fit_scales(student.model, corpus)
        yield arig_job(settings, student, corpus, corpus, CPU)
        return
    sfms, window = settings.listener, settings.listener.window_frames
    dyads, model = _made_up(2 * window, sfms), SfmsModel(sfms)
    plain = gather(dyads, window, space, None, sfms)
    fit_scales(model, plain)
    yield tokenizer.tokenizer_job(settings, model, plain, plain, CPU)
    heard = gather(dyads, window, space, AudioFrontend.of(sfms), sfms)
    fit_sound(model.cpu(), (heard.frames.sound, heard.frames.heard))
    yield listener.listener_job(settings, model, heard, heard, CPU)


def _made_up(frames: int, listener: config.Sfms | config.Arig) -> list[Dyad]:
    """Make conversations of noise, in the listener's space, or in arkit58 if it has events.

    The cost of a step does not depend on the content.
    """
    rng, space = np.random.default_rng(0), MotionSpace.of(listener)
    name, rest = ("arkit58", np.full(MOTION_DIM, 0.1)) if listener.events else (space.name, space.neutral)
    found = []
    for index in range(2):
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


def _measured(job: Job) -> Figures:
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
    steps_s = {
        name: max(
            figures["operations"] / (REACHED * (gpu.bf16 if half else gpu.fp32)),
            figures["bytes"] / (STREAMED * gpu.memory),
            figures["calls"] * CALL_US * 1e-6,
        )
        for name, gpu in GPUS.items()
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
        "hours": {name: round(job.phase.steps * step_s / 3600, 3) for name, step_s in steps_s.items()},
    }


def _row(stage: Figures) -> Figures:
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
