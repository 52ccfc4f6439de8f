"""Messages into the pipe of another process, for a loop that may wait for nothing.

A picture goes at once, by who hands it over: some microseconds, and no thread that would have to be given the
interpreter in the middle of a tick. Where the pipe is full or something waits already, a thread sends it, of pictures
the newest. Everything else waits in order for that thread.
"""

from __future__ import annotations

import os
import select
import threading
from collections import deque
from collections.abc import Callable
from typing import IO, Final

THREAD: Final = "page"  # names of the threads that a page has in the run's process
_LOOK_S: Final = 0.5  # at a pipe that is full, whether it is to be closed
_AT_ONCE: Final = os.name == "posix"  # elsewhere a pipe cannot be asked not to block


class PipeWriter:
    """All methods from any thread; none blocks. What cannot be sent since the other process died is dropped.

    Args:
        pipe: its writing end; closed by the thread in the end.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._waiting: deque[bytes] = deque()
        self._tasks: deque[Callable[[], None]] = deque()
        self._picture: bytes | None = None
        self._unsent = b""  # of a message that the pipe has taken the beginning of
        self._changed = threading.Condition()
        self._closing = self._broken = False
        if _AT_ONCE:
            os.set_blocking(pipe.fileno(), False)
        threading.Thread(target=self._work, name=THREAD, daemon=True).start()

    def send(self, message: bytes) -> None:
        """In order, whole."""
        with self._changed:
            self._waiting.append(message)
            self._changed.notify()

    def send_newest(self, picture: bytes) -> None:
        """Instead of an older one that has not left yet."""
        if not self._changed.acquire(blocking=False):
            self._picture = picture  # the thread is at it, and finds it now or beside the next one
            return
        try:
            if _AT_ONCE and not (self._unsent or self._waiting or self._picture is not None):
                self._unsent = self._taken(picture)
                waits = bool(self._unsent)
            else:
                self._picture, waits = picture, True
            if waits:
                self._changed.notify()
        finally:
            self._changed.release()

    def later(self, task: Callable[[], None]) -> None:
        """Have the thread do something that takes longer than a tick has."""
        with self._changed:
            self._tasks.append(task)
            self._changed.notify()

    def close(self) -> None:
        """Once everything has been sent that waits now."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    def _work(self) -> None:
        with self._pipe:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._closing or self._something())
                    if self._broken or (self._closing and not self._something()):
                        return
                    tasks = [*self._tasks]
                    self._tasks.clear()
                for task in tasks:
                    task()
                with self._changed:
                    self._unsent = self._taken(self._unsent or self._next())
                    full = bool(self._unsent)
                if full:
                    select.select([], [self._pipe], [], _LOOK_S)

    def _something(self) -> bool:
        return bool(self._unsent or self._waiting or self._tasks or self._picture is not None)

    def _next(self) -> bytes:
        """All that waits, the newest picture behind it."""
        messages = [*self._waiting, *([] if self._picture is None else [self._picture])]
        self._waiting.clear()
        self._picture = None
        return b"".join(messages)

    def _taken(self, message: bytes) -> bytes:
        """What the pipe has not taken of it."""
        try:
            return message[os.write(self._pipe.fileno(), message) :] if message and not self._broken else b""
        except BlockingIOError:
            return message
        except (OSError, ValueError):
            self._broken = True  # its reader died: who reads from it sees that too, and says so
            return b""
