"""Joints that have no servo in this run: left out by the user, or not built yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import STOP_S, StopPolicy
from sfms_robot.servo.policy import BusServo

LEFT_OUT: Final = "left out"


class AbsentBus:
    """`ports.Bus` of joints without a servo: takes goals, sends nothing, and says so in every reading.

    Opens no port and never raises.

    Args:
        servos: in joint order; only joint names and limits count.
    """

    def __init__(self, servos: Sequence[BusServo]) -> None:
        self.joints = tuple(servo.joint for servo in servos)
        self._held = {servo.joint: min(max(0.0, servo.min_rad), servo.max_rad) for servo in servos}

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return dict.fromkeys(self.joints, frozenset[str]())

    def connect(self) -> None:
        """There is nobody to connect to."""

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        """0 rad of every joint, or the end of its range nearest to that."""
        return np.array([self._held[joint] for joint in joints])

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Nothing is sent."""

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        return {joint: Reading(None, float("inf"), LEFT_OUT) for joint in self.joints}

    def release(self, joints: Sequence[str]) -> None:
        """There is no torque."""

    def resume(self, joints: Sequence[str]) -> None:
        """There is no torque."""

    def torque_off(self, policy: StopPolicy) -> None:
        """There is no torque."""

    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """There is no torque."""

    def close(self) -> None:
        """There is no port."""

    def statistics(self) -> Mapping[str, Any]:
        return {
            "writes": 0, "reads": 0, "errors": 0, "retries": 0, "reconnects": 0, "silent": [],
            "faults": [f"{joint}: {LEFT_OUT}" for joint in self.joints],
        }  # fmt: skip
