"""Work in several processes, with a bar: the same results whatever their number."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from typing import TypeVar

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

from sfms_robot.listeners.registry import one_thread
from sfms_robot.processes import process_pool

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")


def done_in_processes(
    work: Callable[[_Task], _Result], tasks: Sequence[_Task], jobs: int | None, title: str
) -> list[_Result]:
    """`work` of every task, in their order; `jobs` processes at most, as many as there are cores if None.

    What a task raises is raised here, and ends the others. `work` is a function of a module.
    """
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    workers = min(jobs or os.cpu_count() or 1, len(tasks))
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task(title, total=len(tasks))
        if workers <= 1:
            one_thread()
            results = []
            for task in tasks:
                results.append(work(task))
                progress.advance(bar)
            return results
        with process_pool(workers) as pool:
            waiting = [pool.submit(work, task) for task in tasks]
            for done in as_completed(waiting):
                done.result()
                progress.advance(bar)
            return [one.result() for one in waiting]
