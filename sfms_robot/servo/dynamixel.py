"""A bus of Dynamixel servos in position mode.

Three promises:

1. Torque comes on without a jump: goal := present, read back, then torque. A servo that stands outside the limits of
   its joint is held where it stands; it may come in, and never go further out.
2. One servo never costs the frame. On a real chain the ids behind a silent one stay silent too, so `poll` asks those
   again in a second request, takes the silent one off the list at once, and probes it alone with growing pauses. Each
   joint has its own last position, age and fault.
3. `stop` reaches every servo that can be reached, whatever else is dead.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import FirmwareMap
from sfms_robot.errors import BusError, ConfigError, RobotError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import StopPolicy, TickConversion
from sfms_robot.servo.codecs.dxl2 import ALERT, Packet
from sfms_robot.servo.dxl2_link import Dxl2Link
from sfms_robot.servo.handshake import Handshake
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Table
from sfms_robot.servo.roster import Roster

T = TypeVar("T")
log = logging.getLogger(__name__)

READ_DEADLINE_S: Final = 0.003  # what a silent servo costs, once
_POLLED: Final = ("present_current", "present_velocity", "present_position")
_CAPABILITIES: Final = frozenset({"position", "velocity", "current", "torque"})
_REQUESTS: Final = 3  # sync reads in one poll at most
_STOP_PATIENCE_S: Final = 0.02
_TORQUE_LOST: Final = "torque lost"  # it restarted while it was silent


@dataclass(frozen=True)
class BusServo:
    """One servo of a bus and the joint it moves; the limits are those of the joint."""

    joint: str
    id: int
    map: FirmwareMap
    min_rad: float
    max_rad: float


@dataclass(slots=True)
class _Seen:
    """What the bus knows of one servo."""

    seen_s: float | None = None
    current_mA: float = 0.0
    velocity_raw: int = 0
    fault: str | None = None


class DynamixelBus:
    """One wire of servos, as `ports.Bus`.

    Args:
        name: of the bus, for messages.
        servos: in joint order.
        conversion: joint angles (J,) <-> ticks (J,), affine per joint.
        open_port: opens the port at `baud`; the bus owns what it returns.
        read_deadline_s: silence that makes a servo silent. The default suits a wire; a simulated one on a busy
            computer needs more.
    """

    def __init__(
        self,
        name: str,
        servos: Sequence[BusServo],
        conversion: TickConversion,
        open_port: Callable[[], Port],
        baud: int,
        read_deadline_s: float = READ_DEADLINE_S,
    ) -> None:
        self.name = name
        self.joints = tuple(servo.joint for servo in servos)
        self._servos = tuple(servos)
        self._conversion = conversion
        self._open_port = open_port
        self._baud = baud
        self._read_deadline_s = read_deadline_s
        self._tables = [Table.of(servo.map) for servo in servos]
        self._table = _common_table(name, self._tables)
        self._goal = self._table["goal_position"]
        self._block = self._table.span(_POLLED)
        self._fields = [(self._table[n], self._table[n].address - self._block[0]) for n in _POLLED]
        count = len(servos)
        self._lowest = np.array([servo.min_rad for servo in servos])
        self._highest = np.array([servo.max_rad for servo in servos])
        zero = conversion.to_rad(np.zeros(count, np.int64))
        self._rad_at_zero, self._rad_per_tick = zero, conversion.to_rad(np.ones(count, np.int64)) - zero
        velocity = self._table["present_velocity"].scale * self._table.ticks_per_revolution / 60.0
        self._rad_s_per_raw = self._rad_per_tick * velocity
        self._index = {servo.id: i for i, servo in enumerate(servos)}
        self._roster = Roster(list(self._index))
        self._link: Dxl2Link | None = None
        self._enabled: list[int] = []
        self._seen = [_Seen() for _ in servos]
        self._ticks = np.zeros(count, np.int64)
        self._counts = {"writes": 0, "reads": 0, "errors": 0, "retries": 0, "reconnects": 0}
        self._faults: dict[str, None] = {}

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return dict.fromkeys(self.joints, _CAPABILITIES)

    # --- start and stop -----------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open, identify every servo, make it listen to us. Torque is left as it is found."""
        link = Dxl2Link(self._open_port(), self._baud, self._read_deadline_s)
        try:
            faults = Handshake(self.name, link, self._servos, self._tables, self._baud).run()
        except BaseException:
            link.port.close()
            raise
        self._link = link
        self._enabled = []
        self._seen = [_Seen() for _ in self._servos]
        self._roster = Roster(list(self._index))
        for index, fault in enumerate(faults):
            self._note_fault(index, fault)

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        """Torque on for `joints` without a jump; angles held, rad, in the order of `joints`.

        Raises ServoError when a servo refuses; those before it in the list then have torque, so call `stop`.
        """
        link = self._connected()
        shake = Handshake(self.name, link, self._servos, self._tables, self._baud)
        held = []
        for joint in joints:
            index = self.joints.index(joint)
            self._ticks[index] = shake.torque_on_without_a_jump(index)
            angle = float(self._conversion.to_rad(self._ticks)[index])
            servo = self._servos[index]
            self._lowest[index] = min(servo.min_rad, angle)
            self._highest[index] = max(servo.max_rad, angle)
            if not servo.min_rad <= angle <= servo.max_rad:
                log.warning("%s (id %d) stands outside its limits and is held there", joint, servo.id)
            if index not in self._enabled:
                self._enabled.append(index)
            if self._seen[index].fault == _TORQUE_LOST:
                self._seen[index].fault = None
            held.append(angle)
        return np.array(held)

    def stop(self, policy: StopPolicy) -> None:
        """Release every servo, or leave it holding; refuse goals from now on. Never raises."""
        self._enabled = []
        link = self._link
        if link is None or policy == "hold":
            return
        torque = self._table["torque_enable"]
        values = dict.fromkeys(self._index, torque.to_bytes(0))
        with link.patient(_STOP_PATIENCE_S):
            self._attempt(lambda: link.sync_write(torque.address, values))
            for servo in self._servos:
                if not (self._released(link, servo.id) or self._released(link, servo.id)):
                    log.warning("%s (id %d) does not confirm that its torque is off", servo.joint, servo.id)

    def _released(self, link: Dxl2Link, servo: int) -> bool:
        """Whether the torque is off; when it is not, or nobody says so, it is written once more."""
        torque = self._table["torque_enable"]
        off = torque.to_bytes(0)
        answer = self._attempt(lambda: link.read(servo, torque.address, torque.size))
        if answer is not None and answer.params == off:
            return True
        self._attempt(lambda: link.write(servo, torque.address, off))
        return False

    def close(self) -> None:
        if self._link is not None:
            self._link.port.close()
            self._link = None
            self._enabled = []

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
        """Goals of all joints in one packet; those of joints that are not enabled are left out.

        Raises ValueError, with nothing sent, before `enable`, for a goal that is not finite, or one out of range.
        """
        link = self._connected()
        if not self._enabled:
            raise ValueError(f"bus {self.name!r}: no joint is enabled, goals are refused")
        self._check(goals_rad)
        raw = self._goal_ticks(goals_rad).astype(f"<i{self._goal.size}").tobytes()
        size = self._goal.size
        values = {self._servos[i].id: raw[i * size : (i + 1) * size] for i in self._enabled}
        self._counts["writes"] += 1
        link.sync_write(self._goal.address, values)

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        """Read position, velocity and current of all servos that are not silent, and one that is."""
        link = self._connected()
        answers, gaps, missed = self._sweep(link, self._roster.listed)
        for servo, packet in answers.items():
            self._take(link, self._index[servo], packet, now_s)
        for servo in self._roster.blame(bool(answers), gaps, missed, now_s):
            log.warning("%s (id %d) is silent", self.joints[self._index[servo]], servo)
        self._probe(link, now_s)
        return self._readings(now_s)

    def statistics(self) -> Mapping[str, Any]:
        return {**self._counts, "silent": self._roster.silent, "faults": list(self._faults)}

    # --- goals --------------------------------------------------------------------------------------------------

    def _check(self, goals_rad: Doubles) -> None:
        if goals_rad.shape != self._lowest.shape:
            raise ValueError(f"bus {self.name!r} has {len(self.joints)} joints, got goals of shape {goals_rad.shape}")
        inside = (goals_rad >= self._lowest - 1e-9) & (goals_rad <= self._highest + 1e-9)  # NaN is not inside
        if not inside.all():
            i = int(np.argmin(inside))
            allowed = f"{self._lowest[i]:g}..{self._highest[i]:g} rad"
            raise ValueError(f"goal of {self.joints[i]} = {goals_rad[i]:g} rad is not in {allowed}")

    def _goal_ticks(self, goals_rad: Doubles) -> NDArray[np.int64]:
        ticks = self._conversion.to_ticks(goals_rad)
        for i in self._enabled:
            servo, goal = self._servos[i], goals_rad[i]
            if self._lowest[i] < servo.min_rad or self._highest[i] > servo.max_rad:
                # On its way in from outside: the conversion would jump to the limit, so the tick is worked out here.
                if not servo.min_rad <= goal <= servo.max_rad:
                    ticks[i] = round((goal - self._rad_at_zero[i]) / self._rad_per_tick[i])
                self._lowest[i] = min(servo.min_rad, goal)
                self._highest[i] = max(servo.max_rad, goal)
        return ticks

    # --- answers ------------------------------------------------------------------------------------------------

    def _sweep(self, link: Dxl2Link, ids: Sequence[int]) -> tuple[dict[int, Packet], list[int], list[int]]:
        """(answers, ids at which the chain broke, ids that were passed over)."""
        answers: dict[int, Packet] = {}
        gaps: list[int] = []
        missed: list[int] = []
        rest = list(ids)
        for attempt in range(_REQUESTS):
            # When nothing at all came, the wire gets a second chance before its first servo is suspected.
            if not rest or (not answers and attempt > min(self._roster.quiet_polls, 1)):
                break
            self._counts["reads"] += 1
            self._counts["retries"] += attempt > 0
            got = link.sync_read(*self._block, rest)
            answers |= got
            last = max((i for i, servo in enumerate(rest) if servo in got), default=-1)
            missed += [servo for servo in rest[: last + 1] if servo not in got]
            gaps += rest[last + 1 : last + 2]
            rest = rest[last + 2 :]
        self._counts["errors"] += len(gaps) + len(missed)
        return answers, gaps, missed

    def _probe(self, link: Dxl2Link, now_s: float) -> None:
        """Ask the silent servo that has waited longest."""
        servo = self._roster.due(now_s)
        if servo is None:
            return
        self._counts["retries"] += 1
        answer = link.read(servo, *self._block)
        if answer is None:
            self._roster.probe_failed(servo, now_s)
            return
        index = self._index[servo]
        self._counts["reconnects"] += 1
        self._take(link, index, answer, now_s)
        log.warning("%s (id %d) answers again", self.joints[index], servo)
        torque = self._table["torque_enable"]
        state = link.read(servo, torque.address, torque.size)
        lost = state is not None and state.params == torque.to_bytes(0)
        if lost and index in self._enabled and self._seen[index].fault is None:
            self._note_fault(index, _TORQUE_LOST)

    def _take(self, link: Dxl2Link, index: int, packet: Packet, now_s: float) -> None:
        seen = self._seen[index]
        self._roster.answered(self._servos[index].id)
        if packet.error & ~ALERT:
            self._counts["errors"] += 1
            return
        current, velocity, position = (f.from_bytes(packet.params[at : at + f.size]) for f, at in self._fields)
        self._ticks[index] = position
        seen.seen_s, seen.velocity_raw = now_s, velocity
        seen.current_mA = self._fields[0][0].to_unit(current)
        if packet.error & ALERT and seen.fault in (None, _TORQUE_LOST):
            self._note_fault(index, self._read_fault(link, index))
        elif not packet.error & ALERT and seen.fault != _TORQUE_LOST:
            seen.fault = None

    def _read_fault(self, link: Dxl2Link, index: int) -> str:
        status = self._table["hardware_error_status"]
        answer = link.read(self._servos[index].id, status.address, status.size)
        bits = status.from_bytes(answer.params) if answer is not None else 0
        return self._tables[index].fault_names(bits) or "hardware error"

    def _note_fault(self, index: int, fault: str | None) -> None:
        self._seen[index].fault = fault
        if fault is not None:
            named = f"{self.joints[index]}: {fault}"
            if named not in self._faults:
                log.warning("%s (id %d): %s", self.joints[index], self._servos[index].id, fault)
            self._faults[named] = None

    def _readings(self, now_s: float) -> Mapping[str, Reading]:
        angles = self._conversion.to_rad(self._ticks).tolist()
        raw = np.array([seen.velocity_raw for seen in self._seen])
        velocities = (raw * self._rad_s_per_raw).tolist()
        out: dict[str, Reading] = {}
        for joint, seen, angle, velocity in zip(self.joints, self._seen, angles, velocities, strict=True):
            if seen.seen_s is None:
                out[joint] = Reading(None, float("inf"), seen.fault)
            else:
                extra = {"current_mA": seen.current_mA, "velocity_rad_s": velocity}
                out[joint] = Reading(angle, now_s - seen.seen_s, seen.fault, extra)
        return out


def _common_table(name: str, tables: Sequence[Table]) -> Table:
    """One sync request has one address: servos of a bus must agree where the registers of every tick lie."""
    first = tables[0]
    for table in tables[1:]:
        for register in (*_POLLED, "goal_position", "torque_enable", "hardware_error_status"):
            if table[register] != first[register]:
                raise ConfigError(
                    f"bus {name!r}: {table.model} and {first.model} have {register} at different places "
                    "and cannot share a bus"
                )
    return first
