"""Several buses as one, addressed by joint in the order of the head.

Where time is real and there are several, each has its own writer thread and rate, so that one at 9600 baud does not
hold up the others. In virtual time they take their turns, and a run is the same every time.

A bus that has failed is said once, by `poll`, and left out from then on: the others go on. Torque off reaches all.

Goals are limited once, at the rate of the loop, and a slower bus sends every k-th of them. Those keep the limits at its
own rate as well: finite differences of a curve are averages of its derivatives, however far apart the samples lie.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import BusError, RobotError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import STOP_S, Bus, StopPolicy
from sfms_robot.servo.writer import Writer

log = logging.getLogger(__name__)

_TICK_S: Final = 0.1  # of `stop`, for the tick that a writer is in, and for saying torque off
FAILED: Final = "bus failed"


class CompositeBus:
    """`ports.Bus` over named buses.

    Args:
        buses: by name; together they have exactly `joints`.
        joints: the order of `goals_rad`.
        rates_hz: of each bus, which then runs in a thread of its own from the first goal on. None: all in turn.
    """

    def __init__(
        self, buses: Mapping[str, Bus], joints: Sequence[str], rates_hz: Mapping[str, float] | None = None
    ) -> None:
        have = [joint for bus in buses.values() for joint in bus.joints]
        if sorted(have) != sorted(joints):
            raise ValueError(f"the buses have joints {sorted(have)}, the head has {sorted(joints)}")
        self.joints = tuple(joints)
        self._buses = dict(buses)
        self._rates_hz = rates_hz
        self._writers: dict[str, Writer] = {}
        self._stops: list[threading.Thread] = []
        self._failures: dict[str, Exception] = {}  # by bus; said once
        self._unsaid: list[str] = []
        self._last: dict[str, Mapping[str, Reading]] = {}
        place = {joint: i for i, joint in enumerate(joints)}
        self._places = {name: np.array([place[j] for j in bus.joints], np.intp) for name, bus in buses.items()}

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return {joint: what for bus in self._buses.values() for joint, what in bus.capabilities.items()}

    def connect(self) -> None:
        """Connect all; when one fails, those already open are closed again."""
        self._failures.clear()
        self._unsaid.clear()
        try:
            for bus in self._buses.values():
                bus.connect()
        except RobotError:
            self.close()
            raise

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        """As `ports.Bus`; one bus after the other, for supplies that dislike many at once.

        A bus that has a thread of its own goes on in a new one. Joints of a bus that has failed count as absent.
        """
        held: dict[str, float] = dict.fromkeys(joints, 0.0)
        for name, bus in self._working():
            mine = [joint for joint in joints if joint in bus.joints]
            if mine and self._ended(name, time.monotonic() + STOP_S):
                held |= zip(mine, bus.enable(mine).tolist(), strict=True)
        return np.array([held[joint] for joint in joints])

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """As a single bus, to all that work. What goes wrong in a thread is raised by `poll`."""
        if not np.isfinite(goals_rad).all():
            raise ValueError(f"goal of {self.joints[int(np.argmin(np.isfinite(goals_rad)))]} is not finite")
        refused: ValueError | None = None
        for name, bus in self._working():
            goals = goals_rad[self._places[name]]
            try:
                if self._rates_hz is None:
                    bus.write(goals, now_s)
                else:
                    self._writer(name, bus).put(goals, now_s)
            except ValueError as error:  # the others have theirs all the same
                refused = refused or error
            except Exception as error:  # whatever it is, it is this bus's alone
                self._fail(name, error)
        if refused is not None:
            raise refused

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        """As a single bus. Raises BusError once for a bus that has failed; the next call goes on with the others."""
        readings: dict[str, Reading] = {}
        for name, bus in self._buses.items():
            if name not in self._failures:
                try:
                    self._last[name] = self._read(name, bus, now_s)
                except Exception as error:
                    self._fail(name, error)
            if name in self._failures:
                readings |= {joint: Reading(None, float("inf"), FAILED) for joint in bus.joints}
            else:
                readings |= self._last[name]
        if self._unsaid:
            name = self._unsaid.pop(0)
            raise BusError(str(self._failures[name])) from self._failures[name]
        return readings

    def release(self, joints: Sequence[str]) -> None:
        """As `ports.Bus`, on every bus that works, from the caller's thread."""
        for _, bus in self._working():
            bus.release([joint for joint in joints if joint in bus.joints])

    def resume(self, joints: Sequence[str]) -> None:
        """As `ports.Bus`, on every bus that works."""
        for _, bus in self._working():
            bus.resume([joint for joint in joints if joint in bus.joints])

    def torque_off(self, policy: StopPolicy) -> None:
        """As `ports.Bus`, on every bus, from the caller's thread."""
        for bus in self._buses.values():
            bus.torque_off(policy)

    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """Torque off on all buses first, whatever their writers are doing; then each bus confirms: all at once where
        they have threads, else one after the other, each in its share of the time. Never raises; `within_s` at most,
        with threads for a bus that hangs in a system call too.
        """
        began_s = time.monotonic()
        for writer in self._writers.values():
            writer.end()
        self.torque_off(policy)
        free = {name: self._buses[name] for name in self._buses if self._ended(name, began_s + _TICK_S)}
        for thread in self._stops:  # of a call that an interrupt cut short: a bus has one user at a time
            thread.join(max(0.0, began_s + within_s - time.monotonic()))
        if self._rates_hz is None or not self._writers:
            for bus in free.values():
                bus.stop(policy, (within_s - _TICK_S) / len(free))
            return
        self._stops = [_begin(bus.stop, policy) for bus in free.values()]
        for name, thread in zip(free, self._stops, strict=True):
            thread.join(max(0.0, began_s + within_s - time.monotonic()))
            if thread.is_alive():
                log.warning("bus %r: does not confirm in time that its torque is off", name)

    def _ended(self, name: str, until_s: float) -> bool:
        """Whether nobody else uses the bus any more."""
        writer = self._writers.get(name)
        if writer is None or writer.close(max(0.0, until_s - time.monotonic())):
            self._writers.pop(name, None)
            return True
        log.warning("bus %r: hangs in the middle of a tick; its torque-off was sent, and is not confirmed", name)
        return False

    def close(self) -> None:
        """Give all ports back. Blocks for the tick that a writer is in, `STOP_S` at most."""
        until_s = time.monotonic() + STOP_S
        for writer in self._writers.values():
            writer.end()
        for name, bus in self._buses.items():
            self._ended(name, until_s)
            bus.close()

    def statistics(self) -> Mapping[str, Any]:
        """Return totals, and each bus's own under `buses`."""
        each = {name: dict(bus.statistics()) for name, bus in self._buses.items()}
        total: dict[str, Any] = {"torque_unconfirmed": []}
        for counts in each.values():
            for key, value in counts.items():
                total[key] = total[key] + value if key in total else value
        return {**total, "buses": each}

    def _working(self) -> list[tuple[str, Bus]]:
        return [(name, bus) for name, bus in self._buses.items() if name not in self._failures]

    def _writer(self, name: str, bus: Bus) -> Writer:
        if name not in self._writers:
            self._writers[name] = Writer(bus, (self._rates_hz or {})[name])
        return self._writers[name]

    def _read(self, name: str, bus: Bus, now_s: float) -> Mapping[str, Reading]:
        writer = self._writers.get(name)
        if writer is None:
            return bus.poll(now_s)
        writer.raise_failure()
        return writer.readings(now_s) or {joint: Reading(None, float("inf")) for joint in bus.joints}

    def _fail(self, name: str, error: Exception) -> None:
        log.error("bus %r has failed, the others go on: %s", name, error)
        self._failures[name] = error
        self._unsaid.append(name)


def _begin(stop: Callable[[StopPolicy], None], policy: StopPolicy) -> threading.Thread:
    thread = threading.Thread(target=stop, args=(policy,), daemon=True)
    thread.start()
    return thread
