"""A bus of servos with registers, whatever their protocol.

Four promises:

1. Torque comes on without a jump: goal := present, read back, then torque. A servo that stands outside the limits of
   its joint is held where it stands; it may come in, and never go further out. One that stands outside its own stored
   limits is moved inside by its own profile, slowly.
2. One servo never costs the frame. What becomes of each is its own `Member`'s affair; `StatusPoll` asks them within a
   time budget. Each joint has its own last position, age and fault.
3. What was away (a servo, the wire, the supply) is found again, checked and switched on as at start-up, beside the
   work of the others; until then its goals are withheld.
4. Torque off is written before anything is asked, to all at once, and then again until it is confirmed.

A missed answer is followed through three files: `status_poll` notices it, `member` says what it means, and here is
what is done about it.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from threading import RLock
from typing import Any, ClassVar, Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import BusConfig, Faults
from sfms_robot.config.wire_time import Framing
from sfms_robot.errors import BusError, PacketError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import STOP_S, StopPolicy, TickConversion
from sfms_robot.servo.bus import WireBus
from sfms_robot.servo.chain.fault_reporter import FaultReporter
from sfms_robot.servo.chain.link import AWAY_LATE_S, RegisterLink
from sfms_robot.servo.chain.member import ONLINE, REDUCED, REJOINING, Member, members_of
from sfms_robot.servo.chain.repeated_writes import RepeatedWrites
from sfms_robot.servo.chain.settings import Settings
from sfms_robot.servo.chain.startup import LONGEST_READ, PATIENCE_S, Startup
from sfms_robot.servo.chain.status_poll import TURN_S, StatusPoll
from sfms_robot.servo.chain.telemetry import Telemetry
from sfms_robot.servo.chain.verified_write import finish
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Field, Table

log = logging.getLogger(__name__)

READ_DEADLINE_S: Final = 0.003  # what a silent servo costs, once
_CONFIRM_S: Final = 0.35  # that `stop` waits for servos to confirm, at most
_ROUNDS: Final = 20  # of asking them; each costs a mute servo's patience
_STOP_PATIENCE_S: Final = 0.02  # with an adapter that holds answers back
_EXCHANGES: Final = 6  # of members on their way back, in one poll, all together
_SENDING_S: Final = 0.005  # that torque-off waits for goals that are being written
BUS_WATCHDOG: Final = "bus_watchdog"
_NOBODY: Final = np.zeros(0, np.intp)

L = TypeVar("L", bound=RegisterLink)


class ChainBus(WireBus[L], Generic[L]):
    """One wire of servos; a family says how it is asked and told.

    Args:
        name, servos, conversion, open_port, baud: see `WireBus`.
        read_deadline_s: silence that makes a servo silent. The default suits a wire; a simulated one on a busy
            computer needs more.
        config: rate, watchdog and the like; by default those of a head that says nothing about them.
        faults: which faults are acted upon.

    Raises ConfigError for servos that cannot share a bus.
    """

    family: ClassVar[str]
    protocol: ClassVar[int]
    framing: ClassVar[Framing]
    startup: ClassVar[type[Startup[Any]]]

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
        config = config or BusConfig(family="dynamixel2", baud=baud)
        self._config = config.model_copy(update={"baud": baud, "read_deadline_ms": read_deadline_s * 1e3})
        super().__init__(name, servos, conversion, open_port, baud, read_deadline_s, self._config.reconnect_s)
        self._tables = [Table.of(servo.map) for servo in servos]
        self._index = {servo.id: i for i, servo in enumerate(servos)}
        self._telemetry = Telemetry(name, self.family, self.protocol, self._tables, conversion)
        self._reporter = FaultReporter()
        self._members = members_of(servos, self._tables, faults or Faults(), self._reporter)
        self._poll = StatusPoll(name, self._members, self._telemetry, self._config, self._counts, self.framing)
        self._writes = RepeatedWrites(list(self._index))
        self._settings = Settings(self._members, self._tables, self._writes)
        self._enabled = False
        self._places: NDArray[np.intp] = np.zeros(0, np.intp)  # who gets goals
        self._rejoining: list[Member] = []  # who waits for goals that begin where it stands
        self._arrived: list[Member] = []  # who came to hold a position in this poll
        self._stamp_s = 0.0
        self._peak_mA = 0.0
        self._release_packet = b""
        self._released = False  # by `torque_off`: no goal is sent until the next `enable`
        self._warnings: dict[str, list[str]] = {}  # joints by what they store that weakens protection
        self._asked: deque[tuple[int, bool]] = deque()  # released, or resumed (True); not yet passed to members
        self._sending = RLock()
        self._set_up()

    def _set_up(self) -> None:
        """What a family keeps besides, at the end of the constructor. Raises ConfigError for servos it cannot drive."""

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return {joint: self._telemetry.capabilities(index) for index, joint in enumerate(self.joints)}

    @property
    def members(self) -> Sequence[Member]:
        """In bus order: for looking at."""
        return self._members

    @property
    def poll_budget_s(self) -> float:
        """Time that a poll may take, whatever is lost: see `status_poll`."""
        return self._poll.budget_s

    def _begin(self, link: L, tries: int = 3) -> Startup[L]:
        """Return the startup of the family's servos over `link`."""
        return self.startup(
            self.name,
            link,
            self._servos,
            self._tables,
            self._conversion,
            self._baud,
            tries=tries,
            warnings=self._warnings,
        )

    # --- what a family adds -------------------------------------------------------------------------------------

    @abstractmethod
    def _found(self, link: L) -> None:
        """Everybody who answers is identified and prepared: find out how they can be read."""

    @abstractmethod
    def _found_again(self, link: L) -> None:
        """The same wire, opened again."""

    @abstractmethod
    def _sync_write_packet(self, field: Field, values: Mapping[int, int]) -> bytes:
        """Values by id in one packet that nobody answers."""

    @abstractmethod
    def _send(self, link: L, places: NDArray[np.intp], ticks: NDArray[np.int64], now_s: float) -> None:
        """Goals of the servos at `places`; `ticks` (J,)."""

    # --- start and stop -----------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the port, identify and prepare every servo that answers; torque stays on or off.

        Blocks a few exchanges per servo, and for one that does not answer a few times 50 ms. Raises PortError;
        BusError when no servo answers; ServoError for a servo that contradicts the head's file.
        """
        link = self._open()
        try:
            self._warnings.clear()
            bits = self._begin(link).run()
            present = [self._servos[index] for index in bits]
            self._read_deadline_s = link.adapt(present[0].id, *self._telemetry.position)
            self._poll.read_deadline_s = self._read_deadline_s
            self._telemetry.forget()
            self._release_packet = self._packet_off(range(len(self._servos)))
            self._attach(link)
            for member in self._members:
                (member.connected if member.index in bits else member.absent)()
            self._found(link)
            self._stamp_s = link.port.now_s()
            self._poll.measure(link, self._stamp_s)
            for index, status in bits.items():
                self._members[index].take_bits(status, self._telemetry.measured(index), self._stamp_s)
        except BaseException:
            link.port.close()
            raise
        self._forget_silence()
        self._settings.clear()
        self._powered, self._released = frozenset(), False
        self._enabled, self._link = False, link

    def _attach(self, link: L) -> None:
        self._now_s = link.port.now_s
        startup = self._begin(link, tries=1)
        startup.others = lambda: [member.index for member in self._members if member.comes_back]
        self._settings.attach(startup)
        for member in self._members:
            member.attach(startup)

    def _present(self) -> list[int]:
        """Ids of those who are listed."""
        return [member.id for member in self._members if member.liveness.listed]

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        """Torque on for `joints` without a jump, one after the other; angles held, rad, in the order of `joints`.

        Of a joint whose servo has not answered since `connect`: 0 rad, or the end of its range nearest to that, so
        that whoever eases goals has a number to begin with. Its goals are withheld; when it appears it is started up,
        held where it stands, and its reading says `rejoined`.

        Blocks a few exchanges per servo, and `stagger_ms`; for one that stands outside its own stored limits also the
        seconds until its own profile has moved it inside (`slow_profile`). Raises ServoError when a servo refuses or
        falls silent meanwhile, BusError when `torque_off` comes meanwhile; others may then have torque, so call `stop`.
        """
        link = self._connected()
        startup = self._begin(link)
        self._released = False
        self._asked.clear()
        held = []
        for joint in joints:
            index = self.joints.index(joint)
            member = self._members[index]
            if not member.liveness.listed:
                member.awaited()
                servo = self._servos[index]
                held.append(min(max(0.0, servo.min_rad), servo.max_rad))
                log.warning("%s (id %d) does not answer; it comes in when it does", joint, servo.id)
                continue
            self._forget(index)
            self._powered |= {index}
            with link.patient(PATIENCE_S):
                steps = startup.torque_on(index) if member.identified else startup.bring_back(index, reboot=False)
                self._telemetry.ticks[index] = finish(steps, partial(self._wait_enabling, link, joint))
            self._wait_enabling(link, joint, 0.0)
            member.enabled()
            held.append(self._hold(index))
            link.rest(self._config.stagger_ms / 1e3)
        self._enabled = True
        self._update_places()
        return np.array(held)

    def _forget(self, index: int) -> None:
        """A servo is, or was, prepared anew."""
        self._settings.forget(index)

    def _wait_enabling(self, link: L, joint: str, duration_s: float) -> None:
        """Raises BusError, with torque off, when `torque_off` has come."""
        link.wait(duration_s)
        if self._released:
            self.torque_off("release")
            raise BusError(f"bus {self.name!r}: torque off was asked for while {joint} was being enabled")

    def torque_off(self, policy: StopPolicy) -> None:
        """As `ports.Bus`: one sync write to the servos whose joints are to be released.

        Bytes that are on their way to us may collide with it on a wire that goes both ways; `stop` says it again.
        """
        if policy == "hold":
            return
        self._released = True
        self._send_at_once(self._release_packet)

    def release(self, joints: Sequence[str]) -> None:
        """As `ports.Bus`; from any thread."""
        indices = frozenset(self.joints.index(joint) for joint in joints)
        if indices:
            self._asked.extend([(index, False) for index in indices])
            ids = {self._servos[index].id: 0 for index in indices}
            self._send_at_once(self._sync_write_packet(self._telemetry.torque, ids))

    def resume(self, joints: Sequence[str]) -> None:
        """As `ports.Bus`."""
        if self._released:  # by `torque_off`, which perhaps no poll has seen yet
            self._asked.extend([(index, False) for index in range(len(self.joints))])
            self._released = False
        self._asked.extend([(self.joints.index(joint), True) for joint in joints])

    def _send_at_once(self, packet: bytes) -> None:
        alone = self._sending.acquire(timeout=_SENDING_S)  # a goal must not overtake it; a port that hangs may
        try:
            link = self._link
            if link is not None and packet:
                link.port.write(packet)
        except BusError as error:
            log.warning("bus %r: %s", self.name, error)
        finally:
            if alone:
                self._sending.release()

    def _pass_on(self) -> None:
        """Pass what `release` and `resume` asked for to the members, in the thread that they belong to."""
        while self._asked:
            index, back = self._asked.popleft()
            member = self._members[index]
            if back:
                member.called_back(self._now_s())
            else:
                member.released()
        self._update_places()

    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """As `ports.Bus`: torque off first, in one packet, then watchdogs off, in another; then both are read back and
        written again, while there is time. Waits for no servo before the torque is off."""
        self._enabled = False
        self._released |= policy == "release"
        armed = self._settings.changed(BUS_WATCHDOG)
        for member in self._members:
            member.stopped()
        self._settings.clear()
        self._update_places()
        link = self._link
        if link is None and self._lost_s is not None:
            link = self._open_again()  # perhaps it has just come back
            if link is not None:
                self._found_again(link)
        if link is None:
            return
        limp = [i for i, servo in enumerate(self._servos) if policy == "release" and servo.safety.stop == "release"]
        torque, watchdog = self._telemetry.torque, self._tables[0].role(BUS_WATCHDOG)
        self._say_off(link, torque, limp)
        if watchdog is not None:
            self._say_off(link, watchdog, armed)
        budget_s = min(_CONFIRM_S, within_s)
        with link.patient(_STOP_PATIENCE_S), link.within(budget_s, budget_s):
            self._powered -= self._confirm_off(link, torque, limp)
            if watchdog is not None:
                self._confirm_off(link, watchdog, [i for i in armed if i not in limp])

    def _say_off(self, link: L, field: Field, indices: Iterable[int]) -> None:
        values = {self._servos[i].id: field.to_bytes(0) for i in indices}
        if values:
            self._attempt(lambda: link.sync_write(field.address, values))

    def _confirm_off(self, link: L, field: Field, indices: Sequence[int]) -> frozenset[int]:
        """Read a register of all back, and write 0 again to those that do not report 0; return those that do.

        The servo that is asked first in one round is asked last in the next: behind a dead servo the others are silent.
        """
        rest = list(indices)
        for _ in range(len(indices) + _ROUNDS):
            if not rest or not link.affords(link.framing.reads(1, field.size)):
                break
            ids = [self._servos[i].id for i in rest]
            got = self._attempt(partial(self._poll.read_some, link, "stop", (field.address, field.size), ids))
            if got is None:
                break  # the port is gone
            off = field.to_bytes(0)
            rest = [i for i in rest if self._servos[i].id not in got or got[self._servos[i].id].data != off]
            rest = rest[1:] + rest[:1]
            self._say_off(link, field, rest)
        for index in sorted(rest):
            log.warning("%s (id %d) does not confirm that its %s is off", *self._name(index), field.name)
        return frozenset(indices).difference(rest)

    def _name(self, index: int) -> tuple[str, int]:
        return self._servos[index].joint, self._servos[index].id

    def _packet_off(self, indices: Iterable[int]) -> bytes:
        """Torque off for the servos at `indices` whose joints are to be released."""
        released = {self._servos[i].id: 0 for i in indices if self._servos[i].safety.stop == "release"}
        return self._sync_write_packet(self._telemetry.torque, released) if released else b""

    def close(self) -> None:
        """Give the port back; watchdogs that are still on are switched off, so that a held pose stays held."""
        link, watchdog = self._link, self._tables[0].role(BUS_WATCHDOG)
        if link is not None and watchdog is not None:
            self._say_off(link, watchdog, self._settings.changed(BUS_WATCHDOG))
        self._settings.clear()
        self._enabled = False
        for member in self._members:
            member.stopped()
        super().close()

    def _hold(self, index: int) -> float:
        """The angle of a servo that holds where it stands; the range reaches out to it."""
        angle = float(self._conversion.to_rad(self._telemetry.ticks)[index])
        if not self._goals.hold(index, angle):
            servo = self._servos[index]
            stands, low, high = np.degrees([angle, servo.min_rad, servo.max_rad]).round(1)
            log.warning(
                "%s (id %d) stands at %g deg, outside its limits %g..%g, as after hanging without torque: it is held "
                "there and led in (one that hangs on nothing: `sfms-robot head calibrate`)",
                *self._name(index), stands, low, high,
            )  # fmt: skip
        return angle

    # --- every tick ---------------------------------------------------------------------------------------------

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Goals of all joints in one packet; those of joints that are not enabled, or away, are left out.

        Raises ValueError, with nothing sent, before `enable`, for a goal that is not finite, or one out of range.
        While the port is gone nothing is sent and nothing is raised.
        """
        self._check(self._enabled)
        if self._asked:
            self._pass_on()
        if self._accepted(goals_rad):
            self._update_places()
        link = self._link
        places = self._places if link is not None else _NOBODY
        ticks = self._goals.ticks(goals_rad, places)
        if link is None or not len(places):
            return
        with self._sending:
            if self._released or self._asked:
                return
            self._counts["writes"] += 1
            try:
                self._send(link, places, ticks, link.port.now_s())
            except BusError as error:
                self._lose(error, now_s)
            except PacketError as error:  # this one cannot be built: the next may
                self._counts["errors"] += 1
                log.warning("bus %r: %s", self.name, error)

    def _accepted(self, goals_rad: Doubles) -> bool:
        """Whether a rejoining member takes goals from now on."""
        if not self._rejoining:
            return False
        ticks = self._goals.ticks(goals_rad, _NOBODY)
        near = [
            self._goals.allows(member.index, goals_rad[member.index]) and member.accepts(int(ticks[member.index]))
            for member in self._rejoining
        ]
        return any(near)

    def _update_places(self) -> None:
        """Who gets goals; the array stays the same object while it has the same content."""
        self._rejoining = [member for member in self._members if member.state is REJOINING]
        places = [member.index for member in self._members if member.gets_goals]
        if self._places.tolist() != places:
            self._places = np.array(places, np.intp)

    def statistics(self) -> Mapping[str, Any]:
        return {
            **self._counts,
            "silent": [member.id for member in self._members if not member.liveness.listed],
            "faults": list(self._reporter.said),
            "stored_warnings": [f"{', '.join(joints)}: {problem}" for problem, joints in self._warnings.items()],
            **self._unconfirmed(self._released),
            "supply_mA": round(self._telemetry.supply_mA(), 1),
            "supply_peak_mA": round(self._peak_mA, 1),
        }

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        """Position of all servos that are not silent, more of some, and whoever is away is looked after.

        Blocks for `StatusPoll.budget_s` at most. Raises BusError when nobody has answered for so long that the bus
        has failed.
        """
        for member in self._arrived:
            member.rejoined = False
        self._arrived.clear()
        return super().poll(now_s)

    def _ask(self, link: L, now_s: float) -> bool:
        stamp_s = self._stamp_s = link.port.now_s()
        if self._released:
            for member in self._members:
                member.stopped()
        if self._asked:
            self._pass_on()
        with link.within(self._poll.budget_s, self._read_deadline_s + TURN_S):
            heard = self._poll.step(link, stamp_s)
            self._command(link, stamp_s)
            self._bring_back(link, stamp_s)
            self._settings.compare(link, self._poll, stamp_s)
            self._poll.blocks(link, stamp_s)
        self._peak_mA = max(self._peak_mA, self._telemetry.supply_mA())
        self._update_places()
        return heard

    def _readings(self, now_s: float) -> Mapping[str, Reading]:
        """Ages are told by the port's clock, whatever `now_s` counts from."""
        stamp_s = self._stamp_s if self._link is not None else self._now_s()
        rejoined = {member.index for member in self._arrived}
        for index in rejoined:
            self._hold(index)
        faults = [member.fault for member in self._members]
        return self._telemetry.readings(self.joints, faults, rejoined, stamp_s)

    # --- what members want --------------------------------------------------------------------------------------

    def _command(self, link: L, now_s: float) -> None:
        """Torque off, less force: said first, then read back; again in the next poll where nobody confirms it."""
        torque = self._telemetry.torque
        troubled = [member for member in self._members if member.state is not ONLINE]
        released = [member for member in troubled if member.to_release]
        self._writes.drop_all(torque.name)
        for member in released:
            self._writes.want(member.index, torque, 0)
        for member in troubled:
            if member.state is REDUCED:
                self._settings.reduce(member.index)
        if not self._writes:
            return
        self._writes.step(
            link,
            lambda index: self._members[index].liveness.listed,
            lambda where, ids: self._poll.read_some(link, "confirmed", where, ids),
            lambda index, field, value: self._told(index, field, value, now_s),
        )
        for member in released:
            member.off_written |= member.to_release

    def _told(self, index: int, field: Field, value: int, now_s: float) -> None:
        if field.name == self._telemetry.torque.name:
            self._members[index].take_torque(bool(value), now_s)

    def _bring_back(self, link: L, now_s: float) -> None:
        """A poll's share of the jobs of members on their way back; a silence ends it."""
        left, longest = _EXCHANGES, link.framing.reads(1, LONGEST_READ)
        for member in [member for member in self._members if member.state is not ONLINE]:
            while left and member.waits and member.due(now_s):
                if not link.grants("return", longest, alone=True, late_s=AWAY_LATE_S):
                    return
                left -= 1
                self._powered |= {member.index}
                member.step(now_s)
                if member.rejoined:
                    self._back(member)
                elif member.job is None or not link.judged:
                    break

    def _back(self, member: Member) -> None:
        self._counts["reconnects"] += not member.recalled
        self._arrived.append(member)
        self._forget(member.index)
        self._telemetry.ticks[member.index] = member.stands_ticks
        self._telemetry.seen_s[member.index] = member.stands_s

    # --- the port -----------------------------------------------------------------------------------------------

    def _left(self) -> None:
        for member in self._members:
            member.gone()
        self._update_places()

    def _returned(self, link: L, now_s: float) -> None:
        """Everybody is asked alone first."""
        self._attach(link)
        self._found_again(link)
        for member in self._members:
            member.suspect(link.port.now_s(), pause_s=0.0)
