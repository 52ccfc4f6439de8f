"""A bus of Dynamixel servos of Protocol 1.0: AX, and MX with their old firmware.

MX servos answer a bulk read, one request for all. AX servos do not, nor does a bus that has one of them: there servos
are read one by one, in rotation. Which it is, the bus finds out when it connects.
"""

from __future__ import annotations

from sfms_robot.config.wire_time import FRAMINGS
from sfms_robot.servo.chain.protocol1_bus import Protocol1Bus
from sfms_robot.servo.chain.protocol1_link import Protocol1Link
from sfms_robot.servo.chain.status_poll import GroupRead


class Dynamixel1Bus(Protocol1Bus):
    """`ports.Bus` of Dynamixel 1.0 servos."""

    family = "dynamixel"
    framing = FRAMINGS["dynamixel1"]

    def _group_reader(self, link: Protocol1Link) -> GroupRead | None:
        return link.bulk_read
