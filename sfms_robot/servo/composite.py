"""Several buses as one, addressed by joint in the order of the head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import RobotError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import Bus, StopPolicy


class CompositeBus:
    """`ports.Bus` over named buses.

    Args:
        buses: by name; together they have exactly `joints`.
        joints: the order of `goals_rad`.
    """

    def __init__(self, buses: Mapping[str, Bus], joints: Sequence[str]) -> None:
        have = [joint for bus in buses.values() for joint in bus.joints]
        if sorted(have) != sorted(joints):
            raise ValueError(f"the buses have joints {sorted(have)}, the head has {sorted(joints)}")
        self.joints = tuple(joints)
        self._buses = dict(buses)
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
        for name, bus in self._buses.items():
            bus.write(goals_rad[self._places[name]], now_s)

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        return {joint: reading for bus in self._buses.values() for joint, reading in bus.poll(now_s).items()}

    def stop(self, policy: StopPolicy) -> None:
        for bus in self._buses.values():
            bus.stop(policy)

    def close(self) -> None:
        for bus in self._buses.values():
            bus.close()

    def statistics(self) -> Mapping[str, Any]:
        """Totals, and each bus's own under `buses`."""
        each = {name: dict(bus.statistics()) for name, bus in self._buses.items()}
        total: dict[str, Any] = {}
        for counts in each.values():
            for key, value in counts.items():
                total[key] = total[key] + value if key in total else value
        return {**total, "buses": each}
