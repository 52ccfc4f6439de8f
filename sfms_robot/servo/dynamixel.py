"""A bus of Dynamixel servos in position mode.

Four promises:

1. Torque comes on without a jump: goal := present, read back, then torque. A servo that stands outside the limits of
   its joint is held where it stands; it may come in, and never go further out.
2. One servo never costs the frame. On a real chain the ids behind a silent one stay silent too, so `poll` asks those
   again in a second request, takes the silent one off the list at once, and probes it alone with growing pauses. Each
   joint has its own last position, age and fault.
3. What was away (a servo, the wire, the supply) is found again, checked and switched on as at start-up, beside the
   work of the others; until then its goals are withheld.
4. `stop` reaches every servo that can be reached, whatever else is dead.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Bus as BusConfig
from sfms_robot.config import Faults
from sfms_robot.errors import BusError, PortError, RobotError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import StopPolicy, TickConversion
from sfms_robot.servo.care import Care
from sfms_robot.servo.dxl2_link import Dxl2Link
from sfms_robot.servo.goals import Goals
from sfms_robot.servo.handshake import Handshake
from sfms_robot.servo.policy import BusServo as BusServo
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Field, Table
from sfms_robot.servo.sweep import Sweep
from sfms_robot.servo.telemetry import Telemetry, common

T = TypeVar("T")
log = logging.getLogger(__name__)

READ_DEADLINE_S: Final = 0.003  # what a silent servo costs, once
_STOP_PATIENCE_S: Final = 0.02
_REOPEN_S: Final = 0.2
_WATCHDOG_TICK_S: Final = 0.02
_STALL: Final = 0.8  # of the watchdog's time without a goal: it may have tripped


class DynamixelBus:
    """One wire of servos, as `ports.Bus`.

    Args:
        name: of the bus, for messages.
        servos: in joint order.
        conversion: joint angles (J,) <-> ticks (J,), affine per joint.
        open_port: opens the port at `baud`; the bus owns what it returns, and asks again when the port is lost.
        baud: bits per second.
        read_deadline_s: silence that makes a servo silent. The default suits a wire; a simulated one on a busy
            computer needs more.
        config: rate, watchdog and the like; by default those of a head that says nothing about them.
        faults: which faults are acted upon.
    """

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
        self.name = name
        self.joints = tuple(servo.joint for servo in servos)
        self._servos = tuple(servos)
        self._ids = np.array([servo.id for servo in servos])
        self._conversion = conversion
        self._open_port = open_port
        self._config = config or BusConfig(family="dynamixel", baud=baud)
        self._baud = baud
        self._read_deadline_s = read_deadline_s
        self._tables = [Table.of(servo.map) for servo in servos]
        self._telemetry = Telemetry(name, self._tables, conversion)
        self._care = Care(servos, self._tables, faults or Faults(), self._telemetry)
        self._goal = _goal(name, self._tables)
        self._goal_type = np.dtype(f"<{'i' if self._goal.signed else 'u'}{self._goal.size}")
        self._goals = Goals(name, servos, conversion)
        self._outside: set[int] = set()  # who has come from outside its limits
        self._index = {servo.id: i for i, servo in enumerate(servos)}
        self._counts = {"writes": 0, "reads": 0, "errors": 0, "retries": 0, "reconnects": 0}
        self._sweep = Sweep(name, list(self._index), self._telemetry, self._goal.size, self._config, self._counts)
        self._link: Dxl2Link | None = None
        self._streamed: tuple[tuple[int, ...], NDArray[np.intp]] = ((), np.zeros(0, np.intp))
        self._stale = True
        self._armed: set[int] = set()
        self._watched: set[int] = set()
        self._watchdog = math.ceil(self._config.watchdog_ms / 1e3 / _WATCHDOG_TICK_S)
        self._wrote_s = math.inf
        self._stalled = False
        self._lost_s: float | None = None
        self._tried_s = -math.inf
        self._heard_s: float | None = None
        self._peak_mA = 0.0

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return {joint: self._telemetry.capabilities(index) for index, joint in enumerate(self.joints)}

    # --- start and stop -----------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open, identify every servo, make it listen to us. Torque is left as it is found."""
        link = Dxl2Link(self._open_port(), self._baud, self._read_deadline_s)
        try:
            shake = self._shake(link)
            bits = shake.run()
            self._read_deadline_s = link.adapt(self._servos[0].id, *self._telemetry.position)
            self._sweep.restart(link)
        except BaseException:
            link.port.close()
            raise
        self._link, self._lost_s, self._heard_s = link, None, None
        self._care.switched_off()
        self._care.attach(link, self._shake(link, tries=1))
        self._stale, self._armed, self._stalled, self._wrote_s = True, set(), False, math.inf
        self._watched = {i for i, table in enumerate(self._tables) if self._watchdog and table.watchdog == "stops"}
        now_s = link.port.now_s()
        self._sweep.measure(link, now_s)
        for index, status in enumerate(bits):
            self._care.take_bits(index, status, now_s)

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        """Torque on for `joints` without a jump, one after the other; angles held, rad, in the order of `joints`.

        Raises ServoError when a servo refuses; those before it in the list then have torque, so call `stop`.
        """
        link = self._connected()
        shake = self._shake(link)
        held = []
        for joint in joints:
            index = self.joints.index(joint)
            self._telemetry.ticks[index] = shake.switch_on(index)
            self._care.switched_on(index)
            held.append(self._hold(index))
            link.rest(self._config.stagger_ms / 1e3)
        self._stale = True
        return np.array(held)

    def stop(self, policy: StopPolicy) -> None:
        """Release every servo but those whose joints are to hold, or none; refuse goals from now on. Never raises."""
        self._care.switched_off()
        self._stale = True
        link, armed = self._link, sorted(self._armed)
        self._armed = set()
        if link is None and self._lost_s is not None:
            link = self._open_again()  # perhaps it has just come back
        if link is None:
            return
        limp = [i for i, servo in enumerate(self._servos) if policy == "release" and servo.safety.stop == "release"]
        with link.patient(_STOP_PATIENCE_S):
            if armed:
                self._settle(link, self._tables[0]["bus_watchdog"], armed, "its watchdog is off")
            if limp:
                self._settle(link, self._telemetry.torque, limp, "its torque is off")

    def _settle(self, link: Dxl2Link, field: Field, indices: Sequence[int], what: str) -> None:
        """Write 0 to a register of many servos and make sure of each, as far as it answers."""
        off = field.to_bytes(0)
        self._attempt(lambda: link.sync_write(field.address, {self._servos[i].id: off for i in indices}))
        for index in indices:
            servo = self._servos[index]
            tries = 1 if servo.id in self._sweep.roster.silent else 2
            if not any(self._is_off(link, servo.id, field) for _ in range(tries)):
                log.warning("%s (id %d) does not confirm that %s", servo.joint, servo.id, what)

    def _is_off(self, link: Dxl2Link, servo: int, field: Field) -> bool:
        """Whether the register is 0; when it is not, or nobody says so, that is written once more."""
        off = field.to_bytes(0)
        answer = self._attempt(lambda: link.read(servo, field.address, field.size))
        if answer is not None and answer.data == off:
            return True
        self._attempt(lambda: link.write(servo, field.address, off))
        return False

    def close(self) -> None:
        """Give the port back; watchdogs that are still on are switched off, so that a held pose stays held."""
        link = self._link
        if link is not None:
            if self._armed:
                field = self._tables[0]["bus_watchdog"]
                off = {self._servos[i].id: field.to_bytes(0) for i in self._armed}
                self._attempt(lambda: link.sync_write(field.address, off))
            link.port.close()
        self._link, self._lost_s = None, None
        self._armed = set()
        self._care.switched_off()

    def _shake(self, link: Dxl2Link, tries: int = 3) -> Handshake:
        return Handshake(self.name, link, self._servos, self._tables, self._baud, tries)

    def _hold(self, index: int) -> float:
        """The angle of a servo that holds where it stands; the range reaches out to it."""
        servo = self._servos[index]
        angle = float(self._conversion.to_rad(self._telemetry.ticks)[index])
        if not self._goals.hold(index, angle):
            self._outside.add(index)
            log.warning("%s (id %d) stands outside its limits and is held there", servo.joint, servo.id)
        return angle

    def _connected(self) -> Dxl2Link:
        if self._link is None:
            raise BusError(f"bus {self.name!r} is not connected")
        return self._link

    def _attempt(self, request: Callable[[], T]) -> T | None:
        try:
            return request()
        except RobotError as error:
            self._counts["errors"] += 1
            log.warning("bus %r: %s", self.name, error)
            return None

    # --- every tick ---------------------------------------------------------------------------------------------

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Goals of all joints in one packet; those of joints that are not enabled, or away, are left out.

        Raises ValueError, with nothing sent, before `enable`, for a goal that is not finite, or one out of range.
        """
        if self._lost_s is None:
            self._connected()
        if not self._care.wanted:
            raise ValueError(f"bus {self.name!r}: no joint is enabled, goals are refused")
        self._goals.check(goals_rad)
        ticks = self._goals.ticks(goals_rad, sorted(self._outside), now_s)
        link = self._link
        if link is None:
            return
        for index in [i for i in self._care.rejoining if self._care.near(i, int(ticks[i]))]:
            del self._care.rejoining[index]
            self._stale = True
        if self._stale:
            self._choose()
        ids, places = self._streamed
        if not ids:
            return
        self._counts["writes"] += 1
        try:
            data = ticks[places].astype(self._goal_type).tobytes()
            link.sync_write_block(self._goal.address, ids, self._goal.size, data)
            self._arm(link, places)
        except BusError as error:
            self._lose(error, now_s)
        self._stalled |= bool(self._armed) and now_s - self._wrote_s > _STALL * self._watchdog * _WATCHDOG_TICK_S
        self._wrote_s = now_s

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        """Position of all servos that are not silent, more of some, and whoever is away is looked after.

        Raises BusError when nobody has answered for so long that the bus has failed.
        """
        care = self._care
        care.rejoined.clear()
        if self._lost_s is not None:
            self._reopen(now_s)
        link = self._link if self._lost_s is not None else self._connected()
        if link is not None:
            try:
                self._ask(link, now_s)
            except BusError as error:
                self._lose(error, now_s)
        self._give_up(now_s)
        for index in care.rejoined:
            self._hold(index)
            self._armed.discard(index)  # it was prepared anew
        return self._telemetry.readings(self.joints, care.fault, care.rejoined, now_s)

    def statistics(self) -> Mapping[str, Any]:
        return {
            **self._counts,
            "silent": self._sweep.roster.silent,
            "faults": list(self._care.said),
            "supply_mA": round(self._telemetry.supply_mA(), 1),
            "supply_peak_mA": round(self._peak_mA, 1),
        }

    def _ask(self, link: Dxl2Link, now_s: float) -> None:
        care, sweep = self._care, self._sweep
        heard = sweep.tick(link, now_s)
        for servo in heard.newly_silent:
            log.warning("%s (id %d) is silent", self.joints[self._index[servo]], servo)
        for servo in heard.probed_in_vain:
            care.gone(self._index[servo], "silent")
            self._stale = True
        for servo in heard.came_back:
            index = self._index[servo]
            log.warning("%s (id %d) answers again", self.joints[index], servo)
            care.answers(index, now_s)
        for servo, alert in heard.alerts.items():
            index = self._index[servo]
            if not alert:
                care.take_bits(index, 0, now_s)
        for servo, (torque, bits) in heard.health.items():
            index = self._index[servo]
            care.take_bits(index, bits, now_s)
            if not torque:
                care.torque_lost(index, now_s)
        if heard.blocks:
            care.take_currents([self._index[servo] for servo in heard.blocks], now_s)
            self._peak_mA = max(self._peak_mA, self._telemetry.supply_mA())
        if heard.any:
            self._heard_s = now_s
        if self._stalled:
            self._look_for_trips(link, now_s)
        before = len(care.away)
        self._counts["reconnects"] += care.step(now_s)
        self._stale |= before != len(care.away) or bool(care.away)

    def _choose(self) -> None:
        """Who gets goals: switched on, not away, and not waiting for goals that begin where it stands."""
        care = self._care
        chosen = [i for i in sorted(care.wanted) if i not in care.away and i not in care.rejoining]
        self._streamed = tuple(int(self._ids[i]) for i in chosen), np.array(chosen, np.intp)
        self._stale = False

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
                self._stale = True

    # --- the port -----------------------------------------------------------------------------------------------

    def _lose(self, error: BusError, now_s: float) -> None:
        log.warning("bus %r: %s; trying to open it again", self.name, error)
        self._counts["errors"] += 1
        if self._link is not None:
            self._link.port.close()
        self._link, self._lost_s, self._tried_s = None, now_s, now_s
        for index in list(self._care.wanted):
            self._care.gone(index, "port lost")
        self._stale = True

    def _reopen(self, now_s: float) -> None:
        if self._link is not None or now_s - self._tried_s < _REOPEN_S:
            return
        self._tried_s = now_s
        if (link := self._open_again()) is not None:
            log.warning("bus %r: %s is back", self.name, link.port.name)
            self._counts["reconnects"] += 1
            self._care.attach(link, self._shake(link, tries=1))
            self._sweep.roster.suspect_all(now_s)

    def _open_again(self) -> Dxl2Link | None:
        try:
            link = Dxl2Link(self._open_port(), self._baud, self._read_deadline_s)
        except (PortError, BusError):
            return None  # still gone
        self._link, self._lost_s = link, None
        return link

    def _give_up(self, now_s: float) -> None:
        since_s = self._heard_s if self._heard_s is not None else now_s
        self._heard_s = since_s
        if now_s - since_s > self._config.reconnect_s:
            raise BusError(f"bus {self.name!r}: no servo has answered for {self._config.reconnect_s:g} s")


def _goal(bus: str, tables: Sequence[Table]) -> Field:
    field = common(bus, tables, "goal_position")
    if field is None or field.sign not in ("no", "twos_complement"):
        raise BusError(f"bus {bus!r}: {tables[0].model} has no goal position that can be written to many at once")
    return field
