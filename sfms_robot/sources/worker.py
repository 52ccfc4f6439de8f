"""A source in a child process: neither pictures nor drivers may hold up the servo loop.

The child runs a generator function of a module that can be imported:

    def work(argument: Any) -> Generator[Any, Any, None]: ...

What it yields is sent to the parent; `None` says only that it is alive. It stamps what it yields with `time.monotonic`,
which is one clock for all processes. The result of a `yield` is the newest message of the parent, or None.

When it returns it is finished, and is not started again. When it raises, dies or sends nothing for too long, it is
started again after a pause that grows (`processes.LIMITS["source"]`).

    parent -> child    (work, argument, nice), then messages
    child -> parent    None, or (kind, value)
        value          it yielded `value`
        failed         it raised, and value is the RobotError that says why, or the name of another error
        finished       it returned
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from contextlib import suppress
from typing import Any, Final

from sfms_robot.errors import PortError, RobotError
from sfms_robot.ports import Facts
from sfms_robot.processes import LIMITS, START_LIMIT_S, Child, Ended, ParentPipe, Supervised, give_way

CLOSE_LIMIT_S: Final = 0.2
MOST_WAITING: Final = 256  # messages

Work = Callable[[Any], Generator[Any, Any, None]]


class SourceWorker:
    """One generator in a child process that starts at once; see the module. Only `wait` and `close` block.

    Args:
        name: in log lines and errors, such as "webcam 0".
        work, argument: the generator function and its argument; both are pickled.
        nice: by how much its process gives way to others, 0 to 19, where the system has that.
    """

    def __init__(self, name: str, work: Work, argument: Any, nice: int = 0) -> None:
        self._name, self._order = name, (work, argument, nice)
        self._sent: Any = None
        self._ended: str | None = None  # "finished" or "closed"
        self._dropped = 0  # by children of before
        self._first: list[Any] = []  # taken by `wait`
        self._supervised = Supervised(name, LIMITS["source"], self._start)

    def wait(self, limit_s: float = START_LIMIT_S) -> None:
        """Block until the worker has sent something.

        Raises the RobotError that it raised instead; PortError when it broke, or sent nothing for `limit_s`.
        """
        message = self._supervised.child.receive(limit_s)
        failure = f"nothing came for {limit_s:g} s" if message is None else _failure(message)
        if failure is not None:
            self.close()
            raise failure if isinstance(failure, RobotError) else PortError(f"{self._name}: {failure}")
        self._first.append(message)

    def tell(self, value: Any) -> None:
        """Send a message, which the result of the next `yield` is, also in a worker that is started again.

        Never blocks: of messages that the worker has not read yet only the newest is kept.
        """
        self._sent = value
        self._supervised.child.offer(value)

    def messages(self, now_s: float) -> list[Any]:
        """Return what came, oldest first, `MOST_WAITING` at most; restart a worker that died or hangs.

        `now_s` is that of `time.monotonic`. Never blocks, never raises.
        """
        messages, self._first = self._first, []
        child = self._supervised.child
        while len(messages) < MOST_WAITING and (message := child.receive()) is not None:
            messages.append(message)
        if any(message[0] == "finished" for message in messages):
            self._ended = "finished"
        if self._ended is None:
            failure = next(filter(None, map(_failure, messages)), None)
            alive = child.gave_sign()
            if alive and failure is None and self._supervised.phase == "starting":
                self._supervised.enter("running")
            self._supervised.check(now_s, alive, None if failure is None else str(failure))
            if self._supervised.child is not child:
                self._dropped += child.dropped
        return [message[1] for message in messages if message[0] == "value"]

    @property
    def lost(self) -> bool:
        """Return whether it is away, or being started again."""
        return self._ended is None and self._supervised.away

    def statistics(self) -> Facts:
        """Return `state` (starting, running, lost, finished, closed), `restarts`, `dropped` (messages)."""
        phase = self._supervised.phase
        return {
            "state": self._ended or ("lost" if phase == "backing off" else phase),
            "restarts": self._supervised.restarts,
            "dropped": self._dropped + self._supervised.child.dropped,
        }

    def close(self) -> None:
        """End the worker; blocks for twice `CLOSE_LIMIT_S` at most. Idempotent."""
        self._ended = "closed"
        self._supervised.child.close(CLOSE_LIMIT_S)

    def _start(self) -> Child:
        child = Child(f"{__name__}:main", self._order, name="source", most=MOST_WAITING, quiet=True)
        if self._sent is not None:
            child.offer(self._sent)
        return child


def _failure(message: Any) -> RobotError | str | None:
    """Return what a message says went wrong; None if nothing did."""
    if isinstance(message, Ended):
        return f"its process died (exit code {message.code})"
    return message[1] if message[0] == "failed" else None


# --- Child ------------------------------------------------------------------------------------------------------------


def main() -> None:
    """Do the work that the first message names until it ends, or the pipe does."""
    parent = ParentPipe()
    work, argument, nice = parent.receive()
    newest = deque[Any]([None], maxlen=1)
    parent.forward(newest.append)
    give_way(nice)
    try:
        values = work(argument)
        with suppress(StopIteration):
            value = next(values)
            while True:
                parent.send(None if value is None else ("value", value))
                value = values.send(newest[0])
        parent.send(("finished", None))
    except RobotError as error:
        parent.send(("failed", error))
    except Exception as error:  # of a library or a driver: reported by the parent, which starts the work again
        parent.send(("failed", f"{type(error).__name__}: {error}"))
