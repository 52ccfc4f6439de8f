"""A process and all that it starts, held to a share of one core: a slower computer, made of this one.

They stay on one core, and are awake for a share of every `SLICE_S`: stopped for the rest of it (SIGSTOP, SIGCONT). A
computer that is slower is so evenly; here a tick may find its process asleep, and is late by as much as a slice for
that alone. What is due while nobody is awake is not made up for, so the share is never more than was asked for. Linux.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from sfms_robot.errors import ConfigError
from sfms_robot.lab.bench.procfs import children_of, processor_time_s
from sfms_robot.processes import realtime_priority

SLICE_S: Final = 0.008  # no multiple of a tick: a tick is not always met at the same place of it
LOOK_S: Final = 0.2  # for processes that were started since


def check() -> None:
    """Raises ConfigError where processes cannot be held here."""
    if not Path("/proc/self/task").is_dir() or not hasattr(os, "sched_setaffinity"):
        raise ConfigError("bench throttle: holding processes to a share of a core takes Linux (/proc, SIGSTOP)")
    if len(os.sched_getaffinity(0)) < 2:
        raise ConfigError("bench throttle: takes two cores, one for the run and one for who holds it and the servos")


@contextmanager
def on_cores(cores: set[int]) -> Iterator[None]:
    """This thread, and what it starts, on these cores while inside."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def processes_of(pid: int) -> list[int]:
    """A process and all that it has started, and they, as far as they live."""
    found, ahead = [], [pid]
    while ahead:
        one = ahead.pop()
        found.append(one)
        with suppress(OSError):
            ahead += children_of(one)
    return found


def used_s(pids: Sequence[int]) -> dict[int, float]:
    """Processor time of each that lives."""
    used = {}
    for pid in pids:
        with suppress(OSError):
            used[pid] = processor_time_s(pid)
    return used


class Tree:
    """`sys.executable ARGUMENTS` and all that it starts, from its first instruction on.

    Args:
        share: of a core that they get; None: all that there is.

    Attributes:
        used_s: processor time of all of them, as of the last look.
    """

    def __init__(self, arguments: Sequence[str], share: float | None, **popen: Any) -> None:
        if share is not None:
            check()
        cores = os.sched_getaffinity(0)
        with on_cores(cores if share is None else {min(cores)}):
            self.process = subprocess.Popen([sys.executable, *arguments], **popen)
        self._share = share
        self._pids = [self.process.pid]
        self._used_s: dict[int, float] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._hold, args=(cores - {min(cores)},), daemon=True)
        self._thread.start()

    @property
    def used_s(self) -> float:
        return sum(self._used_s.values())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, tb: TracebackType | None) -> None:
        self._over.set()
        self._thread.join()
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    def _hold(self, cores: set[int]) -> None:
        """Until the end: awake, asleep, awake; at last awake for good."""
        if self._share is None:
            while not self._over.wait(LOOK_S):
                self._look()
            return
        awake_s = self._share * SLICE_S
        with on_cores(cores), realtime_priority():
            begins_s = looked_s = time.monotonic()
            try:
                while not self._over.is_set() and self.process.poll() is None:
                    self._send(signal.SIGCONT)
                    time.sleep(awake_s)
                    self._send(signal.SIGSTOP)
                    now_s = time.monotonic()
                    if now_s - looked_s >= LOOK_S:
                        looked_s = now_s
                        self._look()
                    begins_s = max(begins_s + SLICE_S, now_s)
                    time.sleep(max(0.0, begins_s - time.monotonic()))
            finally:
                self._send(signal.SIGCONT)

    def _look(self) -> None:
        self._pids = processes_of(self.process.pid)
        self._used_s |= used_s(self._pids)

    def _send(self, number: signal.Signals) -> None:
        for pid in self._pids:
            with suppress(OSError):
                os.kill(pid, number)
