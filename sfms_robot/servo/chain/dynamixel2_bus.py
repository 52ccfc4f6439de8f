"""A bus of Dynamixel servos of Protocol 2.0, in position mode. What it promises stands in `chain_bus`.

On a real chain the ids behind a silent one stay silent too, so `poll` asks those again in a second request. Where the
servos have a watchdog that stops them, it is armed after the first goal, fed by the goals themselves, and switched off
before every clean end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Bus as BusConfig
from sfms_robot.config import Faults
from sfms_robot.errors import BusError
from sfms_robot.frames import Reading
from sfms_robot.ports import TickConversion
from sfms_robot.servo.chain.chain_bus import READ_DEADLINE_S, ChainBus
from sfms_robot.servo.chain.dynamixel2_link import Dxl2Link
from sfms_robot.servo.chain.dynamixel2_poll import Sweep
from sfms_robot.servo.chain.dynamixel2_startup import Dynamixel2Startup
from sfms_robot.servo.chain.dynamixel2_telemetry import Telemetry, common
from sfms_robot.servo.chain.roster import Roster
from sfms_robot.servo.policy import BusServo as BusServo
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Field, Table

_WATCHDOG_TICK_S: Final = 0.02
_STALL: Final = 0.8  # of the watchdog's time without a goal: it may have tripped


class DynamixelBus(ChainBus[Dxl2Link, Telemetry]):
    """One wire of servos, as `ports.Bus`; arguments as of `ChainBus`."""

    def __init__(
        self,
        name: str,
        servos: Sequence[BusServo],
        conversion: TickConversion,
        open_port: Callable[[], Port],
        baud: int,
        read_deadline_s: float = READ_DEADLINE_S,
        config: BusConfig | None = None,
        faults: Faults | None = None,
    ) -> None:
        super().__init__(name, servos, conversion, open_port, baud, read_deadline_s, config, faults)
        self._goal = _goal(name, self._tables)
        self._goal_type = np.dtype(f"<{'i' if self._goal.signed else 'u'}{self._goal.size}")
        self._ids = np.array([servo.id for servo in servos])
        self._sweep = Sweep(name, list(self._index), self._telemetry, self._goal.size, self._config, self._counts)
        self._streamed: tuple[NDArray[np.intp], tuple[int, ...]] = (self._places, ())
        self._armed: set[int] = set()
        self._watched: set[int] = set()
        self._watchdog = math.ceil(self._config.watchdog_ms / 1e3 / _WATCHDOG_TICK_S)
        self._wrote_s = math.inf
        self._stalled = False
        self._peak_mA = 0.0

    def _state(self) -> Telemetry:
        return Telemetry(self.name, self._tables, self._conversion)

    def _open(self) -> Dxl2Link:
        return Dxl2Link(self._open_port(), self._baud, self._read_deadline_s)

    def _shake(self, link: Dxl2Link, tries: int = 3) -> Dynamixel2Startup:
        return Dynamixel2Startup(self.name, link, self._servos, self._tables, self._conversion, self._baud, tries)

    @property
    def _listed(self) -> Roster:
        return self._sweep.roster

    def _met(self, link: Dxl2Link, bits: Mapping[int, int]) -> None:
        self._sweep.restart(link)
        self._armed, self._stalled, self._wrote_s = set(), False, math.inf
        self._watched = {i for i, table in enumerate(self._tables) if self._watchdog and table.watchdog == "stops"}
        now_s = link.port.now_s()
        self._sweep.measure(link, now_s)
        for index, status in bits.items():
            self._care.take_bits(index, status, now_s)

    def statistics(self) -> Mapping[str, Any]:
        return {**super().statistics(), "supply_peak_mA": round(self._peak_mA, 1)}

    # --- every tick ---------------------------------------------------------------------------------------------

    def _send(self, link: Dxl2Link, places: NDArray[np.intp], ticks: NDArray[np.int64], now_s: float) -> None:
        if places is not self._streamed[0]:
            self._streamed = places, tuple(self._ids[places].tolist())
        self._stalled |= bool(self._armed) and now_s - self._wrote_s > _STALL * self._watchdog * _WATCHDOG_TICK_S
        self._wrote_s = now_s
        data = ticks[places].astype(self._goal_type).tobytes()
        link.sync_write_block(self._goal.address, self._streamed[1], self._goal.size, data)
        self._arm(link, places)

    def _listen(self, link: Dxl2Link, now_s: float) -> bool:
        care = self._care
        heard = self._sweep.tick(link, now_s)
        for servo in heard.newly_silent:
            self._absences.gone(self._index[servo], now_s)
        for servo in heard.probed_in_vain:
            self._absences.gone(self._index[servo], now_s, again=False)
            care.gone(self._index[servo], "silent")
        for servo in heard.came_back:
            index = self._index[servo]
            self._absences.back(index)
            care.answers(index, now_s)
        for servo, alert in heard.alerts.items():
            if not alert:
                care.take_bits(self._index[servo], 0, now_s)
        for servo, (torque, bits) in heard.health.items():
            index = self._index[servo]
            care.take_bits(index, bits, now_s)
            if not torque:
                care.torque_lost(index, now_s)
        if heard.blocks:
            care.take_currents([self._index[servo] for servo in heard.blocks], now_s)
            self._peak_mA = max(self._peak_mA, self._telemetry.supply_mA())
        if self._stalled:
            self._look_for_trips(link, now_s)
        return heard.any

    def _readings(self, now_s: float) -> Mapping[str, Reading]:
        self._armed -= self._care.rejoined  # they were prepared anew
        return super()._readings(now_s)

    # --- the servos' own watchdog -------------------------------------------------------------------------------

    def _arm(self, link: Dxl2Link, places: Iterable[int]) -> None:
        """After the first goal: from now on every packet on the wire feeds it."""
        new = [int(i) for i in places if i not in self._armed and i in self._watched]
        if new:
            field = self._tables[new[0]]["bus_watchdog"]
            link.sync_write(field.address, {self._servos[i].id: field.to_bytes(self._watchdog) for i in new})
            self._armed.update(new)

    def _look_for_trips(self, link: Dxl2Link, now_s: float) -> None:
        """We were late: a servo whose watchdog has tripped ignores goals until it is brought back."""
        self._stalled = False
        for index in sorted(self._armed):
            field = self._tables[index]["bus_watchdog"]
            answer = link.read(self._servos[index].id, field.address, field.size)
            if answer is not None and answer.data and field.from_bytes(answer.data) < 0:
                self._care.distrust(index, "watchdog", now_s)

    def _let_go(self, link: Dxl2Link) -> None:
        armed, self._armed = sorted(self._armed), set()
        if armed:
            self._settle(link, self._tables[armed[0]]["bus_watchdog"], armed, "its watchdog is off")

    def close(self) -> None:
        """Give the port back; watchdogs that are still on are switched off, so that a held pose stays held."""
        link, armed, self._armed = self._link, self._armed, set()
        if link is not None and armed:
            field = self._tables[min(armed)]["bus_watchdog"]
            off = {self._servos[i].id: field.to_bytes(0) for i in armed}
            self._attempt(lambda: link.sync_write(field.address, off))
        super().close()


def _goal(bus: str, tables: Sequence[Table]) -> Field:
    field = common(bus, tables, "goal_position")
    if field is None or field.sign not in ("no", "twos_complement"):
        raise BusError(f"bus {bus!r}: {tables[0].model} has no goal position that can be written to many at once")
    return field
