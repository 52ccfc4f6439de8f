"""A source in a child process, so that image processing and device drivers cannot delay the servo loop.

The child runs a generator function of a module that can be imported:

    def work(argument: Any) -> Generator[Any, Any, None]: ...

Yielded values are sent to the parent; `None` is only a sign of life. Time stamps in the values are of `time.monotonic`,
which is the same clock in all processes. The result of a `yield` is the newest message of the parent, or None.

A generator that returns is finished and is not started again. When it raises, dies or sends nothing for too long, it is
started again after a pause that grows with each failure (`processes.LIMITS["source"]`).

    parent -> child    (work, argument, nice), then messages
    child -> parent    None, or (kind, value)
        value          the generator yielded `value`
        failed         it raised; `value` is the RobotError, or a text with the name and message of another error
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
    """A generator in a child process that starts at once; see the module docstring. Only `wait` and `close` block.

    Args:
        name: used in log lines and errors, such as "webcam 0".
        work, argument: the generator function and its argument; both are pickled.
        nice: increment of the process's niceness, 0 to 19, where the system supports it.
    """

    def __init__(self, name: str, work: Work, argument: Any, nice: int = 0) -> None:
        self._name, self._order = name, (work, argument, nice)
        self._sent: Any = None
        self._ended: str | None = None  # "finished" or "closed"
        self._dropped = 0  # messages dropped by earlier children
        self._first: list[Any] = []  # message received in `wait`, not yet returned by `messages`
        self._supervised = Supervised(name, LIMITS["source"], self._start)

    def wait(self, limit_s: float = START_LIMIT_S) -> None:
        """Block until the worker has sent a message.

        Raises the RobotError that the worker raised; PortError if it failed otherwise or sent nothing for `limit_s`.
        """
        message = self._supervised.child.receive(limit_s)
        failure = f"nothing came for {limit_s:g} s" if message is None else _failure(message)
        if failure is not None:
            self.close()
            raise failure if isinstance(failure, RobotError) else PortError(f"{self._name}: {failure}")
        self._first.append(message)

    def tell(self, value: Any) -> None:
        """Send a message, which becomes the result of the worker's next `yield`; sent again to a restarted worker.

        Never blocks: of the messages that the worker has not read yet, only the newest is kept.
        """
        self._sent = value
        self._supervised.child.offer(value)

    def messages(self, now_s: float) -> list[Any]:
        """Return the received values, oldest first, at most `MOST_WAITING`; restart a worker that died or hangs.

        `now_s` is a time of `time.monotonic`. Never blocks, never raises.
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
        """Return whether the worker has failed, hangs or is being started again."""
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
        """End the worker. Blocks for at most twice `CLOSE_LIMIT_S`. Idempotent."""
        self._ended = "closed"
        self._supervised.child.close(CLOSE_LIMIT_S)

    def _start(self) -> Child:
        child = Child(f"{__name__}:main", self._order, name="source", most=MOST_WAITING, quiet=True)
        if self._sent is not None:
            child.offer(self._sent)
        return child


def _failure(message: Any) -> RobotError | str | None:
    """Return the failure that a message reports, or None."""
    if isinstance(message, Ended):
        return f"its process died (exit code {message.code})"
    return message[1] if message[0] == "failed" else None


# --- Child ------------------------------------------------------------------------------------------------------------


def main() -> None:
    """Run the generator function of the first message until it returns or the pipe closes."""
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
    except Exception as error:  # of a library or a driver: the parent reports it and starts the work again
        parent.send(("failed", f"{type(error).__name__}: {error}"))
