"""The tokenizers of the tables trained one after another, or several at once in processes of their own."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from sfms_robot import config
from sfms_robot.lab.evaluation.paper.recipes import SizeName, recipes
from sfms_robot.lab.evaluation.paper.table_trainer import train
from sfms_robot.lab.learning import resume
from sfms_robot.lab.learning.job import Run, Watch, progress_bar
from sfms_robot.lab.learning.train_runs import device_of
from sfms_robot.processes import process_pool
from sfms_robot.signals.tracks import Take

WATCHED = 3  # held-out windows of which a history is kept: those that move most, one per take


@dataclass(frozen=True)
class _Order:
    """One tokenizer to train, as it travels to another process."""

    name: str
    recipe: config.Recipe
    takes: Sequence[Take]
    out: Path
    device: str
    resume: bool
    watched: Tensor


def train_all(
    names: Sequence[str],
    out: Path,
    takes: Sequence[Take],
    examples: Tensor,
    *,
    size: SizeName,
    steps: int | None,
    jobs: int,
    device: str,
    anew: bool,
) -> None:
    """Train and keep these tokenizers in `out`; what was interrupted goes on, unless all is to be done anew.

    `examples` (W, T, 58) are windows to keep a history of while learning.
    """
    known = recipes(size, steps)
    watched = _liveliest(examples)
    orders = [
        _Order(n, known[n], takes, out, device, not anew and resume.checkpoint_file(out / n, n).is_file(), watched)
        for n in names
    ]
    try:
        _one_by_one(orders) if jobs == 1 else _side_by_side(orders, jobs)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; {out} keeps what is trained: without --train the command goes on"
        ) from None


def _one_by_one(orders: Sequence[_Order]) -> None:
    with progress_bar() as watch:
        for order in orders:
            _train(order, watch)


def _side_by_side(orders: Sequence[_Order], jobs: int) -> None:
    with Progress(console=Console(stderr=True)) as bar, process_pool(jobs) as pool:
        task = bar.add_task(f"training {len(orders)} tokenizers", total=len(orders))
        for done in as_completed([pool.submit(_train, order, _unwatched) for order in orders]):
            done.result()
            bar.advance(task)


def _unwatched(report: object) -> None:
    """Ignore a report of progress: several trainings share one bar."""


def _train(order: _Order, watch: Watch) -> None:
    run = Run(order.resume, device_of(order.device), watch)
    train(order.name, order.recipe, order.takes, order.out, run, order.watched)


def _liveliest(examples: Tensor) -> Tensor:
    """A few windows spread over what moves: the liveliest, a middling one, a rather quiet one."""
    order = examples[..., 6:].var(1).mean(1).argsort(descending=True)
    places = [round(share * (len(order) - 1)) for share in (0.02, 0.3, 0.6)][:WATCHED]
    return examples[order[places]]
