"""A bus of servos that speak the FF FF frame and have no watchdog: what Dynamixel 1.0 and Feetech have in common.

What it promises stands in `chain_bus`. Where the family can, all servos are read by one request, and those behind a
silent one by a second. Where it cannot, they are read one by one, as many per poll as the budget allows, in rotation.
These servos switch their torque on by themselves when they are given a goal: withholding goals is what keeps a limp
one limp.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.servo.chain.chain_bus import ChainBus
from sfms_robot.servo.chain.protocol1_link import Family, Protocol1Link
from sfms_robot.servo.chain.protocol1_startup import Protocol1Startup
from sfms_robot.servo.chain.status_poll import GroupRead
from sfms_robot.servo.codecs import dxl1, protocol1
from sfms_robot.servo.registers import Field

log = logging.getLogger(__name__)

_GROUP_TRIAL_S: Final = 0.05


class Protocol1Bus(ChainBus[Protocol1Link]):
    """One wire of servos, as `ports.Bus`; arguments as of `ChainBus`.

    Subclasses say which family, and how it reads several servos at once.
    """

    family: ClassVar[Family]
    protocol = 1
    startup = Protocol1Startup

    @abstractmethod
    def _group_reader(self, link: Protocol1Link) -> GroupRead | None:
        """How the family reads several servos by one request; None when it does not."""

    def _open(self) -> Protocol1Link:
        return Protocol1Link(self._open_port(), self._baud, self._read_deadline_s, self.family)

    def _found(self, link: Protocol1Link) -> None:
        group, present = self._group_reader(link), self._present()
        if group is not None:
            with link.patient(_GROUP_TRIAL_S):
                if len(group(*self._telemetry.block, present)) < len(present):
                    log.info(
                        "bus %r: not every servo answers a request for several: they are read one by one", self.name
                    )
                    group = None
        self._poll.restart(group)

    def _found_again(self, link: Protocol1Link) -> None:
        self._poll.reconnect(self._group_reader(link), None)

    def _sync_write_packet(self, field: Field, values: Mapping[int, int]) -> bytes:
        params = dxl1.sync_write_params(field.address, {servo: field.to_bytes(v) for servo, v in values.items()})
        return protocol1.encode(protocol1.BROADCAST, protocol1.SYNC_WRITE, params)

    def _send(self, link: Protocol1Link, places: NDArray[np.intp], ticks: NDArray[np.int64], now_s: float) -> None:
        goal = self._telemetry.goal
        each = zip(places.tolist(), ticks[places].tolist(), strict=True)
        link.sync_write(goal.address, {self._servos[i].id: goal.to_bytes(value) for i, value in each})
