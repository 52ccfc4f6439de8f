"""Child processes: started, supervised, connected by two pipes; process pools; and real-time priority.

A child is a new interpreter, not a copy of this program, so a script, a notebook and a thread may all start one. It has
its own session: only the parent receives Ctrl-C from a terminal, since the head must reach rest first. It ends when its
pipe is closed, so it never outlives its parent. It computes with one thread unless it sets another number: if each of
several processes had as many threads as cores, waiting threads would spin on cores that others need (OpenMP).

    parent                                   child
    Child(call, first messages)              ParentPipe()
    send     in order, each arrives     ->   receive, forward
    offer    only the newest are kept   ->
    receive, or a callback              <-   send; None is only a sign of life

Messages are pickled. `Supervised` starts a child again by one of the `LIMITS`:

    phase          begins                                  ends
    starting       the process was started                 its first message
    loading        a listener has loaded its weights       it is ready to listen
    running                                                it dies, raises, or gives no sign of life for `silent_s`
    backing off    it failed, and was killed               after a pause: starting
    given up       more than `restarts` in a minute        never

In each phase `hung` is set after `hung_s` without a sign of life, and cleared by the next one.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import queue
import select
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

# Read by OpenMP (torch), OpenBLAS (numpy, scipy) and MKL when they are loaded; onnxruntime sets its own per session.
ONE_THREAD: Final = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
START_LIMIT_S: Final = 60.0  # enough to import torch on a small board with a cold disk
_MINUTE_S: Final = 60.0
_FULL_S: Final = 0.5  # longest wait for room in a full pipe before the next attempt to write
_NON_BLOCKING: Final = os.name == "posix"  # on other systems a pipe always blocks

log = logging.getLogger(__name__)


# --- Parent -----------------------------------------------------------------------------------------------------------


class Ended(NamedTuple):
    """The last message of each child: its process has ended, with this exit code."""

    code: int


class Child:
    """A child process. No method blocks except `close`, and `receive` with a limit.

    Args:
        call: "module:function", called without arguments; the function begins with `ParentPipe()`.
        first: messages that are sent at once.
        name: name of the threads that serve its pipes.
        take: called with each message, in the reading thread; without it, messages wait for `receive`.
        kept: number of offered messages that wait while the pipe is full.
        most: number of messages that wait for `receive`; older ones are dropped and counted. 0: all wait.
        quiet: discard the child's stderr.

    Attributes:
        dropped: number of messages that were dropped before `receive`.
    """

    def __init__(
        self,
        call: str,
        *first: Any,
        name: str,
        take: Callable[[Any], None] | None = None,
        kept: int = 1,
        most: int = 0,
        quiet: bool = False,
    ) -> None:
        module, _, function = call.partition(":")
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", f"from {module} import {function}; {function}()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if quiet else None,
            start_new_session=True,
            env={**os.environ, **ONE_THREAD, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )
        assert self.process.stdin is not None and self.process.stdout is not None
        self._received = queue.SimpleQueue[Any]()
        self._take, self._most = take or self._keep, most
        self._alive = False
        self.dropped = 0
        self._writer = PipeWriter(self.process.stdin, kept, name)
        for message in first:
            self.send(message)
        self.reader = start_thread(self._read, name, self.process.stdout)

    def send(self, message: Any) -> None:
        """Send a message after all that were sent before, and before those that were offered."""
        self._writer.send(pickle.dumps(message, protocol=5))

    def offer(self, message: Any) -> int:
        """Send a message, unless `kept` newer ones come before the pipe has room. Return how many it displaced."""
        return self._writer.offer(pickle.dumps(message, protocol=5))

    def receive(self, limit_s: float = 0.0) -> Any:
        """Return the next message, `Ended` after the last one, or None if none comes within `limit_s`."""
        try:
            return self._received.get(timeout=limit_s)
        except queue.Empty:
            return None

    def gave_sign(self) -> bool:
        """Return whether any message has come since the last call."""
        alive, self._alive = self._alive, False
        return alive

    def worked_ns(self) -> int:
        """Return the processor time of its main thread so far; 0 where the system does not report it (Linux does)."""
        try:
            return int(Path(f"/proc/{self.process.pid}/schedstat").read_text().split()[0])
        except (OSError, ValueError):
            return 0

    def kill(self) -> None:
        """Kill the process. Return at once; the reading thread waits for its end."""
        self.process.kill()
        self._writer.close()

    def close(self, limit_s: float) -> None:
        """Close the pipe after all waiting messages, wait for the process to end, and kill it after `limit_s`.

        Blocks for twice `limit_s` at most. Idempotent.
        """
        self._writer.close()
        try:
            self.process.wait(limit_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            with suppress(subprocess.TimeoutExpired):  # blocked in a driver: left to the system
                self.process.wait(limit_s)

    def _read(self, pipe: IO[bytes]) -> None:
        with pipe:
            for message in _messages(pipe):
                self._alive = True
                if message is not None:
                    self._take(message)
        self._take(Ended(self.process.wait()))

    def _keep(self, message: Any) -> None:
        if self._most and self._received.qsize() >= self._most:
            self._received.get()
            self.dropped += 1
        self._received.put(message)


def _messages(pipe: IO[bytes]) -> Iterator[Any]:
    """Yield the objects that the other end pickles into a pipe, until it is closed. An incomplete one is left out."""
    with suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            yield pickle.load(pipe)


class PipeWriter:
    """The writing end of a pipe, for threads that must not wait. All methods may be called from any thread.

    While the pipe has room, the calling thread writes its message itself: some microseconds, without a switch to
    another thread. If several threads call at once, one writes the messages of all; none waits for another. When the
    pipe is full, a separate thread waits until it has room. Messages to a process that has ended are dropped.

    Args:
        pipe: is closed after `close`, once all sent messages are written.
        kept: number of offered messages that wait.
    """

    def __init__(self, pipe: IO[bytes], kept: int, name: str) -> None:
        self._pipe = pipe
        self._sent = deque[bytes]()
        self._offered = deque[bytes](maxlen=kept)
        self._rest = memoryview(b"")  # the part of a message that the pipe has not accepted yet
        self._writing = threading.Lock()
        self._full = False  # set by the thread that writes, cleared by the thread that waits for room
        self._wake = threading.Event()
        self._closing = False
        if _NON_BLOCKING:
            os.set_blocking(pipe.fileno(), False)
        start_thread(self._wait_for_room, name)

    def send(self, message: bytes) -> None:
        """Write a message after all that were sent before, and before those that were offered."""
        self._sent.append(message)
        self._advance()

    def offer(self, message: bytes) -> int:
        """Write a message unless `kept` newer ones come before there is room. Return how many older ones it dropped."""
        dropped = len(self._offered) == self._offered.maxlen
        self._offered.append(message)
        self._advance()
        return int(dropped)

    def close(self) -> None:
        """Close the pipe once all waiting messages are written."""
        self._closing = True
        self._advance()

    def _advance(self) -> None:
        if _NON_BLOCKING:
            self._write_all()
        if self._full or not _NON_BLOCKING:
            self._wake.set()

    def _write_all(self) -> None:
        """Write until nothing waits or the pipe is full; check again after the release, so no message is overlooked."""
        while not self._full and self._has_work() and self._writing.acquire(blocking=False):
            try:
                self._write_one()
            finally:
                self._writing.release()

    def _has_work(self) -> bool:
        return bool(self._rest or self._sent or self._offered or (self._closing and not self._pipe.closed))

    def _write_one(self) -> None:
        waiting = self._sent or self._offered
        if not self._rest and waiting:
            self._rest = memoryview(waiting.popleft())
        try:
            while self._rest:
                self._rest = self._rest[os.write(self._pipe.fileno(), self._rest) :]
        except BlockingIOError:
            self._full = True
        except (OSError, ValueError):  # the other process has ended, which our reading thread reports
            self._rest = memoryview(b"")
        if self._closing and not (self._rest or self._sent or self._offered):
            self._pipe.close()
            self._wake.set()

    def _wait_for_room(self) -> None:
        while not self._pipe.closed:
            self._wake.wait()
            self._wake.clear()
            while self._full:
                (room := select.poll()).register(self._pipe, select.POLLOUT)  # accepts a descriptor of any number
                room.poll(1e3 * _FULL_S)
                self._full = False
                self._write_all()
            if not _NON_BLOCKING:
                self._write_all()


# --- Supervision ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits after which a child counts as hung, is restarted or is given up. Times in seconds; inf: never.

    Attributes:
        hung_s: time without a sign of life after which it counts as hung; its begin and its end are logged once.
        silent_s: time without a sign of life, by phase, after which it is killed.
        phase_s: time since the phase began, by phase, after which it is killed, even if it gives signs of life.
        pause_s: pause from a failure to the restart; doubled by each further failure, up to `longest_pause_s`.
        steady_s: time of running that resets the pause.
        restarts: most restarts in a minute; after one more failure it is given up.
        step_s: most that one check adds to the times: a longer break between checks was a break of the parent.
    """

    hung_s: float = math.inf
    silent_s: Mapping[str, float] = field(default_factory=dict)
    phase_s: Mapping[str, float] = field(default_factory=dict)
    pause_s: float = 0.0
    longest_pause_s: float = 0.0
    steady_s: float = 10.0
    restarts: float = math.inf
    step_s: float = math.inf


LIMITS: Final[Mapping[str, Limits]] = {
    "listener": Limits(
        hung_s=1.0,
        # Starting: a listener of another package may wait for a network or a device.
        silent_s={"starting": 10.0, "loading": 3.0, "running": 3.0},
        phase_s={"starting": START_LIMIT_S, "loading": START_LIMIT_S},
        restarts=5,
    ),
    "source": Limits(silent_s={"starting": START_LIMIT_S, "running": 3.0}, pause_s=0.5, longest_pause_s=8.0),
    "page": Limits(hung_s=2.5, restarts=0, step_s=0.2),
}


class Supervised:
    """A child that is started again when it fails. It reads no clock; `check` passes the time.

    Args:
        name: name for the log.
        limits: one of `LIMITS`.
        start: starts a child; may raise OSError, which counts as another failure.

    Attributes:
        child: the newest child.
        phase: see the module's docstring.
        phase_s: time in this phase; set it to 0 while the child waits for its parent.
        hung: True if there was no sign of life for `Limits.hung_s`.
        hangs, restarts: counts so far.
    """

    def __init__(self, name: str, limits: Limits, start: Callable[[], Child]) -> None:
        self._name, self._limits, self._start = name, limits, start
        self.child = start()
        self.phase, self.phase_s = "starting", 0.0
        self.hung = False
        self.hangs = self.restarts = 0
        self._checked_s: float | None = None
        self._time_s = self._silent_s = self._restart_at_s = 0.0
        self._pause_s = limits.pause_s
        self._failed = False  # True after a failure, until the child has run steadily
        self._restarted_s = deque[float]()

    @property
    def away(self) -> bool:
        """Return whether the child is hung, failed, or restarted and not yet running."""
        failed = self.phase in ("backing off", "given up")
        return self.hung or failed or (self.restarts > 0 and self.phase != "running")

    def enter(self, phase: str) -> None:
        """Note that the child has reached a phase."""
        if phase == "running" and self._failed:
            log.info("%s: running again", self._name)
        self.phase, self.phase_s, self._silent_s = phase, 0.0, 0.0

    def check(self, now_s: float, alive: bool, failure: str | None = None) -> None:
        """Compare the child with its limits; kill and restart it as they require. Never blocks.

        Args:
            now_s: time of any clock; only the steps from one check to the next count, and a step back counts as 0.
            alive: the child has given a sign of life since the last check, or none is expected.
            failure: reason, if it has died or reports that it cannot continue; else None.
        """
        limits = self._limits
        passed_s = 0.0 if self._checked_s is None else now_s - self._checked_s
        step_s = min(max(passed_s, 0.0), limits.step_s)
        self._checked_s = now_s
        self._time_s, self.phase_s = self._time_s + step_s, self.phase_s + step_s
        self._silent_s = 0.0 if alive else self._silent_s + step_s
        if self.phase not in ("backing off", "given up"):
            if failure is None and self.phase_s > limits.phase_s.get(self.phase, math.inf):
                failure = f"{self.phase} for {self.phase_s:.0f} s"
            if failure is None and self._silent_s > limits.silent_s.get(self.phase, math.inf):
                failure = f"no sign of life for {self._silent_s:.1f} s"
            if failure is not None:
                self.fail(failure)
            else:
                self._report_hang(self._silent_s > limits.hung_s)
                if self.phase == "running" and alive and self.phase_s > limits.steady_s:
                    self._failed, self._pause_s = False, limits.pause_s
        if self.phase == "backing off" and self._time_s >= self._restart_at_s:
            self.restarts += 1
            try:
                self.child = self._start()
            except OSError as error:  # the system has no process or memory left
                self.fail(str(error))
            else:
                self.enter("starting")

    def fail(self, why: str) -> None:
        """Kill the child; the check after the pause starts another, unless there were too many restarts."""
        self.child.kill()
        self.hung = False
        while self._restarted_s and self._time_s - self._restarted_s[0] >= _MINUTE_S:
            self._restarted_s.popleft()
        if len(self._restarted_s) >= self._limits.restarts:
            log.error("%s: %s; the run continues without it", self._name, why)
            self.phase = "given up"
            return
        if self.phase == "running" or not self._failed:
            log.warning("%s: %s; restarting", self._name, why)
        self._restarted_s.append(self._time_s)
        self._restart_at_s = self._time_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, self._limits.longest_pause_s)
        self.phase, self._failed = "backing off", True

    def _report_hang(self, hung: bool) -> None:
        if hung and not self.hung:
            self.hangs += 1
            text = "%s (%s): no sign of life for %.1f s; the run continues"
            log.warning(text, self._name, self.phase, self._silent_s)
        elif self.hung and not hung:
            log.info("%s: answers again", self._name)
        self.hung = hung


# --- Child ------------------------------------------------------------------------------------------------------------


class ParentPipe:
    """The two pipes from a child to its parent. From now on, what a library prints goes to stderr.

    SIGINT is ignored: a child ends when its pipe is closed.
    """

    def __init__(self) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        self.outgoing, self.incoming = os.fdopen(os.dup(1), "wb"), os.fdopen(os.dup(0), "rb")
        os.dup2(2, 1)

    def receive(self) -> Any:
        """Return the next message. Blocks. If the parent has ended, this process exits silently."""
        for message in _messages(self.incoming):
            return message
        raise SystemExit(0)

    def forward(self, take: Callable[[Any], object], end: Callable[[], object] = lambda: os._exit(0)) -> None:
        """Pass all further messages to `take`, in a thread; then call `end`, which by default exits at once."""

        def read() -> None:
            for message in _messages(self.incoming):
                take(message)
            end()

        start_thread(read, "parent")

    def send(self, message: Any) -> None:
        """Send a message. Blocks while the pipe is full."""
        pickle.dump(message, self.outgoing, protocol=5)
        self.outgoing.flush()


def start_thread(work: Callable[..., object], name: str, *arguments: Any) -> threading.Thread:
    """Start a thread that does not keep the program alive."""
    thread = threading.Thread(target=work, args=arguments, name=name, daemon=True)
    thread.start()
    return thread


def give_way(nice: int) -> None:
    """Lower the priority of this process by `nice`, 0 to 19, if the system supports it."""
    if hasattr(os, "nice"):
        os.nice(nice)


@contextmanager
def process_pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Start a pool whose processes compute with one thread each. On leaving, tasks that have not begun are dropped."""
    from sfms_robot.signals.audio import environment  # imports numpy, which few children need

    with environment(ONE_THREAD), ExitStack() as stack:  # processes are started on demand, with the current environment
        pool = ProcessPoolExecutor(processes, get_context("spawn"))  # torch's threads do not survive a fork
        stack.callback(pool.shutdown, cancel_futures=True)
        yield pool


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# --- Real-time priority -----------------------------------------------------------------------------------------------

SWITCH_S: Final = 0.0001  # longest wait of a tick for another thread; Python's default, 5 ms, is half a tick


@contextmanager
def realtime_priority(wanted: bool = True) -> Iterator[str]:
    """Run with SCHED_FIFO if the system grants it. Yield "fifo", "not asked for", or the reason of the refusal.

    Other threads of this process (a recorder, a progress bar) also release the interpreter after `SWITCH_S`.
    """
    if not wanted:
        yield "not asked for"
        return
    usual_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        before = (os.sched_getscheduler(0) | os.SCHED_RESET_ON_FORK, os.sched_getparam(0))
        # A process that is started meanwhile, such as a restarted listener, must not compete with the loop.
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(os.sched_get_priority_min(os.SCHED_FIFO)))
        outcome = "fifo"
    except (AttributeError, OSError) as error:
        outcome = f"refused: {error}"
    try:
        yield outcome
    finally:
        if outcome == "fifo":
            os.sched_setscheduler(0, *before)
        sys.setswitchinterval(usual_s)
