"""Watchers of a training run: a progress bar on stderr, and curves for TensorBoard. They are told; nothing waits."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sfms_robot.errors import optional
from sfms_robot.lab.learning.job import Report

Watch = Callable[[Report], None]
CURVES_EVERY = 10  # steps


@contextmanager
def progress_bar() -> Iterator[Watch]:
    """A bar on stderr (stdout is for figures): loss, held-out loss, frames per second, time left."""
    tasks: dict[str, TaskID] = {}
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[figures]}"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    ) as bar:

        def watch(report: Report) -> None:
            at = report.position
            if report.name not in tasks:  # a resumed run begins where it was, so that the time left counts from there
                tasks[report.name] = bar.add_task(
                    report.name, total=report.steps, completed=at.step - 1, figures="", start=True
                )
            bar.update(tasks[report.name], completed=at.step, figures=figures(report))

        yield watch


def figures(report: Report) -> str:
    """Loss, held-out loss once there is one, and speed."""
    at = report.position
    held_out = "" if at.held_out is None else f"  held out {at.held_out:.4f} (best {at.best:.4f})"
    return f"loss {at.loss:.4f}{held_out}  {report.frames_per_s:,.0f} frames/s"


@contextmanager
def tensorboard(folder: Path) -> Iterator[Watch]:
    """Curves of loss, held-out loss, gradient norm, learning rate and speed in `folder`/NAME. Raises MissingExtra."""
    with optional("--tensorboard"):
        from torch.utils.tensorboard import SummaryWriter
    writers: dict[str, SummaryWriter] = {}

    def watch(report: Report) -> None:
        step = report.position.step
        if report.name not in writers:
            # Whatever an interrupted run drew past its checkpoint is drawn again.
            writers[report.name] = SummaryWriter(str(folder / report.name), purge_step=step)
        curves = {}
        if step % CURVES_EVERY == 0 or report.position.finished:
            curves = {
                "loss": report.loss,
                "gradient_norm": report.gradient_norm,
                "learning_rate": report.learning_rate,
                "frames_per_s": report.frames_per_s,
            }
        if report.looked and report.position.held_out is not None:
            curves["held_out_loss"] = report.position.held_out
        for name, value in curves.items():
            writers[report.name].add_scalar(name, value, step)

    try:
        yield watch
    finally:
        for writer in writers.values():
            writer.close()


def together(watches: Sequence[Watch]) -> Watch:
    """One watcher that tells several."""

    def watch(report: Report) -> None:
        for one in watches:
            one(report)

    return watch
