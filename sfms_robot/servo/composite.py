"""Several buses as one, addressed by joint in the order of the head.

In real time each of several buses has its own writer thread and rate, so that a bus at 9600 baud does not delay the
others. In virtual time the buses take turns, and a run is the same every time.

A bus that has failed is reported once, by `poll`, and left out from then on; the others continue. Torque off is sent to
all buses.

Goals are limited once, at the rate of the loop, and a slower bus sends every k-th of them. These goals keep the limits
also at the rate of that bus: finite differences of a curve are averages of its derivatives, for any sample interval.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from sfms_robot.data import Report
from sfms_robot.errors import BusError, RobotError
from sfms_robot.frames import Doubles, Reading, Readings
from sfms_robot.ports import STOP_S, Bus, Facts, StopPolicy
from sfms_robot.processes import start_thread

log = logging.getLogger(__name__)

_TICK_S: Final = 0.1  # share of `stop` for ticks in progress in the writers, and for sending torque off
FAILED: Final = "bus failed"


class Writer:
    """A thread for one bus, from construction until `close`. `readings` raises the exception that ended it.

    Only the newest goals are sent: goals that arrive while a write is in progress replace one another. Nothing is sent
    without new goals from the loop: if the loop stops, the wire falls silent and the servos' watchdogs react.

    Args:
        bus: enabled; no other thread may use it meanwhile, except for `torque_off`.
        rate_hz: highest rate of ticks of the bus, for any rate of goals.
    """

    def __init__(self, bus: Bus, rate_hz: float) -> None:
        self._bus = bus
        self._period_s = 1.0 / rate_hz
        self._changed = threading.Condition()
        self._goals: tuple[Doubles, float] | None = None
        self._readings: Readings = {}
        self._read_s = 0.0
        self._back = set[str]()
        self._failure: Exception | None = None
        self._closing = False
        self._thread = start_thread(self._run, f"bus of {bus.joints[0]}")

    def put(self, goals_rad: Doubles, now_s: float) -> None:
        """Set the goals of the next tick of the bus. Never blocks."""
        with self._changed:
            self._goals = goals_rad.copy(), now_s
            self._changed.notify()

    def readings(self, now_s: float) -> Readings:
        """Return the last readings, with their ages at `now_s`; empty before the first tick of the bus.

        Raises the exception that ended the thread, if there is one.
        """
        with self._changed:
            if self._failure is not None:
                raise self._failure
            later_s = max(0.0, now_s - self._read_s)
            out = {
                joint: replace(each, age_s=each.age_s + later_s, rejoined=joint in self._back)
                for joint, each in self._readings.items()
            }
            self._back.clear()
        return out

    def end(self) -> None:
        """Make the thread end after the tick in progress, without waiting for it. Idempotent."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    def close(self, timeout_s: float) -> bool:
        """Call `end` and wait at most `timeout_s` for the thread; return whether it has ended. Idempotent."""
        self.end()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        due_s = time.monotonic()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._goals is not None)
                # Wait until the tick is due; goals that arrive meanwhile replace these.
                self._changed.wait_for(lambda: self._closing, timeout=max(0.0, due_s - time.monotonic()))
                if self._closing or self._goals is None:
                    return
                (goals, now_s), self._goals = self._goals, None
            due_s = max(due_s + self._period_s, time.monotonic())
            try:
                self._bus.write(goals, now_s)
                readings = self._bus.poll(now_s)
            except Exception as error:  # any exception is raised again in the loop's thread
                with self._changed:
                    self._failure = error
                return
            with self._changed:
                self._readings, self._read_s = readings, now_s
                self._back |= {joint for joint, each in readings.items() if each.rejoined}


class CompositeBus:
    """`ports.Bus` over named buses.

    Args:
        buses: by name; together they have exactly `joints`.
        joints: the order of `goals_rad`.
        rates_hz: rate of each bus, which then runs in a thread from the first goal on. None: all buses run in turn.
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
        self._failures: dict[str, Exception] = {}  # by bus
        self._unreported: list[str] = []  # failed buses that `poll` has yet to report
        place = {joint: i for i, joint in enumerate(joints)}
        self._places = {name: np.array([place[j] for j in bus.joints], np.intp) for name, bus in buses.items()}

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return {joint: what for bus in self._buses.values() for joint, what in bus.capabilities.items()}

    def connect(self) -> None:
        """Connect all buses; if one fails, close all that are already open."""
        self._failures.clear()
        self._unreported.clear()
        try:
            for bus in self._buses.values():
                bus.connect()
        except RobotError:
            self.close()
            raise

    def enable(self, joints: Sequence[str]) -> Doubles:
        """Enable joints, see `ports.Bus`: one bus after the other, for supplies that cannot start many servos at once.

        The thread of a bus is ended first; the next goals start a new one. Joints of a failed bus count as absent.
        """
        held = dict.fromkeys(joints, 0.0)
        for name, bus in self._working():
            mine = [joint for joint in joints if joint in bus.joints]
            if mine and self._ended(name, time.monotonic() + STOP_S):
                held |= zip(mine, bus.enable(mine).tolist(), strict=True)
        return np.array([held[joint] for joint in joints])

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Write to all buses that work. `poll` raises an exception of a thread."""
        if not np.isfinite(goals_rad).all():
            raise ValueError(f"goal of {self.joints[int(np.argmin(np.isfinite(goals_rad)))]} is not finite")
        refused: ValueError | None = None
        for name, bus in self._working():
            goals = goals_rad[self._places[name]]
            try:
                if self._rates_hz is None:
                    bus.write(goals, now_s)
                    continue
                if name not in self._writers:
                    self._writers[name] = Writer(bus, self._rates_hz[name])
                self._writers[name].put(goals, now_s)
            except ValueError as error:  # the other buses still get their goals
                refused = refused or error
            except Exception as error:  # any other exception concerns this bus alone
                self._fail(name, error)
        if refused is not None:
            raise refused

    def poll(self, now_s: float) -> Readings:
        """Return all readings. Raises BusError once for a bus that has failed; the next call polls the others."""
        readings: dict[str, Reading] = {}
        for name, bus in self._buses.items():
            if name not in self._failures:
                try:
                    readings |= self._read(name, bus, now_s)
                except Exception as error:
                    self._fail(name, error)
            if name in self._failures:
                readings |= {joint: Reading(None, float("inf"), FAILED) for joint in bus.joints}
        if self._unreported:
            name = self._unreported.pop(0)
            raise BusError(str(self._failures[name])) from self._failures[name]
        return readings

    def release(self, joints: Sequence[str]) -> None:
        """Release joints, see `ports.Bus`, on every bus that works, from the caller's thread."""
        for _, bus in self._working():
            bus.release([joint for joint in joints if joint in bus.joints])

    def resume(self, joints: Sequence[str]) -> None:
        """Bring joints back, see `ports.Bus`, on every bus that works."""
        for _, bus in self._working():
            bus.resume([joint for joint in joints if joint in bus.joints])

    def torque_off(self, policy: StopPolicy) -> None:
        """Send torque off, see `ports.Bus`, on every bus, from the caller's thread."""
        for bus in self._buses.values():
            bus.torque_off(policy)

    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """Send torque off on all buses without waiting for their writers; then let each bus confirm it.

        In real time the buses confirm at the same time, in threads; in virtual time one after the other, each in its
        share of the time. Never raises; blocks `within_s` at most, in real time also if a bus hangs in a system call.
        """
        began_s = time.monotonic()
        for writer in self._writers.values():
            writer.end()
        self.torque_off(policy)
        free = {name: self._buses[name] for name in self._buses if self._ended(name, began_s + _TICK_S)}
        for thread in self._stops:  # left from an interrupted call of `stop`: only one thread may use a bus
            thread.join(max(0.0, began_s + within_s - time.monotonic()))
        if self._rates_hz is None:
            for bus in free.values():
                bus.stop(policy, (within_s - _TICK_S) / len(free))
            return
        self._stops = []
        for bus in free.values():
            self._stops.append(start_thread(bus.stop, "stop", policy))
        for name, thread in zip(free, self._stops, strict=True):
            thread.join(max(0.0, began_s + within_s - time.monotonic()))
            if thread.is_alive():
                log.warning("bus %r: does not confirm in time that its torque is off", name)

    def _ended(self, name: str, until_s: float) -> bool:
        """End the writer of a bus, waiting until `until_s` at most; return whether no thread uses the bus any more."""
        writer = self._writers.get(name)
        if writer is None or writer.close(max(0.0, until_s - time.monotonic())):
            self._writers.pop(name, None)
            return True
        log.warning("bus %r: does not finish its tick; torque off was sent but is not confirmed", name)
        return False

    def close(self) -> None:
        """Close all ports. Blocks for the ticks in progress in the writers, `STOP_S` at most."""
        until_s = time.monotonic() + STOP_S
        for writer in self._writers.values():
            writer.end()
        for name, bus in self._buses.items():
            self._ended(name, until_s)
            bus.close()

    def statistics(self) -> Facts:
        """Return totals, and under `buses` the statistics of each bus."""
        each = {name: dict(bus.statistics()) for name, bus in self._buses.items()}
        total: Report = {"torque_unconfirmed": []}
        for counts in each.values():
            for key, value in counts.items():
                total[key] = total[key] + value if key in total else value
        return {**total, "buses": each}

    def _working(self) -> list[tuple[str, Bus]]:
        return [(name, bus) for name, bus in self._buses.items() if name not in self._failures]

    def _read(self, name: str, bus: Bus, now_s: float) -> Readings:
        writer = self._writers.get(name)
        if writer is None:
            return bus.poll(now_s)
        return writer.readings(now_s) or {joint: Reading(None, float("inf")) for joint in bus.joints}

    def _fail(self, name: str, error: Exception) -> None:
        log.error("bus %r has failed, the others continue: %s", name, error)
        self._failures[name] = error
        self._unreported.append(name)
