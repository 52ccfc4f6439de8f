"""`bench train`: the share of a training step, on one core, that is spent outside the model.

The time of the model is from the first call of one of its modules to the end of the backward pass. The rest draws
windows and noise, cuts and changes them, clips gradients and updates weights. Steps are those of the shipped files, on
made-up frames (`learning.train_runs`).
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_pre_hook

from sfms_robot.config import load_training
from sfms_robot.data import data_dir
from sfms_robot.lab.bench.measure import BenchResult, Row, Rows, Say, row
from sfms_robot.lab.learning.job import Job, ProcessGroup
from sfms_robot.lab.learning.train_runs import jobs_of
from sfms_robot.lab.learning.training_loop import Gradients, make_step
from sfms_robot.listeners.registry import one_thread

FILES: Final = ("arig", "sfms-small")
MOST_BESIDE: Final = {"arig": 0.15}  # largest allowed share of a step outside the model, by job


def measure(say: Say, steps: int = 12) -> BenchResult:
    """Measure `steps` of every job of the shipped files, after a first unmeasured step. Blocks for half a minute."""
    rows = Rows()
    one_thread()
    for file in FILES:
        for job in jobs_of(load_training(data_dir("configs") / "training" / f"{file}.yaml")):
            row = rows[f"train.{job.name}"] = _measured(job, steps)
            say(f"{job.name}: {row['ratio']:.1%} of a step is not the model")
    lines = [
        f"{name}: more than {most:.0%} of a step is not the model"
        for name, most in MOST_BESIDE.items()
        if rows[f"train.{name}"]["ratio"] > most
    ]
    return BenchResult.of_rows(rows, lines, passed=not lines)


def _measured(job: Job, steps: int) -> Row:
    """Return the row of a job: the time outside the model; the peer is the whole step."""
    job.model.train()
    timed, generator = _TimedGradients(job), torch.Generator().manual_seed(job.seed)
    whole_ms, beside_ms = [], []
    hook = register_module_forward_pre_hook(timed.called)
    try:
        for step in range(steps + 1):
            began_s = timed.begin()
            make_step(timed, step, generator)
            whole_ms.append((time.perf_counter() - began_s) * 1e3)
            beside_ms.append(whole_ms[-1] - timed.model_s * 1e3)
    finally:
        hook.remove()
    return row(beside_ms[1:], whole_ms[1:], "ms beside the model", "a step")


class _TimedGradients(Gradients):
    """Gradients that record the time of the model's first call in a step, and the duration of the model's work."""

    def __init__(self, job: Job) -> None:
        super().__init__(job, ProcessGroup(), 1, Path())
        self._modules = {*job.model.modules()}
        self.first_s: float | None = None
        self.model_s = 0.0

    def begin(self) -> float:
        """Begin a step; return the time."""
        self.first_s = None
        return time.perf_counter()

    def called(self, module: nn.Module, inputs: Any) -> None:
        """Record the time of the first call of a module of the model."""
        if self.first_s is None and module in self._modules:
            self.first_s = time.perf_counter()

    def of(self, step: int, generator: torch.Generator) -> Tensor:
        """Return the result of `Gradients.of`."""
        found = super().of(step, generator)
        self.model_s = 0.0 if self.first_s is None else time.perf_counter() - self.first_s
        return found
