"""Progress of work that takes more than a moment, on stderr: a bar on a terminal, else a plain line now and then.

    with bar("scanning") as moved:              # moved(steps done, total steps, current item)
    for dyad in tracked(dyads, "listening"):    # the same over a sequence

The bar's marker and clock run while one step takes long, and it estimates the remaining time. Stdout is for results.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Final, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    ProgressColumn,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.progress import Progress as RichProgress

Progress = Callable[[float, float, str], None]  # steps done, total steps (0: unknown), current item

PLAIN_EVERY_S: Final = 10.0
_Item = TypeVar("_Item")


def no_progress(done: float, total: float, what: str) -> None:
    """Show no progress."""


@contextmanager
def bar(title: str, hidden: bool = False) -> Iterator[Progress]:
    """Show progress on stderr; yield the function that moves it. Bars may be nested.

    Workers of a pool show no bar; of processes that train together, only the first shows one.
    """
    if hidden or multiprocessing.parent_process() is not None or os.environ.get("RANK", "0") != "0":
        yield no_progress
    elif not console().is_terminal:
        yield PlainBar(title)
    else:
        with rich_bar(TextColumn("{task.fields[what]}", markup=False), transient=True) as shown:
            task, left = shown.add_task(title, total=None, what="", left=""), TimeLeft()
            yield lambda done, total, what: shown.update(
                task, completed=done, total=total or None, what=what, left=left(done, total)
            )


def tracked(items: Iterable[_Item], title: str, total: int | None = None) -> Iterator[_Item]:
    """Yield the items while a bar is shown. `total`: number of items, if they have no length."""
    count = total if total is not None else len(items) if isinstance(items, Collection) else 0
    with bar(title) as moved:
        for done, item in enumerate(items):
            moved(done, count, f"{done} of {count}" if count else f"{done}")
            yield item


@cache
def console() -> Console:
    """Return the console of stderr, one for all bars: rich draws bars of one console below one another."""
    return Console(stderr=True)


@contextmanager
def rich_bar(*figures: ProgressColumn, transient: bool) -> Iterator[RichProgress]:
    """Show bars on a terminal: title, bar, share, `figures`, the time so far and an estimate of the remaining time.

    Log lines appear above them.
    """
    stderr = sys.stderr
    handlers = [
        each
        for each in logging.getLogger().handlers
        if isinstance(each, logging.StreamHandler) and each.stream is stderr
    ]
    bars = RichProgress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        TaskProgressColumn("{task.percentage:.0f} %", "    "),
        *figures,
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
        console=console(),
        transient=transient,
    )
    with bars:
        for each in handlers:
            each.setStream(sys.stderr)  # the stream of rich, which prints above the bars
        try:
            yield bars
        finally:
            for each in handlers:
                each.setStream(stderr)


class TimeLeft:
    """An estimate of the remaining time, from the steps done since the first call."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s, self._began_s = now_s, now_s()
        self._first: float | None = None  # steps done at the first call, where a resumed training begins

    @property
    def passed_s(self) -> float:
        """Return the time since the beginning [s]."""
        return self._now_s() - self._began_s

    def __call__(self, done: float, total: float) -> str:
        """Return a text such as "about 40 s left"; empty while no estimate is possible."""
        self._first = done if self._first is None else self._first
        new = done - self._first
        return f"about {in_words(self.passed_s * (total - done) / new)} left" if total and new > 0 else ""


class PlainBar:
    """Lines in place of a bar, for a stderr that is not a terminal: one every `PLAIN_EVERY_S` at most.

    `last`: also print a line when all steps are done.
    """

    def __init__(self, title: str, now_s: Callable[[], float] = time.monotonic, last: bool = False) -> None:
        self._title, self._left, self._said_s, self._last = title, TimeLeft(now_s), 0.0, last

    def __call__(self, done: float, total: float, what: str) -> None:
        left, passed_s = self._left(done, total), self._left.passed_s
        ended = 0 < total <= done
        if not (self._last if ended else passed_s - self._said_s >= PLAIN_EVERY_S):
            return
        self._said_s = passed_s
        parts = [f"{done / total:.0%}" if total else "", what, "" if ended else left or f"{in_words(passed_s)} so far"]
        sys.stderr.write(f"{self._title}: {', '.join(filter(None, parts))}\n")
        sys.stderr.flush()


def in_words(seconds: float) -> str:
    """Return a length of time as "40 s", "12 min" or "3 h 5 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
