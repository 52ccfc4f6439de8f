"""A bus of Feetech servos.

STS and SMS (low byte first) answer a sync read, one request for all. SCS (high byte first) do not reliably, so they
are never asked to: there servos are read one by one, in rotation.
"""

from __future__ import annotations

from sfms_robot.config.wire_time import FRAMINGS
from sfms_robot.servo.chain.protocol1_bus import Protocol1Bus
from sfms_robot.servo.chain.protocol1_link import Protocol1Link
from sfms_robot.servo.chain.status_poll import GroupRead


class FeetechBus(Protocol1Bus):
    """`ports.Bus` of Feetech servos, all of one byte order."""

    family = "feetech"
    framing = FRAMINGS["feetech"]

    def _group_reader(self, link: Protocol1Link) -> GroupRead | None:
        return link.sync_read if self._tables[0].byte_order == "little" else None
