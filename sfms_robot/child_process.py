"""Child processes: plain interpreters that talk over stdin and stdout, and pools for work in parallel.

A child is not a copy of this program, so a script, a notebook and a thread may all start one. It has its own session:
only the parent receives Ctrl-C from a terminal, since the head must reach rest first.

Every child computes with one thread unless it asks for more. With as many threads as cores in each of several
processes, the threads of one spin in wait while another has their core (OpenMP), and everything slows down.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from typing import IO, Any, Final

# Read by OpenMP (torch), OpenBLAS (numpy, scipy) and MKL when they are loaded; onnxruntime sets its own per session.
ONE_THREAD: Final = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@contextmanager
def process_pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Start a pool whose processes compute with one thread each. On leaving, tasks that have not begun are dropped."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)  # a pool starts its processes as tasks come, with the environment of that moment
    pool = ProcessPoolExecutor(processes, get_context("spawn"))  # torch's threads do not survive a fork
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def start_child(call: str, quiet: bool = False) -> subprocess.Popen[bytes]:
    """An interpreter that calls `call`, a "module:function" without arguments, and ends.

    It finds packages wherever this process does. `quiet`: nothing it writes to stderr is shown.
    """
    module, _, function = call.partition(":")
    paths = [path for path in sys.path if path]
    return subprocess.Popen(
        [sys.executable, "-P", "-c", f"from {module} import {function}; {function}()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL if quiet else None,
        start_new_session=True,
        env={**os.environ, **ONE_THREAD, "PYTHONPATH": os.pathsep.join(paths)},
    )


def end_child(process: subprocess.Popen[bytes], limit_s: float) -> None:
    """Wait for a child whose pipe was closed, and kill it after `limit_s`, also one that is stopped.

    Blocks for twice `limit_s` at most: what a driver holds fast even then is left to the system.
    """
    try:
        process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        with suppress(subprocess.TimeoutExpired):
            process.wait(limit_s)


def take_pipes() -> tuple[IO[bytes], IO[bytes]]:
    """In the child: what comes from the parent, and what goes to it. What a library prints goes to stderr from now on.

    SIGINT is ignored: a child ends when its pipe does.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    outgoing, incoming = os.fdopen(os.dup(1), "wb"), os.fdopen(os.dup(0), "rb")
    os.dup2(2, 1)
    return incoming, outgoing


def messages(pipe: IO[bytes]) -> Iterator[Any]:
    """What the other end pickles into a pipe, until that end is gone; one that was cut short is left out. Blocks."""
    with suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            yield pickle.load(pipe)


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
