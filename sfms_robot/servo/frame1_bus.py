"""A bus of servos that speak the FF FF frame and have no watchdog: what Dynamixel 1.0 and Feetech have in common.

Four promises:

1. Torque comes on without a jump: goal := present, read back, then torque. A servo outside the limits of its joint is
   held where it stands; it may come in, and never go further out.
2. One servo never costs the frame. Where the family can, all are read by one request, and those behind a silent one by
   a second. Where it cannot, servos are read one by one, as many per poll as the budget allows, in rotation; each joint
   has its own last value, age and fault. A silent servo leaves the list at once and is probed with growing pauses.
3. What was away (a servo, the wire, the supply) is found again, checked and switched on as at start-up; until then its
   goals are withheld.
4. `stop` reaches every servo that can be reached, whatever else is dead.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Bus as BusConfig
from sfms_robot.config import Faults
from sfms_robot.errors import BusError, PortError, RobotError, ServoError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import StopPolicy, TickConversion
from sfms_robot.servo.frame1_care import Frame1Care
from sfms_robot.servo.frame1_handshake import Frame1Handshake, Silent
from sfms_robot.servo.frame1_link import Family, Frame1Link
from sfms_robot.servo.frame1_poll import GroupRead, InTurn, ask_together
from sfms_robot.servo.frame1_telemetry import Frame1Telemetry
from sfms_robot.servo.goals import Goals
from sfms_robot.servo.link import Answer
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Table
from sfms_robot.servo.roster import Roster

T = TypeVar("T")
log = logging.getLogger(__name__)

READ_DEADLINE_S: Final = 0.003  # what a silent servo costs, once
POLL_SHARE: Final = 0.6  # of a tick that reading servos one by one may take
USUAL_RATE_HZ: Final = 100.0
RECONNECT_S: Final = 30.0  # a port that is gone for longer has failed
_GROUP_TRIAL_S: Final = 0.05
_STOP_PATIENCE_S: Final = 0.02
_REOPEN_S: Final = 0.2


class Frame1Bus(ABC):
    """One wire of servos, as `ports.Bus`. Subclasses say which family, and how it reads several servos at once.

    Args:
        name: of the bus, for messages.
        servos: in joint order.
        conversion: joint angles (J,) <-> ticks (J,), affine per joint.
        open_port: opens the port at `baud`, also again when the device was gone; the bus owns what it returns.
        read_deadline_s: silence that makes a servo silent.
        config: what the head says of this bus; its rate decides how long reading servos one by one may take.
        faults: which faults are acted upon.

    Raises ConfigError for servos that cannot share a bus.
    """

    family: ClassVar[Family]

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
        self._open_port = open_port
        self._baud = baud
        self._read_deadline_s = read_deadline_s
        self._stagger_s = config.stagger_ms / 1e3 if config is not None else 0.0
        self._reconnect_s = config.reconnect_s if config is not None else RECONNECT_S
        self._tables = [Table.of(servo.map) for servo in servos]
        self._telemetry = Frame1Telemetry(name, self.family, self._tables, conversion)
        self._torque = self._telemetry.fields["torque_enable"]
        self._goals = Goals(name, servos, conversion)
        self._care = Frame1Care(servos, self._tables, faults or Faults())
        self._index = {servo.id: i for i, servo in enumerate(servos)}
        budget_s = POLL_SHARE / (config.rate_hz if config is not None else USUAL_RATE_HZ)
        self._in_turn = InTurn(list(self._index), self._telemetry.block, baud, budget_s)
        self._roster = Roster(list(self._index))
        self._link: Frame1Link | None = None
        self._group: GroupRead | None = None
        self._lost_s: float | None = None
        self._tried_s = -math.inf
        self._prepared: int | None = None  # who is half-way back
        self._checkup = 0  # whose torque or current is read next
        self._counts = {"writes": 0, "reads": 0, "errors": 0, "retries": 0, "reconnects": 0}

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return {joint: self._telemetry.capabilities(index) for index, joint in enumerate(self.joints)}

    @abstractmethod
    def _group_reader(self, link: Frame1Link) -> GroupRead | None:
        """How the family reads several servos by one request; None when it does not."""

    # --- start and stop -----------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open, identify every servo, make it listen to us. Torque is left as it is found."""
        link = Frame1Link(self._open_port(), self._baud, self._read_deadline_s, self.family)
        try:
            self._shake(link).run()
            self._group = self._tried(link, self._group_reader(link))
        except BaseException:
            link.port.close()
            raise
        self._care.switched_off()
        self._link, self._lost_s = link, None
        self._roster = Roster(list(self._index))

    def _tried(self, link: Frame1Link, read: GroupRead | None) -> GroupRead | None:
        if read is None:
            return None
        with link.patient(_GROUP_TRIAL_S):
            if len(read(*self._telemetry.block, list(self._index))) == len(self._index):
                return read
        log.info("bus %r: not every servo answers a request for several: they are read one by one", self.name)
        return None

    def _shake(self, link: Frame1Link, patient: bool = True) -> Frame1Handshake:
        return Frame1Handshake(self.name, link, self._servos, self._tables, self._baud, patient)

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        """Torque on for `joints` without a jump, one after the other; angles held, rad, in the order of `joints`.

        Raises ServoError when a servo refuses; those before it in the list then have torque, so call `stop`.
        """
        link = self._connected()
        held = []
        for joint in joints:
            index = self.joints.index(joint)
            self._telemetry.ticks[index] = self._shake(link).torque_on_without_a_jump(index)
            self._care.switched_on(index)
            held.append(self._hold(index))
            link.rest(self._stagger_s)
        return np.array(held)

    def _hold(self, index: int) -> float:
        """The angle of a servo that holds where it stands; the range reaches out to it."""
        servo, angle = self._servos[index], self._telemetry.angle(index)
        if not self._goals.hold(index, angle):
            log.warning("%s (id %d) stands outside its limits and is held there", servo.joint, servo.id)
        return angle

    def stop(self, policy: StopPolicy) -> None:
        """Release every servo but those whose joints are to hold, or none; refuse goals from now on. Never raises."""
        self._care.switched_off()
        link = self._link
        limp = [servo.id for servo in self._servos if servo.safety.stop == "release"]
        if link is None or policy == "hold" or not limp:
            return
        values = dict.fromkeys(limp, self._torque.to_bytes(0))
        with link.patient(_STOP_PATIENCE_S):
            self._attempt(lambda: link.sync_write(self._torque.address, values))
            for servo in limp:
                tries = 1 if servo in self._roster.silent else 2
                if not any(self._released(link, servo) for _ in range(tries)):
                    joint = self.joints[self._index[servo]]
                    log.warning("%s (id %d) does not confirm that its torque is off", joint, servo)

    def _released(self, link: Frame1Link, servo: int) -> bool:
        """Whether the torque is off; when it is not, or nobody says so, it is written once more."""
        off = self._torque.to_bytes(0)
        answer = self._attempt(lambda: link.read(servo, self._torque.address, self._torque.size))
        if answer is not None and answer.data == off:
            return True
        self._attempt(lambda: link.write(servo, self._torque.address, off))
        return False

    def close(self) -> None:
        self._lost_s = None
        self._care.switched_off()
        if self._link is not None:
            self._link.port.close()
            self._link = None

    def _connected(self) -> Frame1Link:
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
        """Goals in one packet, of the joints that are enabled and whose servos are there.

        Raises ValueError, with nothing sent, before `enable`, for a goal that is not finite, or one out of range.
        While the port is gone nothing is sent and nothing is raised.
        """
        if self._lost_s is None:
            self._connected()
        if not self._care.wanted:
            raise ValueError(f"bus {self.name!r}: no joint is enabled, goals are refused")
        self._goals.check(goals_rad)
        ticks = self._goals.ticks(goals_rad, sorted(self._care.wanted), now_s).tolist()
        sent = self._care.receivers(ticks)
        if self._link is None or not sent:
            return
        goal = self._telemetry.fields["goal_position"]
        self._counts["writes"] += 1
        try:
            self._link.sync_write(goal.address, {self._servos[i].id: goal.to_bytes(ticks[i]) for i in sent})
        except BusError as error:
            self._gone(error, now_s)

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        """Freshest reading of every joint; whoever is away is looked after.

        Raises BusError when the port is gone for so long that the bus has failed.
        """
        care = self._care
        care.rejoined.clear()
        if self._lost_s is not None:
            self._reopen(now_s)
        link = self._link if self._lost_s is not None else self._connected()
        if link is not None:
            try:
                self._ask_servos(link, now_s)
            except BusError as error:
                self._gone(error, now_s)
        faults = [care.fault(index) for index in range(len(self.joints))]
        return self._telemetry.readings(self.joints, faults, care.rejoined, now_s)

    def statistics(self) -> Mapping[str, Any]:
        return {
            **self._counts,
            "silent": self._roster.silent,
            "faults": list(self._care.said),
            "supply_mA": round(self._telemetry.supply_mA(), 1),
        }

    # --- servos -------------------------------------------------------------------------------------------------

    def _ask_servos(self, link: Frame1Link, now_s: float) -> None:
        listed = self._roster.listed
        if self._group is not None:
            sweep = ask_together(self._group, self._telemetry.block, listed, self._roster.quiet_polls)
        else:
            sweep = self._in_turn.ask(link, listed)
        self._counts["reads"] += sweep.requests
        self._counts["retries"] += sweep.retries
        self._counts["errors"] += len(sweep.gaps) + len(sweep.missed)
        for servo, answer in sweep.answers.items():
            self._roster.answered(servo)
            self._take(link, self._index[servo], answer, now_s)
        for servo in self._roster.blame(bool(sweep.answers), sweep.gaps, sweep.missed, now_s):
            log.warning("%s (id %d) is silent", self.joints[self._index[servo]], servo)
        self._look_closer(link, [servo for servo in listed if servo in sweep.answers], now_s)
        self._probe(link, now_s)
        self._bring_back(link, now_s)

    def _take(self, link: Frame1Link, index: int, answer: Answer, now_s: float) -> None:
        if len(answer.data) != self._telemetry.block[1]:
            self._counts["errors"] += 1  # it refuses to say
            return
        self._telemetry.take(index, answer.data, now_s)
        policy = self._care.take_status(index, answer.error, self._telemetry.measured(index), now_s)
        self._apply(link, index, policy)

    def _apply(self, link: Frame1Link, index: int, policy: str | None) -> None:
        """What a policy means on the wire; `hold` means that nothing is sent."""
        servo = self._servos[index].id
        if policy == "limp":
            link.write(servo, self._torque.address, self._torque.to_bytes(0))
        elif policy == "reduce":
            strength = self._tables[index].role("torque_limit")
            answer = link.read(servo, strength.address, strength.size) if strength is not None else None
            if strength is not None and answer is not None and len(answer.data) == strength.size:
                half = strength.from_bytes(answer.data) // 2
                link.write(servo, strength.address, strength.to_bytes(half))

    def _look_closer(self, link: Frame1Link, ids: Sequence[int], now_s: float) -> None:
        """Of one servo per poll, what is not in the block: whether it has torque, and in turn its current."""
        if not ids:
            return
        self._checkup += 1
        kinds = 2 if any(self._telemetry.currents) else 1
        servo = ids[self._checkup // kinds % len(ids)]
        index = self._index[servo]
        current = self._telemetry.currents[index]
        if current is not None and self._checkup % 2:
            answer = link.read(servo, current.address, current.size)
            if answer is not None and len(answer.data) == current.size:
                current_mA = self._telemetry.take_current(index, current, answer.data)
                self._apply(link, index, self._care.take_current(index, current_mA, now_s))
        else:
            self._check_torque(link, index, now_s)

    def _check_torque(self, link: Frame1Link, index: int, now_s: float) -> None:
        """A servo without torque gets no goals from now on; switched on by a goal, it would jump."""
        if index in self._care.wanted:
            answer = link.read(self._servos[index].id, self._torque.address, self._torque.size)
            if answer is not None and answer.data == self._torque.to_bytes(0):
                self._care.torque_lost(index, now_s)

    def _probe(self, link: Frame1Link, now_s: float) -> None:
        """Ask the silent servo that has waited longest; when that is in vain, it was more than a lost answer."""
        servo = self._roster.due(now_s)
        if servo is None:
            return
        index = self._index[servo]
        self._counts["retries"] += 1
        answer = link.read(servo, *self._telemetry.block)
        if answer is None:
            self._roster.probe_failed(servo, now_s)
            self._care.gone(index)
            return
        self._roster.answered(servo)
        self._roster.hurry(now_s)
        log.warning("%s (id %d) answers again", self.joints[index], servo)
        self._take(link, index, answer, now_s)
        self._care.answers(index, now_s)
        self._check_torque(link, index, now_s)

    def _bring_back(self, link: Frame1Link, now_s: float) -> None:
        """One step for one servo: prepare it, and in the next poll give it its torque where it stands."""
        index = self._care.due(now_s)
        if index is None:
            self._prepared = None
            return
        shake = self._shake(link, patient=False)
        try:
            if self._prepared != index:
                shake.prepare_again(index)
                self._prepared = index
                return
            self._telemetry.ticks[index] = shake.torque_on_without_a_jump(index)
        except Silent:
            self._prepared = None
            self._care.later(index, now_s)
            return
        except ServoError as error:
            self._counts["errors"] += 1
            self._prepared = None
            self._care.failed(index, str(error), now_s)
            return
        self._prepared = None
        self._counts["reconnects"] += 1
        self._care.back(index, int(self._telemetry.ticks[index]), now_s)
        self._goals.ease(index, self._hold(index), now_s)

    # --- a port that goes and comes -----------------------------------------------------------------------------

    def _gone(self, error: BusError, now_s: float) -> None:
        log.warning("bus %r: %s; trying to open it again", self.name, error)
        self._counts["errors"] += 1
        if self._link is not None:
            self._link.port.close()
        self._link, self._lost_s, self._tried_s = None, now_s, now_s
        for index in sorted(self._care.wanted):
            self._care.gone(index)

    def _reopen(self, now_s: float) -> None:
        if self._lost_s is None or now_s - self._tried_s < _REOPEN_S:
            return
        if now_s - self._lost_s > self._reconnect_s:
            raise BusError(f"bus {self.name!r} is gone for more than {self._reconnect_s:g} s")
        self._tried_s = now_s
        try:
            port = self._open_port()
        except (PortError, BusError):
            return  # still gone
        log.warning("bus %r: %s is back", self.name, port.name)
        self._counts["reconnects"] += 1
        self._link, self._lost_s = Frame1Link(port, self._baud, self._read_deadline_s, self.family), None
        self._roster.suspect_all(now_s)
        self._group = self._group and self._group_reader(self._link)
