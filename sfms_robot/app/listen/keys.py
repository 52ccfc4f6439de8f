"""Single keys of a terminal while a run goes on: no Enter, nothing echoed, and the terminal afterwards as it was.

The terminal is in cbreak mode while this program is in its foreground, so Ctrl-C, Ctrl-\\ and Ctrl-Z stay signals. In
the background it belongs to others: it is left alone, and nothing is read.
"""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, TextIO

try:
    import termios
except ImportError:  # Windows
    termios = None  # type: ignore[assignment]

ESCAPE: Final = "\x1b"
PERIOD_S: Final = 0.2  # between two looks at whether this program has come to the foreground
JOIN_S: Final = 1.0
_LOCAL, _CONTROL = 3, 6  # of what `tcgetattr` gives


class Keyboard:
    """The terminal behind a file descriptor: `take` for single keys, `give_back` for lines. From any thread.

    `leave` gives it back for good: a thread that was about to take it does not.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._usual: list[Any] | None = None
        self._left = False
        self._lock = threading.RLock()  # a signal handler may interrupt who holds it

    def take(self) -> bool:
        """Single keys from now on; False in the background. Asked again and again: a shell may set it otherwise."""
        with self._lock:
            if self._left or in_background(self._fd):
                return False
            found = termios.tcgetattr(self._fd)
            if found[_LOCAL] & termios.ICANON:
                self._usual = found
                control = list(found[_CONTROL])
                control[termios.VMIN], control[termios.VTIME] = 1, 0
                single = [*found[:_CONTROL], control]
                single[_LOCAL] &= ~(termios.ECHO | termios.ICANON)
                termios.tcsetattr(self._fd, termios.TCSANOW, single)
            return True

    def give_back(self) -> None:
        """As it was found. Idempotent."""
        with self._lock:
            if self._usual is not None and not in_background(self._fd):
                termios.tcsetattr(self._fd, termios.TCSANOW, self._usual)
            self._usual = None

    def leave(self) -> None:
        with self._lock:
            self._left = True
            self.give_back()

    @contextmanager
    def lent(self) -> Iterator[None]:
        """Given back while inside, whoever wants to take it."""
        with self._lock:
            self.give_back()
            yield

    def wait(self, over: int) -> str | None:
        """Blocks until keys are pressed or `PERIOD_S` is over: the keys, or "". None once `over` is readable.

        A sequence of several bytes (an arrow, Alt with a key) counts as the Esc that it begins with, and as that alone.
        """
        ready, _, _ = select.select([over, self._fd] if self.take() else [over], [], [], PERIOD_S)
        if over in ready:
            return None
        if self._fd not in ready:
            return ""
        read = os.read(self._fd, 64).decode("ascii", "replace")
        return None if not read else ESCAPE if ESCAPE in read else read


def in_background(fd: int) -> bool:
    """Whether the terminal `fd` belongs to another program at the moment. False for one that belongs to no shell."""
    try:
        return hasattr(os, "tcgetpgrp") and os.tcgetpgrp(fd) != os.getpgrp()
    except OSError:
        return False


def keyboard(stream: TextIO | None) -> Keyboard | None:
    """That of a terminal; None where `stream` is none, or the system (Windows) has no such terminals."""
    if termios is None or stream is None or stream.closed or not stream.isatty():
        return None
    return Keyboard(stream.fileno())


@contextmanager
def reading_keys(found: Keyboard, pressed: Callable[[str], object]) -> Iterator[None]:
    """`pressed(key)` in a thread of its own, for every key while inside."""
    ours, theirs = os.pipe()  # readable once it is over

    def work() -> None:
        try:
            while (keys := found.wait(ours)) is not None:
                for key in keys:
                    pressed(key)
        except (OSError, termios.error):  # the terminal was closed
            return

    thread = threading.Thread(target=work, name="keys", daemon=True)
    try:  # from here on: a signal may end the program before the first key
        thread.start()
        yield
    finally:
        os.close(theirs)
        if thread.ident is not None:
            thread.join(JOIN_S)
        found.leave()
        os.close(ours)
