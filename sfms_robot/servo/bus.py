"""Parts that all buses share: checking goals, and opening a lost port again; and a bus without servos.

A port that fails is closed and opened again a few times a second, by the name of its adapter. Meanwhile nothing is sent
and nothing is raised. A bus on which no servo has answered for `reconnect_s` has failed.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np

from sfms_robot.config import BusConfig
from sfms_robot.errors import NOTE, BusError, PacketError, PortError, RobotError, ServoError
from sfms_robot.frames import Doubles, Indices, Ints, Reading, Readings
from sfms_robot.ports import STOP_S, Facts, StopPolicy, TickConversion
from sfms_robot.ranges import Range
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import OpenPort, Port


class Link(Protocol):
    """Requests and answers over a port: a `RegisterLink` for servos with registers, a `RateLimitedPort` for boards."""

    @property
    def port(self) -> Port: ...


T = TypeVar("T")
L = TypeVar("L", bound=Link)
log = logging.getLogger(__name__)

REOPEN_S: Final = 0.2  # interval between two tries to open a lost port
COUNTS: Final = ("writes", "reads", "errors", "retries", "reconnects")  # counters in the statistics of every bus
LEFT_OUT: Final = "left out"  # fault of a joint without a servo in this run
_SLACK_RAD: Final = 1e-9


class Goals:
    """Checks and conversion of the goals of one bus, joints in bus order; `own`: the ranges of the joints, rad.

    A goal may be sent if it lies in the range in force of its joint (`sfms_robot.ranges`).

    Args:
        bus: name of the bus, for messages.
        servos: in joint order.
        conversion: joint angles (J,) <-> ticks (J,), affine per joint.
    """

    def __init__(self, bus: str, servos: Sequence[BusServo], conversion: TickConversion) -> None:
        self._bus = bus
        self._servos = tuple(servos)
        self._conversion = conversion
        self.own = Range(np.array([servo.min_rad for servo in servos]), np.array([servo.max_rad for servo in servos]))
        self._last_rad = self.own.low.copy()  # position at which each joint was found, or its last goal
        self._lowest, self._highest = self.own.low - _SLACK_RAD, self.own.high + _SLACK_RAD
        self._outside = False  # a joint was found outside its own range, and may still be there
        self._rad_at_zero = conversion.to_rad(np.zeros(len(servos), np.int64))
        self.rad_per_tick: Doubles = conversion.to_rad(np.ones(len(servos), np.int64)) - self._rad_at_zero

    def hold(self, index: int, angle_rad: float) -> None:
        """Extend the range in force to the angle at which a servo holds; log an angle outside the joint's own range."""
        self._last_rad[index], servo = angle_rad, self._servos[index]
        if not servo.min_rad <= angle_rad <= servo.max_rad:
            self._outside = True
            stands, low, high = np.degrees([angle_rad, servo.min_rad, servo.max_rad]).round(1)
            log.log(
                NOTE,
                "%s stands at %g deg, outside its limits %g..%g, and is moved back slowly: usual for a joint that hung "
                "without torque (any other: %s)",
                servo, stands, low, high, servo.calibrate,
            )  # fmt: skip

    def allows(self, index: int, goal_rad: float) -> bool:
        """Return whether a goal lies in the range in force of a servo."""
        return bool(self.own.reaching(self._last_rad).holds(np.asarray(goal_rad), _SLACK_RAD)[index])

    def ticks(self, goals_rad: Doubles, sent: Indices) -> Ints:
        """Convert goals (J,) to ticks (J,). The goals at the indices `sent` (n,) are to be sent, and are checked.

        The range in force of a joint that is sent shrinks to its goal; the others keep theirs. Raises ValueError, with
        nothing changed, for another shape, a goal that is not finite, or one of `sent` outside its range in force.
        """
        if goals_rad.shape != self._last_rad.shape:
            raise ValueError(f"bus {self._bus!r} has {len(self._servos)} joints, got goals of shape {goals_rad.shape}")
        if not self._outside and np.logical_and.reduce((goals_rad >= self._lowest) & (goals_rad <= self._highest)):
            return self._conversion.to_ticks(goals_rad)  # the usual case: every own range is the range in force
        finite = np.isfinite(goals_rad)
        if not finite.all():
            raise ValueError(f"goal of {self._servos[int(np.argmin(finite))].joint} is not finite")
        in_force = self.own.reaching(self._last_rad)
        allowed = in_force.holds(goals_rad, _SLACK_RAD)
        refused = sent[~allowed[sent]]
        if refused.size:
            first = int(refused[0])
            valid = f"{in_force.low[first]:g}..{in_force.high[first]:g} rad"
            raise ValueError(f"goal of {self._servos[first].joint} = {goals_rad[first]:g} rad is not in {valid}")
        ticks = self._conversion.to_ticks(goals_rad)
        # The joint moves back into its own range. The conversion would clip to the limit, so the tick is computed here.
        for i in np.flatnonzero(~self.own.holds(goals_rad, _SLACK_RAD) & allowed):
            ticks[i] = round((goals_rad[i] - self._rad_at_zero[i]) / self.rad_per_tick[i])
        self._last_rad[sent] = in_force.nearest(goals_rad)[sent]
        self._outside = not self.own.holds(self._last_rad).all()
        return ticks


def tick_ranges(servos: Sequence[BusServo], conversion: TickConversion) -> Ints:
    """Return the lowest and the highest goal of each joint: (2, J) ticks."""
    ends = np.array([(servo.min_rad, servo.max_rad) for servo in servos]).T
    return np.sort([conversion.to_ticks(end) for end in ends], axis=0)


class WireBus(ABC, Generic[L]):
    """The part of `ports.Bus` that all buses with a port share.

    Args:
        name: name of the bus, for messages.
        servos: in joint order.
        conversion: joint angles (J,) <-> ticks (J,), affine per joint.
        open_port: opens the port at `baud`, and opens it again after the device was gone; the bus owns the port.
        baud: bits per second.
        read_deadline_s: time without a byte after which a servo, or a board, counts as silent.
        config: the bus in the head's file.
    """

    def __init__(
        self,
        name: str,
        servos: Sequence[BusServo],
        conversion: TickConversion,
        open_port: OpenPort,
        baud: int,
        read_deadline_s: float,
        config: BusConfig,
    ) -> None:
        self.name = name
        self.joints = tuple(servo.joint for servo in servos)
        self._servos = tuple(servos)
        self._conversion = conversion
        self._goals = Goals(name, servos, conversion)
        self._open_port = open_port
        self._baud = baud
        self._read_deadline_s = read_deadline_s
        self._config = config
        self._reconnect_s = config.reconnect_s  # time without any answer after which the bus has failed
        self._counts = dict.fromkeys(COUNTS, 0)
        self._link: L | None = None
        self._powered = frozenset[int]()  # ids whose torque came on and has not been confirmed off
        self._forget_silence()

    def _forget_silence(self) -> None:
        self._lost = False  # the port was open and is gone
        self._tried_s = -math.inf
        self._answered_s: float | None = None

    # --- methods that a subclass defines ------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> L:
        """Open the port and return the link over it."""

    @abstractmethod
    def _ask(self, link: L, now_s: float) -> bool:
        """Make the requests of one poll; return whether any was answered."""

    @abstractmethod
    def _left(self) -> None:
        """Note that the port is gone."""

    @abstractmethod
    def _returned(self, link: L, now_s: float) -> None:
        """Note that the port is open again; nothing has been sent yet."""

    @abstractmethod
    def _readings(self, now_s: float) -> Readings:
        """Return the readings of all joints."""

    @abstractmethod
    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """Switch torque off and confirm it, see `ports.Bus`."""

    # --- methods of all buses -----------------------------------------------------------------------------------

    def poll(self, now_s: float) -> Readings:
        """Make the requests of one poll; return the latest reading of every joint.

        Raises BusError if the bus has failed: no servo has answered for `_reconnect_s`.
        """
        if self._lost:
            self._reopen(now_s)
        link = self._link if self._lost else self._connected()
        if link is not None:
            try:
                if self._ask(link, now_s):
                    self._answered_s = now_s
            except BusError as error:
                self._lose(error, now_s)
            except (ServoError, PacketError) as error:  # the error concerns one servo or one packet; the port works
                self._count_error(error)
        if self._answered_s is None:
            self._answered_s = now_s
        if now_s - self._answered_s > self._reconnect_s:
            raise BusError(f"bus {self.name!r}: no answer from any servo for {self._reconnect_s:g} s")
        return self._readings(now_s)

    def close(self) -> None:
        """Close the port. Idempotent."""
        if self._link is not None:
            self._link.port.close()
        self._link = None
        self._forget_silence()

    def _unconfirmed(self, off: bool) -> dict[str, list[str]]:
        """Return the entry of the statistics that lists the joints whose torque is not confirmed off.

        `off`: torque off was sent. Joints that hold on purpose, and those whose torque never came on, are left out.
        """
        powered = [servo for servo in self._servos if off and servo.id in self._powered]
        return {"torque_unconfirmed": [servo.joint for servo in powered if servo.safety.stop == "release"]}

    def _connected(self) -> L:
        if self._link is None:
            raise BusError(f"bus {self.name!r} is not connected")
        return self._link

    def _count_error(self, error: RobotError) -> None:
        self._counts["errors"] += 1
        log.warning("bus %r: %s", self.name, error)

    def _attempt(self, request: Callable[[], T]) -> T | None:
        """Make a request that must not raise; return None if it failed, which is logged and counted."""
        try:
            return request()
        except RobotError as error:
            self._count_error(error)
            return None

    def _check(self, enabled: bool) -> None:
        """Raise BusError before `connect`, or ValueError before `enable`."""
        if not self._lost:
            self._connected()
        if not enabled:
            raise ValueError(f"bus {self.name!r}: no joint is enabled, goals are refused")

    def _lose(self, error: BusError, now_s: float) -> None:
        log.warning("bus %r: %s; trying to open it again", self.name, error)
        self._counts["errors"] += 1
        if self._link is not None:
            self._link.port.close()
        self._link, self._lost, self._tried_s = None, True, now_s
        self._left()

    def _reopen(self, now_s: float) -> None:
        if now_s - self._tried_s < REOPEN_S:
            return
        self._tried_s = now_s
        if (link := self._open_again()) is not None:
            log.info("bus %r: %s is back", self.name, link.port.name)
            self._counts["reconnects"] += 1
            self._returned(link, now_s)

    def _open_again(self) -> L | None:
        try:
            self._link = self._open()
        except (PortError, BusError):
            return None  # still gone
        self._lost = False
        return self._link


class AbsentBus:
    """`ports.Bus` of joints that have no servo in this run: left out by the user, or not built yet.

    It accepts goals, sends nothing, and marks every joint as left out. It opens no port and never raises.

    Args:
        servos: in joint order; only joint names and limits count.
    """

    def __init__(self, servos: Sequence[BusServo]) -> None:
        self._held = {servo.joint: servo.nearest_to_zero_rad for servo in servos}
        self.joints = tuple(self._held)
        self.capabilities = dict.fromkeys(self._held, frozenset[str]())

    def _nothing(self, *arguments: Any, **more: Any) -> None:
        """Do nothing: there is no servo, and no torque."""

    connect = write = release = resume = torque_off = stop = close = _nothing

    def enable(self, joints: Sequence[str]) -> Doubles:
        """Return 0 rad for every joint, or the end of its range nearest to 0."""
        return np.array([self._held[joint] for joint in joints])

    def poll(self, now_s: float) -> Readings:
        """Return a reading without a position for every joint."""
        return {joint: Reading(None, math.inf, LEFT_OUT) for joint in self.joints}

    def statistics(self) -> Facts:
        """Return the counters of the report."""
        return {**dict.fromkeys(COUNTS, 0), "silent": [], "faults": [f"{joint}: {LEFT_OUT}" for joint in self.joints]}
