"""A bus of servos with registers, whatever their protocol.

Four promises:

1. Torque comes on without a jump: goal := present, read back, then torque. A servo that stands outside the limits of
   its joint is held where it stands; it may come in, and never go further out.
2. One servo never costs the frame. A silent one leaves the list at once and is probed alone, with growing pauses;
   those behind it are asked again. Each joint has its own last position, age and fault.
3. What was away (a servo, the wire, the supply) is found again, checked and switched on as at start-up, beside the
   work of the others; until then its goals are withheld.
4. `stop` reaches every servo that can be reached, whatever else is dead.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Bus as BusConfig
from sfms_robot.config import Faults
from sfms_robot.errors import BusError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import StopPolicy, TickConversion
from sfms_robot.servo.bus import WireBus
from sfms_robot.servo.chain.care import Care, Told
from sfms_robot.servo.chain.link import RegisterLink
from sfms_robot.servo.chain.roster import Roster
from sfms_robot.servo.chain.startup import Startup
from sfms_robot.servo.policy import Absences, BusServo
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Field, Table

log = logging.getLogger(__name__)

READ_DEADLINE_S: Final = 0.003  # what a silent servo costs, once
_STOP_PATIENCE_S: Final = 0.02
_NOBODY: Final = np.zeros(0, np.intp)


class State(Told, Protocol):
    """Last known state of every servo, by index in bus order."""

    torque: Field
    position: tuple[int, int]

    def capabilities(self, index: int) -> frozenset[str]: ...

    def supply_mA(self) -> float: ...

    def readings(
        self, joints: Sequence[str], faults: Sequence[str | None], rejoined: set[int], now_s: float
    ) -> Mapping[str, Reading]: ...


L = TypeVar("L", bound=RegisterLink)
S = TypeVar("S", bound=State)


class ChainBus(WireBus[L], Generic[L, S]):
    """One wire of servos; a family says how it is asked and told.

    Args:
        name, servos, conversion, open_port, baud: see `WireBus`.
        read_deadline_s: silence that makes a servo silent. The default suits a wire; a simulated one on a busy
            computer needs more.
        config: rate, watchdog and the like; by default those of a head that says nothing about them.
        faults: which faults are acted upon.

    Raises ConfigError for servos that cannot share a bus.
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
        self._config = config or BusConfig(family="dynamixel2", baud=baud)
        super().__init__(name, servos, conversion, open_port, baud, read_deadline_s, self._config.reconnect_s)
        self._tables = [Table.of(servo.map) for servo in servos]
        self._index = {servo.id: i for i, servo in enumerate(servos)}
        self._telemetry = self._state()
        self._absences = Absences([f"{servo.joint} (id {servo.id})" for servo in servos])
        self._care = Care(servos, self._tables, faults or Faults(), self._telemetry)
        self._places: NDArray[np.intp] = np.zeros(0, np.intp)  # who gets goals
        self._stale = True  # that list

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return {joint: self._telemetry.capabilities(index) for index, joint in enumerate(self.joints)}

    # --- what a family adds -------------------------------------------------------------------------------------

    @abstractmethod
    def _state(self) -> S: ...

    @abstractmethod
    def _shake(self, link: L, tries: int = 3) -> Startup[L]: ...

    @property
    @abstractmethod
    def _listed(self) -> Roster: ...

    @abstractmethod
    def _met(self, link: L, bits: Mapping[int, int]) -> None:
        """Who answers is identified and prepared; latched faults by index."""

    @abstractmethod
    def _listen(self, link: L, now_s: float) -> bool:
        """Ask for positions and the like; whether anybody answered."""

    @abstractmethod
    def _send(self, link: L, places: NDArray[np.intp], ticks: NDArray[np.int64], now_s: float) -> None:
        """Goals of the servos at `places`; `ticks` (J,)."""

    # --- start and stop -----------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open, identify every servo, make it listen to us. Torque is left as it is found."""
        link = self._open()
        try:
            bits = self._shake(link).run()
            self._read_deadline_s = link.adapt(self._servos[min(bits)].id, *self._telemetry.position)
            self._care.switched_off()
            self._care.attach(link, self._shake(link, tries=1))
            self._met(link, bits)
        except BaseException:
            link.port.close()
            raise
        self._forget_silence()
        self._link, self._stale = link, True

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
        link = self._link
        if link is None and self._lost_s is not None:
            link = self._open_again()  # perhaps it has just come back
        if link is None:
            return
        limp = [i for i, servo in enumerate(self._servos) if policy == "release" and servo.safety.stop == "release"]
        with link.patient(_STOP_PATIENCE_S):
            self._let_go(link)
            self._settle(link, self._telemetry.torque, limp, "its torque is off")

    def _let_go(self, link: L) -> None:
        """What has to be off before the torque is."""

    def close(self) -> None:
        """Give the port back. Idempotent."""
        self._care.switched_off()
        super().close()

    def _settle(self, link: L, field: Field, indices: Sequence[int], what: str) -> None:
        """Write 0 to a register of many servos and make sure of each, as far as it answers."""
        if not indices:
            return
        off = field.to_bytes(0)
        self._attempt(lambda: link.sync_write(field.address, {self._servos[i].id: off for i in indices}))
        for index in indices:
            servo = self._servos[index]
            tries = 1 if servo.id in self._listed.silent else 2
            if not any(self._is_off(link, servo.id, field) for _ in range(tries)):
                log.warning("%s (id %d) does not confirm that %s", servo.joint, servo.id, what)

    def _is_off(self, link: L, servo: int, field: Field) -> bool:
        """Whether the register is 0; when it is not, or nobody says so, that is written once more."""
        off = field.to_bytes(0)
        answer = self._attempt(lambda: link.read(servo, field.address, field.size))
        if answer is not None and answer.data == off:
            return True
        self._attempt(lambda: link.write(servo, field.address, off))
        return False

    def _hold(self, index: int) -> float:
        """The angle of a servo that holds where it stands; the range reaches out to it."""
        servo = self._servos[index]
        angle = float(self._conversion.to_rad(self._telemetry.ticks)[index])
        if not self._goals.hold(index, angle):
            log.warning("%s (id %d) stands outside its limits and is held there", servo.joint, servo.id)
        return angle

    # --- every tick ---------------------------------------------------------------------------------------------

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Goals of all joints in one packet; those of joints that are not enabled, or away, are left out.

        Raises ValueError, with nothing sent, before `enable`, for a goal that is not finite, or one out of range.
        While the port is gone nothing is sent and nothing is raised.
        """
        care = self._care
        self._check(bool(care.wanted))
        if care.rejoining:
            near = self._goals.ticks(goals_rad, _NOBODY)
            for index in [i for i in care.rejoining if care.near(i, int(near[i]))]:
                if self._goals.allows(index, goals_rad[index]):
                    del care.rejoining[index]
                    self._stale = True
        if self._stale:
            chosen = [i for i in sorted(care.wanted) if i not in care.away and i not in care.rejoining]
            self._places = np.array(chosen, np.intp)
            self._stale = False
        link = self._link
        ticks = self._goals.ticks(goals_rad, _NOBODY if link is None else self._places)
        if link is None or not len(self._places):
            return
        self._counts["writes"] += 1
        try:
            self._send(link, self._places, ticks, now_s)
        except BusError as error:
            self._lose(error, now_s)

    def statistics(self) -> Mapping[str, Any]:
        return {
            **self._counts,
            "silent": self._listed.silent,
            "faults": list(self._care.said),
            "supply_mA": round(self._telemetry.supply_mA(), 1),
        }

    def _ask(self, link: L, now_s: float) -> bool:
        heard = self._listen(link, now_s)
        back = self._care.step(now_s)
        self._counts["reconnects"] += back
        self._stale |= back > 0 or bool(self._care.away)
        return heard

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        """Position of all servos that are not silent, more of some, and whoever is away is looked after.

        Raises BusError when nobody has answered for so long that the bus has failed.
        """
        self._care.rejoined.clear()
        return super().poll(now_s)

    def _readings(self, now_s: float) -> Mapping[str, Reading]:
        for index in self._care.rejoined:
            self._hold(index)
        return self._telemetry.readings(self.joints, self._care.fault, self._care.rejoined, now_s)

    # --- the port -----------------------------------------------------------------------------------------------

    def _left(self) -> None:
        for index in sorted(self._care.wanted):
            self._care.gone(index, "port lost")

    def _returned(self, link: L, now_s: float) -> None:
        self._care.attach(link, self._shake(link, tries=1))
        self._listed.suspect_all(now_s)
