"""A bus with a thread of its own, so that a slow wire holds up nobody else.

The newest goals win: what the loop asked for while a write was going on is replaced by what it asks for now. Nothing
is sent that the loop did not ask for, so where the loop stands still the wire does, and the servos' watchdogs see it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import replace

from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import Bus


class Writer:
    """Runs from construction until `close`. What goes wrong in the thread is raised by `raise_failure`.

    Args:
        bus: enabled; nobody else may use it meanwhile, but for `torque_off`.
        rate_hz: ticks of the bus, however often goals come.
    """

    def __init__(self, bus: Bus, rate_hz: float) -> None:
        self._bus = bus
        self._period_s = 1.0 / rate_hz
        self._changed = threading.Condition()
        self._goals: tuple[Doubles, float] | None = None
        self._readings: Mapping[str, Reading] = {}
        self._read_s = 0.0
        self._back: set[str] = set()
        self._failure: Exception | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=f"bus of {bus.joints[0]}", daemon=True)
        self._thread.start()

    def put(self, goals_rad: Doubles, now_s: float) -> None:
        """Goals for the next tick of the bus. Never blocks."""
        with self._changed:
            self._goals = goals_rad.copy(), now_s
            self._changed.notify()

    def raise_failure(self) -> None:
        """Raises what ended the thread, if anything did."""
        with self._changed:
            if self._failure is not None:
                raise self._failure

    def readings(self, now_s: float) -> Mapping[str, Reading]:
        """The last ones, older by what has passed since; empty before the first tick of the bus."""
        with self._changed:
            later_s = max(0.0, now_s - self._read_s)
            out = {
                joint: replace(each, age_s=each.age_s + later_s, rejoined=joint in self._back)
                for joint, each in self._readings.items()
            }
            self._back.clear()
        return out

    def end(self) -> None:
        """Send nothing more, without waiting for the tick in progress. Idempotent."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    def close(self, timeout_s: float) -> bool:
        """`end`, and wait for the tick in progress for so long; whether it is over. Idempotent."""
        self.end()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        due_s = time.monotonic()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._goals is not None)
                # Not before its time; goals that come meanwhile replace these.
                self._changed.wait_for(lambda: self._closing, timeout=max(0.0, due_s - time.monotonic()))
                if self._closing or self._goals is None:
                    return
                (goals, now_s), self._goals = self._goals, None
            due_s = max(due_s + self._period_s, time.monotonic())
            try:
                self._bus.write(goals, now_s)
                readings = self._bus.poll(now_s)
            except Exception as error:  # handed to the loop, whichever it is
                with self._changed:
                    self._failure = error
                return
            with self._changed:
                self._readings, self._read_s = readings, now_s
                self._back |= {joint for joint, each in readings.items() if each.rejoined}
