"""Emergency stop: one latch, closed by whoever is near, opened by a person.

    closed     from its next tick on the loop brakes every joint as fast as its limits allow, then holds or releases it
    open       only on purpose, by who runs the head: a key, a call, the page

A latch stays closed whatever closes it again or lets go of its button. A loop that does not answer to it within
`ANSWER_S` is dead: torque goes off at once, from the thread that waits for it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from sfms_robot.ports import Bus

ANSWER_S: Final = 0.1  # ten ticks at 100 Hz

log = logging.getLogger(__name__)


class HaltLatch:
    """Closed from any thread, also from a signal handler; asked by the loop at every tick. Starts open."""

    def __init__(self) -> None:
        self._changed = threading.Condition()  # its lock may be taken twice by one thread: a handler interrupts it
        self._by: str | None = None
        self._answered = self._over = False

    @property
    def by(self) -> str | None:
        """Who closed it first; None while it is open."""
        return self._by

    def close(self, by: str) -> None:
        """Halt. What is closed already keeps who closed it first."""
        with self._changed:
            if self._by is None:
                self._by, self._answered = by, False
                self._changed.notify_all()

    def open(self) -> None:
        """A person lets the head go on. Nothing happens to a latch that is open."""
        with self._changed:
            if self._by is not None:
                self._by = None
                self._changed.notify_all()
                log.warning("halt released")

    def answer(self) -> None:
        """The loop has seen that it is closed."""
        with self._changed:
            self._answered = True
            self._changed.notify_all()

    @contextmanager
    def watched(self, bus: Bus) -> Iterator[None]:
        """While inside, a loop that does not answer in time is released."""
        thread = threading.Thread(target=self._watch, args=(bus,), name="halt", daemon=True)
        thread.start()
        try:
            yield
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()
            thread.join()

    def _watch(self, bus: Bus) -> None:
        with self._changed:
            while True:
                self._changed.wait_for(lambda: self._over or (self._by is not None and not self._answered))
                if self._over:
                    return
                if not self._changed.wait_for(lambda: self._over or self._answered or self._by is None, ANSWER_S):
                    bus.torque_off("release")
                    log.critical("halted, and the loop does not answer: torque off")
                    self._answered = True
