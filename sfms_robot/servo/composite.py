"""Several buses as one, addressed by joint in the order of the head.

Where time is real and there are several, each has its own writer thread and rate, so that one at 9600 baud does not
hold up the others. In virtual time they take their turns, and a run is the same every time.

Goals are limited once, at the rate of the loop, and a slower bus sends every k-th of them. Those keep the limits at its
own rate as well: finite differences of a curve are averages of its derivatives, however far apart the samples lie.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import RobotError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import Bus, StopPolicy
from sfms_robot.servo.writer import Writer


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
        place = {joint: i for i, joint in enumerate(joints)}
        self._places = {name: np.array([place[j] for j in bus.joints], np.intp) for name, bus in buses.items()}

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return {joint: what for bus in self._buses.values() for joint, what in bus.capabilities.items()}

    def connect(self) -> None:
        """Connect all; when one fails, those already open are closed again."""
        try:
            for bus in self._buses.values():
                bus.connect()
        except RobotError:
            self.close()
            raise

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        held: dict[str, float] = {}
        for bus in self._buses.values():
            mine = [joint for joint in joints if joint in bus.joints]
            if mine:
                held |= zip(mine, bus.enable(mine).tolist(), strict=True)
        return np.array([held[joint] for joint in joints])

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """As a single bus; what a bus in a thread refuses is raised by the next call."""
        if not np.isfinite(goals_rad).all():
            raise ValueError(f"goal of {self.joints[int(np.argmin(np.isfinite(goals_rad)))]} is not finite")
        for name, bus in self._buses.items():
            goals = goals_rad[self._places[name]]
            if self._rates_hz is None:
                bus.write(goals, now_s)
            else:
                if name not in self._writers:
                    self._writers[name] = Writer(bus, self._rates_hz[name])
                self._writers[name].put(goals, now_s)

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        readings: dict[str, Reading] = {}
        for name, bus in self._buses.items():
            writer = self._writers.get(name)
            if writer is None:
                readings |= bus.poll(now_s)
            else:
                unread = {joint: Reading(None, float("inf")) for joint in bus.joints}
                readings |= writer.readings(now_s) or unread
        return readings

    def stop(self, policy: StopPolicy) -> None:
        self._end_writers()
        for bus in self._buses.values():
            bus.stop(policy)

    def close(self) -> None:
        self._end_writers()
        for bus in self._buses.values():
            bus.close()

    def _end_writers(self) -> None:
        for writer in self._writers.values():
            writer.close()
        self._writers.clear()

    def statistics(self) -> Mapping[str, Any]:
        """Totals, and each bus's own under `buses`."""
        each = {name: dict(bus.statistics()) for name, bus in self._buses.items()}
        total: dict[str, Any] = {}
        for counts in each.values():
            for key, value in counts.items():
                total[key] = total[key] + value if key in total else value
        return {**total, "buses": each}
