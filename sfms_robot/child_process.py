"""A process of its own for a part of the program: a plain interpreter, spoken to over its stdin and stdout.

Not a copy of this program, so a script, a notebook and a thread may all start one. It is in a session of its own:
Ctrl-C in a terminal is the parent's alone, since the head must reach rest first.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from typing import IO, Any


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
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
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
