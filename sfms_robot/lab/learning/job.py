"""Values that are passed between a trainer, the training loop `fit` and its watchers.

A trainer (SFMS phase 1, phase 2, any other) builds a `Job` and passes it to `learning.training_loop.fit`:

    torch.manual_seed(settings.seed)                       # weights of a new model
    model = MyModel(settings.listener).to(run.device)
    job = Job(
        name="mine",                                       # for the bar, the checkpoint file, the TensorBoard folder
        model=model,                                       # all of its state dict goes into checkpoints
        optimizers=[optimizer(model.parameters(), phase.learning_rate, phase.weight_decay)],
        loss_of=lambda step, generator, batch: ...,        # scalar loss on `batch` samples drawn with `generator`
        held_out=lambda: ...,                              # loss or error on the same data each time; or None
        frames_per_step=phase.batch * window,
        phase=phase,                                       # a config.Phase: steps, clipping, precision, patience, ...
        seed=settings.seed,
        identity=identity,                                 # `corpus.identity(settings, "mine", phase)`
    )
    outcome = fit(job, out, run)                           # the model now holds its best weights: save them

Six duties make a resumed run bit-identical on a CPU:
 - `loss_of` draws every random number from the generator it is given (on the CPU), from `noise_of` that generator,
   which draws on the GPU if there is one, or from torch's global one (dropout); never from numpy, the clock or another;
 - on a GPU it never makes the host wait: choices are made on the CPU and sent, losses are read later;
 - it uses the number of samples that it is given: `phase.batch`, or the part of them that is a piece of a step
   (see "Trainer's side" below), and its loss is their mean;
 - everything else that changes from step to step (an annealed temperature) depends on `step`, not on an attribute;
 - `held_out` may draw random numbers (the state is restored), but returns the same number for the same weights;
 - everything before `fit` depends on the settings and the data, and `identity` contains them as plain JSON data: a
   checkpoint with another identity is refused, with an error that names the key that differs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, Final, Literal

import torch
import torch.distributed as dist
from rich.progress import MofNCompleteColumn, TaskID, TextColumn
from torch import Generator, Tensor, nn
from torch.distributed.rendezvous import rendezvous

from sfms_robot import config
from sfms_robot.app.progress import PlainBar, TimeLeft, console, rich_bar
from sfms_robot.errors import ConfigError, GroupError, first_line, optional

PATIENCE = timedelta(minutes=30)  # of processes that wait while another evaluates held-out data or stages files


@dataclass(frozen=True)
class ProcessGroup:
    """This process, one of `size` that train together; `local_rank` is its number among those on its machine."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    restarts: int = 0

    @property
    def first(self) -> bool:
        """Return whether this process writes files and prints."""
        return self.rank == 0

    def mean(self, values: Sequence[float]) -> list[float]:
        """Return the means over all processes. Raises GroupError when one of them is gone."""
        if self.size == 1:
            return list(values)
        sums = torch.tensor(values, dtype=torch.float64, device=_device())
        with self.talking():
            dist.all_reduce(sums)
        return [float(each) / self.size for each in sums]

    def from_first(self, find: Callable[[], float]) -> float:
        """Return the result of `find` in the first process; the others wait for it."""
        if self.size == 1:
            return find()
        found = torch.tensor([find() if self.first else 0.0], dtype=torch.float64, device=_device())
        with self.talking():
            dist.broadcast(found, 0)
        return float(found)

    def wait(self) -> None:
        """Wait for all processes."""
        self.mean([0.0])

    @contextmanager
    def talking(self) -> Iterator[None]:
        """Run a part that communicates with the other processes. Raises GroupError if one of them is gone."""
        try:
            yield
        except RuntimeError as error:  # gloo and NCCL raise this and its subclasses
            if self.size == 1 or isinstance(error, torch.cuda.OutOfMemoryError):
                raise
            said = f"process {self.rank} of {self.size} has lost another one: {first_line(error)}"
            raise GroupError(said) from error


@contextmanager
def joined(device: torch.device) -> Iterator[ProcessGroup]:
    """Join the group that `torchrun` names in the environment; yield it, or this process alone.

    Raises ConfigError, GroupError.
    """
    size, restarts = _number("WORLD_SIZE", 1), _number("TORCHELASTIC_RESTART_COUNT", 0)
    if size == 1:
        yield ProcessGroup(restarts=restarts)
        return
    group = ProcessGroup(_number("RANK", 0), size, local_rank(), restarts)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    with group.talking():
        store, _, _ = next(rendezvous("env://", timeout=PATIENCE))
        # After a restart, the store of torchrun still holds addresses of the processes that died.
        store = dist.PrefixStore(f"restart {group.restarts}", store)  # type: ignore[attr-defined]
        backend = "nccl" if device.type == "cuda" else "gloo"
        dist.init_process_group(backend, timeout=PATIENCE, world_size=size, rank=group.rank, store=store)
    try:
        yield group
    finally:
        dist.destroy_process_group()


def local_rank() -> int:
    """Return the number of this process among those on its machine, which is also that of its GPU."""
    return _number("LOCAL_RANK", 0)


def _number(name: str, otherwise: int) -> int:
    text = os.environ.get(name, str(otherwise))
    if not text.isdecimal():
        raise ConfigError(f"{name}={text} in the environment: expected a number, as torchrun sets it")
    return int(text)


def _device() -> torch.device:
    return torch.device("cuda", torch.cuda.current_device()) if dist.get_backend() == "nccl" else torch.device("cpu")


# --- Trainer's side --------------------------------------------------------------------------------------------------
#
# A step's batch is cut into pieces, each drawn with its own generator; process r of W takes pieces r, r + W, ...
# A piece is the same in every process, so the losses of a run do not depend on the number of processes, up to the order
# of summation. One process with one piece computes what plain training does.

LossOf = Callable[[int, Generator, int], Tensor]


@dataclass(frozen=True, kw_only=True)
class Job:
    """One phase of training; see the module docstring.

    Attributes:
        loss_of: (step from 0, CPU generator, samples) -> scalar loss. The model is in training mode, under autocast if
            configured.
        held_out: error on held-out data, less is better. The model is in evaluation mode, gradients are off.
        frames_per_step: motion frames in a step, for the speed that is shown.
    """

    name: str
    model: nn.Module
    optimizers: Sequence[torch.optim.Optimizer]
    loss_of: LossOf
    held_out: Callable[[], float] | None
    frames_per_step: int
    phase: config.Phase
    seed: int
    identity: Mapping[str, Any]

    @property
    def device(self) -> torch.device:
        return next(self.model.parameters()).device


class OwnNoise(Generator):
    """The generator of noise that is drawn on a GPU. Noise of weight 0 is not drawn from it.

    From the run's generator, on a CPU, all noise is drawn in one order, also with weight 0: a run repeats bit for bit.
    """


def noise_of(generator: Generator, device: torch.device) -> Generator:
    """Return the generator of a step's noise on `device`: the run's own on a CPU, one seeded by it on a GPU."""
    if device.type == "cpu":
        return generator
    own = OwnNoise(device)
    own.manual_seed(int(torch.randint(2**62, (), generator=generator)))
    return own


def uniform(generator: Generator, *shape: int) -> Tensor:
    """Draw uniform numbers in 0..1, on the generator's device."""
    return torch.rand(shape, generator=generator, device=generator.device)


def normal(generator: Generator, *shape: int) -> Tensor:
    """Draw numbers of mean 0 and deviation 1, on the generator's device."""
    return torch.randn(shape, generator=generator, device=generator.device)


def is_drawn(generator: Generator, *weights: float) -> bool:
    """Return whether noise of these weights is drawn from a generator."""
    return any(weights) or not isinstance(generator, OwnNoise)


@dataclass(frozen=True, kw_only=True)
class Position:
    """State of a run after `step` steps. `loss` is smoothed; `worse` counts evaluations since the best."""

    step: int = 0
    loss: float | None = None
    held_out: float | None = None
    best: float | None = None
    best_step: int = 0
    worse: int = 0
    finished: bool = False


@dataclass(frozen=True, kw_only=True)
class Report:
    """Report to a watcher after every step. `position.held_out` is new if `looked`."""

    name: str
    steps: int
    position: Position
    loss: float
    gradient_norm: float
    learning_rate: float
    frames_per_s: float
    looked: bool


@dataclass(frozen=True, kw_only=True)
class Run:
    """Settings of running a job that do not change its weights.

    Attributes:
        watches: called after every step.
        group: the processes that run it together.
        accumulate: pieces of a step's batch that each process computes in turn; None: one, or on resuming as before.
            The number of pieces is part of a run's identity, their assignment to processes is not: a run can be
            resumed with any number of processes that can share its pieces.
        scratch: folder for frames that are read from disk as they are drawn; None: they are held in memory.
        read_every: steps whose losses are read and reported together; None: 1 on a CPU, `READ_EVERY` on a GPU,
            where reading makes the host wait.
    """

    resume: bool = False
    device: torch.device = torch.device("cpu")
    watches: Sequence[Watch] = ()
    group: ProcessGroup = ProcessGroup()
    accumulate: int | None = None
    scratch: Path | None = None
    read_every: int | None = None


ALONE: Final = Run()  # one process, on the CPU, from the first step


@dataclass(frozen=True, kw_only=True)
class TrainingOutcome:
    """Result of a run.

    `loss` is smoothed and of the last step; `held_out` is of the weights that the model now holds.
    """

    loss: float
    held_out: float | None
    steps: int
    best_step: int
    stopped: Literal["steps", "patience"]
    resumed_at: int | None


# --- Watchers of a training run: a progress bar on stderr, and curves for TensorBoard -----------------------

Watch = Callable[[Report], None]
CURVES_EVERY = 10  # steps


@contextmanager
def progress_bar() -> Iterator[Watch]:
    """Show a bar on stderr (stdout is for figures): loss, held-out loss, frames per second, time left."""
    tasks: dict[str, tuple[TaskID, TimeLeft]] = {}
    lines: dict[str, PlainBar] = {}

    def plain(report: Report) -> None:
        line = lines.setdefault(report.name, PlainBar(report.name, last=True))
        line(report.position.step, report.steps, _figures(report))

    if not console().is_terminal:
        yield plain
        return
    with rich_bar(MofNCompleteColumn(), TextColumn("{task.fields[figures]}"), transient=False) as bar:

        def watch(report: Report) -> None:
            step = report.position.step
            if report.name not in tasks:
                tasks[report.name] = bar.add_task(report.name, total=report.steps, figures="", left=""), TimeLeft()
            task, left = tasks[report.name]
            bar.update(task, completed=step, figures=_figures(report), left=left(step, report.steps))

        yield watch


def _figures(report: Report) -> str:
    """Return loss, held-out loss and speed, as the bar shows them."""
    at = report.position
    held_out = "" if at.held_out is None else f"  held out {at.held_out:.4f} (best {at.best:.4f})"
    return f"loss {at.loss:.4f}{held_out}  {report.frames_per_s:,.0f} frames/s"


@contextmanager
def tensorboard(folder: Path) -> Iterator[Watch]:
    """Write loss, held-out loss, gradient norm, learning rate and speed to `folder`/NAME. Raises MissingExtra."""
    with optional("--tensorboard"):
        from torch.utils.tensorboard import SummaryWriter
    writers: dict[str, SummaryWriter] = {}

    def watch(report: Report) -> None:
        step = report.position.step
        if report.name not in writers:
            # Curves of an interrupted run after its checkpoint are replaced.
            writers[report.name] = SummaryWriter(str(folder / report.name), purge_step=step)
        curves = {}
        if step % CURVES_EVERY == 0 or report.position.finished:
            shown = ("loss", "gradient_norm", "learning_rate", "frames_per_s")
            curves = {name: getattr(report, name) for name in shown}
        if report.looked and report.position.held_out is not None:
            curves["held_out_loss"] = report.position.held_out
        for name, value in curves.items():
            writers[report.name].add_scalar(name, value, step)

    try:
        yield watch
    finally:
        for writer in writers.values():
            writer.close()
