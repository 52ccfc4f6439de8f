"""`bench train`: a step of every stage of the trainings that fit this machine, beside plain matrix products.

A step is the whole of it, as in `train`: drawing data, loss, gradients, clipping, optimizer. The peer is as many
operations in products of square matrices, one after the other: the best that torch reaches on this machine. The frames
are random, since the cost of a step does not depend on them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import torch

from sfms_robot.config import load_training
from sfms_robot.data import data_dir
from sfms_robot.lab.bench.measure import Row, row, times
from sfms_robot.lab.bench.operation_count import OperationCount
from sfms_robot.lab.learning.dry_run import jobs_of
from sfms_robot.lab.learning.job import Job, ProcessGroup
from sfms_robot.lab.learning.training_loop import Gradients, make_step

_FILES: Final = ("sfms-small", "arig")
_STEPS: Final = 8
_LIMIT_S: Final = 8.0  # for the steps of one stage
_SIDE: Final = 768  # of the peer's matrices: they fit no cache of one core, and are large enough to be quick
_PRODUCTS: Final = 20


def measure(say: Callable[[str], None]) -> dict[str, Row]:
    """Return one row per stage; takes a minute."""
    left, right = torch.rand(_SIDE, _SIDE), torch.rand(_SIDE, _SIDE)  # fp32, with the threads of a training
    product_s = sorted(times(lambda: left @ right, _PRODUCTS))[_PRODUCTS // 2] * 1e-3
    rows = {}
    for file in _FILES:
        settings = load_training(data_dir("configs") / "training" / f"{file}.yaml")
        for stage, job, _ in jobs_of(settings):
            name = f"train.{file}" if stage == "arig" else f"train.{file}.{stage}"
            say(name)
            rows[name] = _steps(job, product_s)
    return rows


def _steps(job: Job, product_s: float) -> Row:
    """Measure steps of one stage beside products of as many operations."""
    generator = torch.Generator().manual_seed(job.seed)
    job.model.train()
    with TemporaryDirectory() as scratch:
        gradients = Gradients(job, ProcessGroup(), 1, Path(scratch))
        with OperationCount() as count:  # also the first, which is slower
            make_step(gradients, 0, generator)
        taken_ms: list[float] = []
        began_s = time.perf_counter()
        while len(taken_ms) < _STEPS and time.perf_counter() - began_s < _LIMIT_S:
            step_s = time.perf_counter()
            make_step(gradients, 1 + len(taken_ms), generator)
            taken_ms.append((time.perf_counter() - step_s) * 1e3)
    products_ms = count.matrix / (2 * _SIDE**3) * product_s * 1e3
    found = row(taken_ms, [products_ms], "ms a step", f"{count.matrix / 1e9:.1f} GFLOP as plain products")
    return found | {
        "steps_per_s": round(1e3 / found["median"], 2),
        "frames_per_s": round(1e3 / found["median"] * job.frames_per_step),
    }
