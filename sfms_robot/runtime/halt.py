"""Emergency stop: one latch that holds a set of causes and opens when all are cleared.

    close      from its next tick on the loop brakes every joint as fast as its limits allow, then holds or releases it
    resume     clears the causes that its door may clear; refused while a switch is still on

A door is where the request comes from: the device itself, the page or the fleet. A cause is cleared at the door that
it names, or at the device. The table of causes is in docs/safety.md. A loop that does not answer within `ANSWER_S` is
dead: torque goes off at once, from the thread that waits for the answer. The lock is held for assignments only, never
while anything is logged, read or sent.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final, Literal

from sfms_robot.errors import HaltedError
from sfms_robot.ports import Bus

Door = Literal["device", "page", "fleet"]

ANSWER_S: Final = 0.1  # ten ticks at 100 Hz
MOST_CAUSES: Final = 16  # kept by name: clients of a network choose names
JOIN_S: Final = 1.0  # for a thread whose log is held up

log = logging.getLogger(__name__)


class HaltLatch:
    """The causes of an emergency stop. Closed and resumed from any thread, looked at by the loop in every tick.

    Attributes:
        causes: names of what keeps it closed, oldest first; empty while it is open.
        switches: by name, whether a switch is on now; read before every resume.
    """

    def __init__(self) -> None:
        self.causes: tuple[str, ...] = ()
        self.switches: dict[str, Callable[[], bool]] = {}
        self._changed = threading.Condition()
        self._closed: dict[tuple[str, Door], int] = {}  # by cause and door, its newest closing
        self._closings = 0
        self._answered = self._late = self._over = False

    @property
    def by(self) -> str | None:
        """All causes in one text; None while it is open."""
        return ", ".join(self.causes) or None

    def close(self, cause: str, cleared_by: Door = "device") -> None:
        """Halt. A cause that is there already is renewed: a resume that has begun does not clear it."""
        key = cause, cleared_by
        with self._changed:
            if key not in self._closed:
                self._answered = False
                if len(self._closed) >= MOST_CAUSES:
                    key = "others", cleared_by
            self._closings += 1
            self._closed[key] = self._closings
            self._note()

    def resume(self, door: Door) -> None:
        """Clear the causes that `door` may clear (the device: all); the halt ends when no cause is left.

        Raises HaltedError, in one line that names the causes: with nothing cleared while a switch is still on or torque
        is being taken off; else for those that are left.
        """
        with self._changed:
            before = dict(self._closed)
            dead = self._late and not self._answered
        if dead:
            raise HaltedError(f"still halted by {self.by}: the loop does not answer, torque is off; end the run")
        active = [name for name, is_on in list(self.switches.items()) if is_on()]
        for name in active:
            self.close(name)
        if active:
            raise HaltedError(f"still halted: {', '.join(active)}: still on; let go of it, then resume")
        with self._changed:
            for cause, closing in before.items():
                if door in ("device", cause[1]) and self._closed.get(cause) == closing:
                    del self._closed[cause]
            left = list(self._closed)
            self._late = self._late and bool(left)
            self._note()
        if left:
            causes = ", ".join(f"{cause} (cleared at the {cleared_by})" for cause, cleared_by in left)
            raise HaltedError(f"still halted: {causes}")

    def answer(self) -> bool:
        """Note that the loop has seen it; return whether torque was taken off before that."""
        with self._changed:
            self._answered = True
            self._changed.notify_all()
            return self._late

    @contextmanager
    def watched(self, bus: Bus) -> Iterator[None]:
        """Take torque off when the loop does not answer in time, while inside."""
        thread = threading.Thread(target=self._watch, args=(bus,), name="halt", daemon=True)
        thread.start()
        try:
            yield
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()
            thread.join(JOIN_S)

    def _note(self) -> None:
        """Publish a change of the causes; the lock is held."""
        self.causes = tuple(dict.fromkeys(cause for cause, _ in self._closed))
        self._changed.notify_all()

    def _unanswered(self) -> bool:
        return bool(self._closed) and not self._answered and not self._late

    def _watch(self, bus: Bus) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._over or self._unanswered())
                if self._over:
                    return
                if self._changed.wait_for(lambda: self._over or not self._unanswered(), ANSWER_S):
                    continue
                self._late = True
            bus.torque_off("release")
            log.critical("halted, and the loop does not answer: torque off")
