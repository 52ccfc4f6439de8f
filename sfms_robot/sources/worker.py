"""A source in a process of its own: neither pictures nor drivers may hold up the servo loop.

What runs there is a generator function of a module that can be imported; it is sent to the child by its name:

    def work(argument: Any) -> Generator[Any, Any, None]: ...

What it yields is sent to the parent; `None` says only that it is alive. It stamps what it yields with `time.monotonic`,
which is one clock for all processes. The result of a `yield` is what the parent told it last, or None.

When it returns it is finished, and is not started again. When it raises, dies or sends nothing for `silent_s`, that is
said once, and it is started again after a pause that grows, until it is back. It ends with its parent, whatever killed
that, and whatever it is in the middle of.

    parent -> child    pickle: (work, argument, nice), then whatever it is told
    child -> parent    pickle: (kind, time.monotonic, value)
        value          it yielded `value`
        failed         it raised, and value is the RobotError that says why
        broke          something else was raised, and value says what
        finished       it returned
"""

from __future__ import annotations

import logging
import os
import pickle
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Mapping
from contextlib import suppress
from typing import IO, Any, Final

from sfms_robot.child_process import end_child, messages, start_child, take_pipes
from sfms_robot.errors import PortError, RobotError

SILENT_S: Final = 3.0
START_LIMIT_S: Final = 60.0  # importing on a small board with a cold disk, and a driver that opens a device
CLOSE_LIMIT_S: Final = 0.2
FIRST_PAUSE_S: Final = 0.5  # before a restart; twice as long before each of those that follow
LONGEST_PAUSE_S: Final = 8.0
STEADY_S: Final = 10.0  # one that has run for so long begins with `FIRST_PAUSE_S` again
MOST_WAITING: Final = 256  # messages

Work = Callable[[Any], Generator[Any, Any, None]]

log = logging.getLogger(__name__)


class SourceWorker:
    """One generator in a child process that starts at once; see the module. Only `wait` and `close` block.

    Args:
        name: how the log calls it, "webcam 0".
        work, argument: what runs, and what it is told; both are pickled.
        silent_s: a worker that has sent nothing for so long hangs.
        most_waiting: messages kept for the parent; the oldest are dropped, and counted.
        nice: how far its process gives way to others, 0 to 19, where the system has that.
    """

    def __init__(
        self,
        name: str,
        work: Work,
        argument: Any,
        silent_s: float = SILENT_S,
        most_waiting: int = MOST_WAITING,
        nice: int = 0,
    ) -> None:
        self._name, self._order = name, (work, argument, nice)
        self._silent_s, self._most_waiting = silent_s, most_waiting
        self._told: Any = None
        self._state = "starting"
        self._restarts = self._failures = self._dropped = 0
        self._begins_s = time.monotonic()  # of the child in force, or of the next one
        self._child = self._start()

    def wait(self, limit_s: float = START_LIMIT_S) -> None:
        """Block until the worker has sent something.

        Raises the RobotError that it raised instead; PortError when it broke, or sent nothing for `limit_s`.
        """
        if self._state != "starting":
            return
        if not self._child.arrived.wait(limit_s):
            self.close()
            raise PortError(f"{self._name}: nothing came for {limit_s:g} s")
        kind, value = next(iter(self._child.messages), ("value", None))
        if kind == "broke":
            value = PortError(f"{self._name}: {value}")
        if isinstance(value, RobotError):
            self.close()
            raise value

    def tell(self, value: Any) -> None:
        """The worker finds it at its next `yield`, and one that is started anew from the first on. Never blocks: of
        what it has not fetched yet only the newest is kept.
        """
        self._told = value
        self._child.tell(value)

    def messages(self, now_s: float) -> list[Any]:
        """What came, oldest first, `most_waiting` at most; a worker that died or hangs is looked after.

        `now_s` is that of `time.monotonic`. Never blocks, never raises.
        """
        values = []
        for _ in range(min(self._most_waiting, len(self._child.messages))):
            kind, value = self._child.messages.popleft()
            if kind == "value":
                values.append(value)
            elif kind == "finished":
                self._state = "finished"
            elif self._state in ("starting", "running"):
                self._lose(str(value), now_s)
        self._supervise(now_s)
        return values

    @property
    def lost(self) -> bool:
        """It is away, or being started anew."""
        return self._state == "lost" or (self._restarts > 0 and self._state == "starting")

    def statistics(self) -> Mapping[str, Any]:
        """`state` (starting, running, lost, finished, closed), `restarts`, `dropped` (messages)."""
        return {"state": self._state, "restarts": self._restarts, "dropped": self._dropped + self._child.dropped}

    def close(self) -> None:
        """End the worker; blocks for twice `CLOSE_LIMIT_S` at most. Idempotent."""
        self._state = "closed"
        self._child.close()

    def _start(self) -> _Child:
        return _Child(self._order, self._most_waiting)

    def _supervise(self, now_s: float) -> None:
        heard_s = self._child.heard_s
        if self._state == "starting" and heard_s is not None:
            self._state = "running"
            if self._failures:
                log.warning("%s is back", self._name)
        if self._state == "running" and heard_s is not None and heard_s - self._begins_s > STEADY_S:
            self._failures = 0
        if self._state == "lost" and now_s >= self._begins_s:
            self._restart(now_s)
        limit_s = {"starting": START_LIMIT_S, "running": self._silent_s}.get(self._state)
        silent_s = now_s - (self._begins_s if heard_s is None else heard_s)
        if limit_s is not None and silent_s > limit_s:
            self._lose(f"nothing came for {silent_s:.1f} s", now_s)

    def _lose(self, why: str, now_s: float) -> None:
        if self._state == "running" or not self._failures:
            log.warning("%s: %s; it is tried again until it is back", self._name, why)
        self._child.kill()
        self._begins_s = now_s + min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2**self._failures)
        self._state, self._failures = "lost", self._failures + 1

    def _restart(self, now_s: float) -> None:
        self._restarts += 1
        self._dropped += self._child.dropped
        try:
            self._child = self._start()
        except OSError as error:  # no more processes, no more memory
            self._lose(str(error), now_s)
            return
        self._state, self._begins_s = "starting", now_s
        self._child.tell(self._told)


class _Child:
    """One interpreter, and the thread that reads what it sends.

    Attributes:
        messages: what came and was not taken yet; the last is of another kind than "value".
        heard_s: when the newest was sent, signs of life included; None before the first.
        arrived: set when something came.
        dropped: messages that were too many.
    """

    def __init__(self, order: tuple[Work, Any, int], most_waiting: int) -> None:
        self.messages: deque[tuple[str, Any]] = deque(maxlen=most_waiting)
        self.heard_s: float | None = None
        self.arrived = threading.Event()
        self.dropped = 0
        self.process = start_child("sfms_robot.sources.worker:main", quiet=True)
        assert self.process.stdin is not None and self.process.stdout is not None
        self._untold: deque[bytes] = deque(maxlen=1)
        self._telling = threading.Condition()
        self._open = True
        writes = (self.process.stdin, pickle.dumps(order, protocol=5))
        threading.Thread(target=self._write, args=writes, name="source", daemon=True).start()
        self._reader = threading.Thread(target=self._read, args=(self.process.stdout,), name="source", daemon=True)
        self._reader.start()

    def tell(self, value: Any) -> None:
        with self._telling:
            self._untold.append(pickle.dumps(value, protocol=5))
            self._telling.notify()

    def kill(self) -> None:
        """Returns at once; the reader sees to the rest."""
        self.process.kill()
        self._hang_up()

    def close(self) -> None:
        self._hang_up()
        end_child(self.process, CLOSE_LIMIT_S)

    def _hang_up(self) -> None:
        with self._telling:
            self._open = False
            self._telling.notify()

    def _write(self, pipe: IO[bytes], value: bytes) -> None:
        """A child that hangs does not read: this thread waits for it then, until it is killed."""
        with suppress(BrokenPipeError), pipe:  # one that died: the reader sees that too, and says so
            while self._open:
                pipe.write(value)
                pipe.flush()
                with self._telling:
                    self._telling.wait_for(lambda: self._untold or not self._open)
                    value = self._untold.pop() if self._untold else b""

    def _read(self, pipe: IO[bytes]) -> None:
        with pipe:
            for kind, sent_s, value in messages(pipe):
                if kind in ("value", "finished"):
                    self.heard_s = sent_s
                if kind != "value" or value is not None:
                    self._put(kind, value)
                self.arrived.set()
                if kind != "value":
                    break
            else:
                self._put("broke", f"its process died (exit code {self.process.wait()})")
                self.arrived.set()
        self.process.wait()

    def _put(self, kind: str, value: Any) -> None:
        self.dropped += len(self.messages) == self.messages.maxlen
        self.messages.append((kind, value))


# --- the child ------------------------------------------------------------------------------------------------------


class _Told:
    """The newest that the parent told, read by a thread of its own. The end of the pipe is the end of this process."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self.value: Any = None
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for value in messages(self._pipe):
            self.value = value
        os._exit(0)


def main() -> None:
    """Do the work that the first message names until it ends, or the pipe does."""
    incoming, outgoing = take_pipes()
    try:
        work, argument, nice = pickle.load(incoming)
    except (EOFError, pickle.UnpicklingError):
        return  # the parent ended before it said what to do
    told = _Told(incoming)
    if hasattr(os, "nice"):
        os.nice(nice)

    def say(kind: str, value: Any = None) -> None:
        pickle.dump((kind, time.monotonic(), value), outgoing, protocol=5)
        outgoing.flush()

    try:
        values = work(argument)
        with suppress(StopIteration):
            value = next(values)
            while True:
                say("value", value)
                value = values.send(told.value)
        say("finished")
    except RobotError as error:
        say("failed", error)
    except Exception as error:  # of a library or a driver: said by the parent, which starts the work again
        say("broke", f"{type(error).__name__}: {error}")
