"""What is said of the faults of servos: each once."""

from __future__ import annotations

import logging

from sfms_robot.servo.policy import BusServo

log = logging.getLogger(__name__)


class FaultReporter:
    """Logs every fault of every joint once, and keeps them for the report.

    Attributes:
        said: `joint: fault`, in the order of appearance.
    """

    def __init__(self) -> None:
        self.said: dict[str, None] = {}
        self._excused: set[tuple[str, str]] = set()

    def say(self, servo: BusServo, fault: str) -> None:
        named = f"{servo.joint}: {fault}"
        if named not in self.said:
            log.warning("%s: %s", about(servo), fault)
        self.said[named] = None

    def excuse(self, servo: BusServo, fault: str) -> None:
        if (servo.joint, fault) not in self._excused:
            self._excused.add((servo.joint, fault))
            log.info("%s reports %s, which this head's configuration allows", about(servo), fault)


def about(servo: BusServo) -> str:
    return f"{servo.joint} (id {servo.id})"
