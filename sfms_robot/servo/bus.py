"""What every bus does about its wire, whatever hangs on it: refuse bad goals, lose the port and find it again.

A port that fails is closed and opened again, a few times a second, by what its adapter is called; meanwhile nothing is
sent and nothing is raised. A bus on which nobody has answered for `reconnect_s` has failed.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Generic, Protocol, TypeVar

from sfms_robot.config import BusConfig
from sfms_robot.errors import BusError, PacketError, PortError, RobotError, ServoError
from sfms_robot.frames import Reading
from sfms_robot.ports import STOP_S, StopPolicy, TickConversion
from sfms_robot.servo.goals import Goals
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port


class Link(Protocol):
    """Whatever speaks over a port."""

    @property
    def port(self) -> Port: ...


T = TypeVar("T")
L = TypeVar("L", bound=Link)
log = logging.getLogger(__name__)

REOPEN_S: Final = 0.2
RECONNECT_S: Final = BusConfig.model_fields["reconnect_s"].default


class WireBus(ABC, Generic[L]):
    """The part of `ports.Bus` that is about one wire.

    Args:
        name: of the bus, for messages.
        servos: in joint order.
        conversion: joint angles (J,) <-> ticks (J,), affine per joint.
        open_port: opens the port at `baud`, also again when the device was gone; the bus owns what it returns.
        baud: bits per second.
        read_deadline_s: silence that makes a servo, or a board, silent.
        reconnect_s: silence of everybody that makes a failed bus.
    """

    def __init__(
        self,
        name: str,
        servos: Sequence[BusServo],
        conversion: TickConversion,
        open_port: Callable[[], Port],
        baud: int,
        read_deadline_s: float,
        reconnect_s: float = RECONNECT_S,
    ) -> None:
        self.name = name
        self.joints = tuple(servo.joint for servo in servos)
        self._servos = tuple(servos)
        self._conversion = conversion
        self._goals = Goals(name, servos, conversion)
        self._open_port = open_port
        self._baud = baud
        self._read_deadline_s = read_deadline_s
        self._reconnect_s = reconnect_s
        self._counts = {"writes": 0, "reads": 0, "errors": 0, "retries": 0, "reconnects": 0}
        self._link: L | None = None
        self._powered: frozenset[int] = frozenset()  # places whose torque came on and is not confirmed off
        self._forget_silence()

    def _forget_silence(self) -> None:
        self._lost_s: float | None = None
        self._tried_s = -math.inf
        self._heard_s: float | None = None

    # --- what a family adds -------------------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> L:
        """The port, and who speaks over it."""

    @abstractmethod
    def _ask(self, link: L, now_s: float) -> bool:
        """A poll's share of questions; whether anybody answered."""

    @abstractmethod
    def _left(self) -> None:
        """The port is gone."""

    @abstractmethod
    def _returned(self, link: L, now_s: float) -> None:
        """The port is there again; nobody has been asked yet."""

    @abstractmethod
    def _readings(self, now_s: float) -> Mapping[str, Reading]: ...

    @abstractmethod
    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None: ...

    # --- what all do --------------------------------------------------------------------------------------------

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        """What is known of every joint now; whoever is away is looked after.

        Raises BusError when nobody has answered for so long that the bus has failed.
        """
        if self._lost_s is not None:
            self._reopen(now_s)
        link = self._link if self._lost_s is not None else self._connected()
        if link is not None:
            try:
                if self._ask(link, now_s):
                    self._heard_s = now_s
            except BusError as error:
                self._lose(error, now_s)
            except (ServoError, PacketError) as error:  # about one servo or one packet: the port is there
                self._counts["errors"] += 1
                log.warning("bus %r: %s", self.name, error)
        if self._heard_s is None:
            self._heard_s = now_s
        if now_s - self._heard_s > self._reconnect_s:
            raise BusError(f"bus {self.name!r}: nobody has answered for {self._reconnect_s:g} s")
        return self._readings(now_s)

    def close(self) -> None:
        """Give the port back. Idempotent."""
        if self._link is not None:
            self._link.port.close()
        self._link = None
        self._forget_silence()

    def _unconfirmed(self, off: bool) -> dict[str, list[str]]:
        """Return the entry of the statistics that lists the joints whose torque is not confirmed off.

        `off`: torque off was sent. Joints that hold on purpose, and those whose torque never came on, are left out.
        """
        powered = [self._servos[place] for place in sorted(self._powered)] if off else []
        return {"torque_unconfirmed": [servo.joint for servo in powered if servo.safety.stop == "release"]}

    def _connected(self) -> L:
        if self._link is None:
            raise BusError(f"bus {self.name!r} is not connected")
        return self._link

    def _attempt(self, request: Callable[[], T]) -> T | None:
        """What must not raise: the failure is said and counted."""
        try:
            return request()
        except RobotError as error:
            self._counts["errors"] += 1
            log.warning("bus %r: %s", self.name, error)
            return None

    def _check(self, enabled: bool) -> None:
        """Raises BusError before `connect`, ValueError before `enable`."""
        if self._lost_s is None:
            self._connected()
        if not enabled:
            raise ValueError(f"bus {self.name!r}: no joint is enabled, goals are refused")

    def _lose(self, error: BusError, now_s: float) -> None:
        log.warning("bus %r: %s; trying to open it again", self.name, error)
        self._counts["errors"] += 1
        if self._link is not None:
            self._link.port.close()
        self._link, self._lost_s, self._tried_s = None, now_s, now_s
        self._left()

    def _reopen(self, now_s: float) -> None:
        if now_s - self._tried_s < REOPEN_S:
            return
        self._tried_s = now_s
        if (link := self._open_again()) is not None:
            log.warning("bus %r: %s is back", self.name, link.port.name)
            self._counts["reconnects"] += 1
            self._returned(link, now_s)

    def _open_again(self) -> L | None:
        try:
            self._link = self._open()
        except (PortError, BusError):
            return None  # still gone
        self._lost_s = None
        return self._link
