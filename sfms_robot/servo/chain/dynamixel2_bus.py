"""A bus of Dynamixel servos of Protocol 2.0, in position mode. What it promises stands in `chain_bus`.

Positions are read by one fast sync read (all answer in one packet) while that works, else by a plain sync read. Where
the servos have a watchdog that stops them, it is armed after the first goal, with a value that is read back, fed by
the goals themselves, and switched off after the torque at the end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config.wire_time import FRAMINGS
from sfms_robot.errors import ConfigError
from sfms_robot.servo.chain.chain_bus import BUS_WATCHDOG, ChainBus
from sfms_robot.servo.chain.dynamixel2_link import Dynamixel2Link
from sfms_robot.servo.chain.dynamixel2_startup import Dynamixel2Startup
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.registers import Field

_WATCHDOG_TICK_S: Final = 0.02
_STALL: Final = 0.8  # of the watchdog's time without a goal: it may have tripped


class Dynamixel2Bus(ChainBus[Dynamixel2Link]):
    """One wire of servos, as `ports.Bus`; arguments as of `ChainBus`."""

    family = "dynamixel"
    framing = FRAMINGS["dynamixel2"]
    startup = Dynamixel2Startup
    protocol = 2

    def _set_up(self) -> None:
        goal = self._telemetry.goal
        if goal.sign not in ("no", "twos_complement"):
            raise ConfigError(f"bus {self.name!r}: goal_position of {self._tables[0].model} is no two's complement")
        self._goal_type = np.dtype(f"<{'i' if goal.signed else 'u'}{goal.size}")
        self._ids = np.array([servo.id for servo in self._servos])
        self._streamed: tuple[NDArray[np.intp], tuple[int, ...]] = (self._places, ())
        self._watchdog = math.ceil(self._config.watchdog_ms / 1e3 / _WATCHDOG_TICK_S)
        self._wrote_s = math.inf
        self._fed: NDArray[np.intp] | None = None  # whose watchdogs were looked at last

    def _open(self) -> Dynamixel2Link:
        return Dynamixel2Link(self._open_port(), self._baud, self._read_deadline_s)

    def _found(self, link: Dynamixel2Link) -> None:
        self._wrote_s = math.inf
        works = self._config.fast_read == "on"
        if self._config.fast_read == "auto":
            present = self._present()
            works = len(link.fast_sync_read(*self._telemetry.position, present)) == len(present)
        fast = link.fast_sync_read if works else None
        self._poll.restart(link.sync_read, fast, proven=self._config.fast_read == "auto")

    def _found_again(self, link: Dynamixel2Link) -> None:
        self._poll.reconnect(link.sync_read, link.fast_sync_read)

    def _sync_write_packet(self, field: Field, values: Mapping[int, int]) -> bytes:
        params = field.address.to_bytes(2, "little") + field.size.to_bytes(2, "little")
        params += b"".join(bytes([servo]) + field.to_bytes(value) for servo, value in values.items())
        return dxl2.encode_instruction(dxl2.BROADCAST, dxl2.SYNC_WRITE, params)

    # --- every tick ---------------------------------------------------------------------------------------------

    def _send(self, link: Dynamixel2Link, places: NDArray[np.intp], ticks: NDArray[np.int64], now_s: float) -> None:
        goal = self._telemetry.goal
        if places is not self._streamed[0]:
            self._streamed = places, tuple(self._ids[places].tolist())
        if now_s - self._wrote_s > _STALL * self._watchdog * _WATCHDOG_TICK_S:
            self._look_for_trips()
        self._wrote_s = now_s
        data = ticks[places].astype(self._goal_type).tobytes()
        link.sync_write_block(goal.address, self._streamed[1], goal.size, data)
        if self._watchdog and places is not self._fed:
            self._arm(places)

    # --- the servos' own watchdog -------------------------------------------------------------------------------

    def _arm(self, places: NDArray[np.intp]) -> None:
        """After the first goal: from now on every packet on the wire feeds it."""
        self._fed = places
        armed = self._settings.changed(BUS_WATCHDOG)
        for index in places.tolist():
            if index not in armed and self._tables[index].watchdog == "stops":
                self._settings.change(index, BUS_WATCHDOG, self._watchdog)

    def _forget(self, index: int) -> None:
        super()._forget(index)
        self._fed = None  # it was prepared anew, its watchdog is off

    def _look_for_trips(self) -> None:
        """We were late: a servo whose watchdog has tripped ignores goals until it is brought back."""
        for index in self._settings.changed(BUS_WATCHDOG):
            self._writes.want(index, self._tables[index][BUS_WATCHDOG], self._watchdog, read_first=True)

    def _told(self, index: int, field: Field, value: int, now_s: float) -> None:
        super()._told(index, field, value, now_s)
        if field.name == BUS_WATCHDOG and value < 0:
            self._writes.drop(index, BUS_WATCHDOG)
            self._members[index].distrust("watchdog", now_s)
