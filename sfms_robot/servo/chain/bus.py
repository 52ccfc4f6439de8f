"""A bus of servos with registers, for every family.

Four promises:

1. Torque comes on without a jump: goal := present, read back, then torque. A servo that stands outside the limits of
   its joint is held in place; it may move towards the limits, but never further out. A servo that stands outside its
   own stored limits is moved inside slowly, by its own profile.
2. Trouble with one servo never costs a frame. Each servo has its own state (`Member`), and `StatusPoll` reads the
   servos within a time budget. Each joint has its own last position, age and fault.
3. A servo, wire or supply that was lost is found again, checked and switched on as at startup, while the other servos
   keep working. Until then it gets no goals.
4. Torque off is written to all servos at once, before any request, and again until it is confirmed.

A lost answer passes through three files: `poll` detects it, `member` decides what it means, and this file acts on it.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Iterable, Sequence
from functools import partial
from threading import RLock
from typing import ClassVar, Final

import numpy as np

from sfms_robot.config import BusConfig, Faults
from sfms_robot.errors import BusError, PacketError
from sfms_robot.frames import Doubles, Indices, Ints, Readings
from sfms_robot.ports import STOP_S, Facts, StopPolicy, TickConversion
from sfms_robot.servo.bus import WireBus
from sfms_robot.servo.chain.link import AWAY_LATE_S, TRIES, RegisterLink, finish
from sfms_robot.servo.chain.member import Member, Notices
from sfms_robot.servo.chain.poll import TURN_S, StatusPoll
from sfms_robot.servo.chain.settings import BUS_WATCHDOG, Settings
from sfms_robot.servo.chain.startup import LONGEST_READ, PATIENCE_S, Startup, needs_of, start_up
from sfms_robot.servo.chain.telemetry import Telemetry, raw_type
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import OpenPort
from sfms_robot.servo.registers import Field

log = logging.getLogger(__name__)

_CONFIRM_S: Final = 0.35  # longest wait of `stop` for confirmations
_ROUNDS: Final = 20  # attempts of `stop` to confirm torque off, plus one per servo; each waits for silent servos
_STOP_PATIENCE_S: Final = 0.02  # shortest wait for an answer in `stop`: an adapter may hold answers back
_EXCHANGES: Final = 6  # exchanges in one poll, for all returning members together
_SENDING_S: Final = 0.005  # longest wait of torque off for goals that are being written
_WATCHDOG_TICK_S: Final = 0.02
_STALL: Final = 0.8  # part of the watchdog's time; after so long without a goal it may have tripped
_NO_PLACES: Final = np.zeros(0, np.intp)


class ChainBus(WireBus[RegisterLink]):
    """Servo bus over one wire, with servos of one family.

    Args:
        name, servos, conversion, open_port, baud: see `WireBus`.
        read_deadline_s: time without a byte after which a servo counts as silent.
        config: rate, watchdog and other settings; `baud` and `read_deadline_s` replace the values in it.
        faults: selects the faults that are acted upon.

    Attributes:
        maps: family and protocol of its firmware maps.
        link, startup: the classes that make requests and start up a servo.

    Raises ConfigError for servos that cannot share a bus.
    """

    maps: ClassVar[tuple[str, int]]
    link: ClassVar[type[RegisterLink]]
    startup: ClassVar[type[Startup]]

    def __init__(
        self,
        name: str,
        servos: Sequence[BusServo],
        conversion: TickConversion,
        open_port: OpenPort,
        baud: int,
        read_deadline_s: float,
        config: BusConfig,
        faults: Faults,
    ) -> None:
        config = config.model_copy(update={"baud": baud, "read_deadline_ms": read_deadline_s * 1e3})
        super().__init__(name, servos, conversion, open_port, baud, read_deadline_s, config)
        self._ids = np.array([servo.id for servo in servos])
        self._telemetry = Telemetry(name, *self.maps, [servo.table for servo in servos], conversion)
        self.capabilities = {joint: self._telemetry.capabilities(index) for index, joint in enumerate(self.joints)}
        self._faults: dict[str, None] = {}  # faults reported so far, for the statistics
        self._warnings: dict[str, list[str]] = {}  # a stored value that weakens protection -> joints
        self._startups = [
            self.startup(servo, needs, self._warnings, lambda: [m.startup for m in self._members if m.comes_back])
            for servo, needs in zip(servos, needs_of(servos, conversion, faults), strict=True)
        ]
        self._notices = Notices(name, len(servos))
        self._members = [Member(i, each, faults, self._faults, self._notices) for i, each in enumerate(self._startups)]
        self._poll = StatusPoll(name, self._members, self._telemetry, config, self._counts, self.link.framing)
        self._settings = Settings(self._members, self._telemetry.torque, self._poll)
        self._enabled = False
        self._places = _NO_PLACES  # indices of the members that get goals
        self._rejoining: list[Member] = []  # members that wait for a goal near their position
        self._arrived = set[int]()  # indices of members that returned in this poll, and hold a position
        self._stamp_s = 0.0
        self._peak_mA = 0.0
        self._released_ids = [servo.id for servo in servos if servo.safety.stop == "release"]
        self._release_packet = self._packet_off(self._released_ids)
        self._released = False  # by `torque_off` or `stop`: no goal is sent until `enable` or `resume`
        self._asked = deque[tuple[int, bool]]()  # (index, True: resumed, False: released), not yet passed to members
        self._sending = RLock()
        goal = self._telemetry.goal
        # Protocol 2.0 goals are encoded as one array; other goals one by one, each checked against its sign rule.
        simple = self.maps[1] == 2 and goal.signed in ("no", "twos_complement")
        self._goal_type = np.dtype([("id", np.uint8), ("goal", raw_type(goal))]) if simple else None
        self._watchdog = math.ceil(config.watchdog_ms / 1e3 / _WATCHDOG_TICK_S)
        self._wrote_s = math.inf
        self._fed: Indices | None = None  # places whose watchdogs are armed

    def _open(self) -> RegisterLink:
        """Open the port, and pass the link over it to the poll and the startups."""
        link = self._poll.link = self.link(self._open_port(), self._baud, self._read_deadline_s)
        for startup in self._startups:
            startup.link = link
        self._now_s = link.port.now_s
        return link

    # --- start --------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the port, identify and prepare every servo that answers; leave torque unchanged.

        Blocks for a few exchanges per servo, and for a few times 50 ms per servo that does not answer. Raises
        PortError; BusError if no servo answers; ServoError for a servo that contradicts the head's file.
        """
        link = self._open()
        try:
            self._warnings.clear()
            bits = start_up(self.name, link, self._startups, self._baud)
            present = [self._servos[index].id for index in bits]
            self._read_deadline_s = link.adapt(present[0], *self._telemetry.position)
            self._poll.read_deadline_s = self._read_deadline_s
            self._telemetry.forget()
            for member in self._members:
                member.connected(member.index in bits)
            self._poll.find_reads(present, self._startups[0].table.byte_order == "little")
            self._wrote_s = math.inf
            self._stamp_s = link.port.now_s()
            self._poll.measure(self._stamp_s)
            for index, status in bits.items():
                self._members[index].take_bits(status, self._telemetry.measured(index), self._stamp_s)
        except BaseException:
            link.port.close()
            raise
        self._forget_silence()
        self._settings.clear()
        self._powered, self._released = frozenset(), False
        self._enabled, self._link = False, link

    def enable(self, joints: Sequence[str]) -> Doubles:
        """Switch torque on for `joints` without a jump, one after the other; return the angles held, rad.

        The angle of a joint whose servo does not answer is 0 rad, or the end of its range nearest to 0, so that easing
        goals can begin with a number. The servo gets no goals. When it appears, it is started up and held where it
        stands, and its reading has `rejoined`.

        Blocks for a few exchanges and `stagger_ms` per servo. For a servo that stands outside its own stored limits it
        also blocks for the seconds until its own profile has moved it inside. Raises ServoError if a servo refuses or
        stops answering, BusError if `torque_off` is called meanwhile. Other servos may then have torque: call `stop`.
        """
        link = self._connected()
        self._released = False
        self._asked.clear()
        held = []
        for joint in joints:
            index = self.joints.index(joint)
            member, startup = self._members[index], self._startups[index]
            if not member.listed:
                member.awaited()
                held.append(member.servo.nearest_to_zero_rad)
                self._notices.add(member.servo, "does not answer; it is started when it answers")
                continue
            self._forget(member)
            self._powered |= {member.id}
            with link.patient(PATIENCE_S, TRIES):
                steps = startup.torque_on() if member.identified else startup.bring_back(reboot=False)
                self._telemetry.ticks[index] = finish(steps, partial(self._wait_enabling, link, joint))
            self._wait_enabling(link, joint, 0.0)
            member.enabled()
            held.append(self._hold(index))
            link.rest(self._config.stagger_ms / 1e3)
        self._enabled = True
        self._update_places()
        return np.array(held)

    def _forget(self, member: Member) -> None:
        """Forget the changes to a servo that is, or was, prepared again, which also switches its watchdog off."""
        self._settings.forget(member.id)
        self._fed = None

    def _wait_enabling(self, link: RegisterLink, joint: str, duration_s: float) -> None:
        """Wait; if `torque_off` was called, write torque off again and raise BusError."""
        link.wait(duration_s)
        if self._released:
            self.torque_off("release")
            raise BusError(f"bus {self.name!r}: torque off was requested while {joint} was being enabled")

    def _hold(self, index: int) -> float:
        """Extend the range of a servo to the position that it holds; return its angle."""
        angle = float(self._conversion.to_rad(self._telemetry.ticks)[index])
        self._goals.hold(index, angle)
        return angle

    # --- torque off, and on again -------------------------------------------------------------------------------

    def torque_off(self, policy: StopPolicy) -> None:
        """Write torque off to the servos whose joints are to be released, in one packet; see `ports.Bus`.

        On a wire that carries both directions the packet may collide with an incoming answer; `stop` repeats it.
        """
        if policy == "hold":
            return
        self._released = True
        self._send_at_once(self._release_packet)

    def release(self, joints: Sequence[str]) -> None:
        """Write torque off to the servos of `joints`; see `ports.Bus`. May be called from any thread."""
        indices = frozenset(self.joints.index(joint) for joint in joints)
        if indices:
            self._asked.extend([(index, False) for index in indices])
            self._send_at_once(self._packet_off(self._servos[index].id for index in indices))

    def resume(self, joints: Sequence[str]) -> None:
        """Request that joints are brought back; see `ports.Bus`."""
        if self._released:  # by `torque_off`, which a poll may not have passed to the members yet
            self._asked.extend([(index, False) for index in range(len(self.joints))])
            self._released = False
        self._asked.extend([(self.joints.index(joint), True) for joint in joints])

    def _packet_off(self, ids: Iterable[int]) -> bytes:
        """Return the packet that switches torque off for servos; empty without servos."""
        torque = self._telemetry.torque
        values = dict.fromkeys(ids, torque.to_bytes(0))
        return self.link.sync_write_packet(torque.address, values) if values else b""

    def _send_at_once(self, packet: bytes) -> None:
        alone = self._sending.acquire(timeout=_SENDING_S)  # no goal may follow; a port that hangs is not waited for
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
        """Pass requests of `release` and `resume` to the members, in the thread that may use members."""
        while self._asked:
            index, back = self._asked.popleft()
            member = self._members[index]
            if back:
                member.called_back(self._now_s())
            else:
                member.released()
        self._update_places()

    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """Write torque off in one packet, then watchdogs off in another; read both back and repeat while time is left.

        Does not wait for any servo before torque off is written.
        """
        self._enabled = False
        self._released |= policy == "release"
        armed = self._settings.changed(BUS_WATCHDOG)
        self._stop_members()
        self._update_places()
        link = self._link
        if link is None and self._lost:
            link = self._open_again()  # the device may just have come back
        if link is None:
            return
        limp = self._released_ids if policy == "release" else []
        torque, watchdog = self._telemetry.torque, self._startups[0].table.role(BUS_WATCHDOG)
        self._write_off(link, torque, limp)
        if watchdog is not None:
            self._write_off(link, watchdog, armed)
        budget_s = min(_CONFIRM_S, within_s)
        with link.patient(_STOP_PATIENCE_S), link.within(budget_s, budget_s):
            self._powered -= self._confirm_off(link, torque, limp)
            if watchdog is not None:
                self._confirm_off(link, watchdog, [servo for servo in armed if servo not in limp])
        self._notices.log()

    def _stop_members(self) -> None:
        self._settings.clear()
        for member in self._members:
            member.stopped()

    def _write_off(self, link: RegisterLink, field: Field, ids: Iterable[int]) -> None:
        values = dict.fromkeys(ids, field.to_bytes(0))
        if values:
            self._attempt(lambda: link.sync_write(field.address, values))

    def _confirm_off(self, link: RegisterLink, field: Field, ids: Sequence[int]) -> frozenset[int]:
        """Read a register of all servos back, and write 0 again until they report 0; return the ids that report 0.

        The servo that is read first in one round is read last in the next, since servos behind a dead one are silent.
        """
        rest, where, off = list(ids), (field.address, field.size), field.to_bytes(0)
        for _ in range(len(ids) + _ROUNDS):
            if not rest or not link.affords(link.framing.reads(1, field.size)):
                break
            got = self._attempt(partial(self._poll.read_some, "stop", where, rest))
            if got is None:
                break  # the port is gone
            rest = [servo for servo in rest if servo not in got or got[servo].data != off]
            rest = rest[1:] + rest[:1]
            self._write_off(link, field, rest)
        for servo in self._servos:
            if servo.id in rest:
                self._notices.add(servo, f"does not confirm that its {field.name} is off")
        return frozenset(ids).difference(rest)

    def close(self) -> None:
        """Switch off the watchdogs that are still on, so that a held pose stays held, and close the port."""
        link, watchdog = self._link, self._startups[0].table.role(BUS_WATCHDOG)
        if link is not None and watchdog is not None:
            self._write_off(link, watchdog, self._settings.changed(BUS_WATCHDOG))
        self._enabled = False
        self._stop_members()
        self._notices.log()
        super().close()

    # --- every tick ---------------------------------------------------------------------------------------------

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Send the goals of all joints in one packet, without those of joints that are not enabled or were lost.

        Raises ValueError, with nothing sent, before `enable`, for a goal that is not finite, or one out of range.
        While the port is lost, nothing is sent, and that is not an error.
        """
        self._check(self._enabled)
        if self._asked:
            self._pass_on()
        if self._accepted(goals_rad):
            self._update_places()
        link = self._link
        places = self._places if link is not None else _NO_PLACES
        ticks = self._goals.ticks(goals_rad, places)
        if link is None or not len(places):
            return
        with self._sending:
            if self._released or self._asked:
                return
            self._counts["writes"] += 1
            try:
                self._send(link, places, ticks[places])
            except BusError as error:
                self._lose(error, now_s)
            except PacketError as error:  # the packet cannot be built; the next one perhaps can
                self._count_error(error)

    def _send(self, link: RegisterLink, places: Indices, ticks: Ints) -> None:
        """Send goals `ticks` (n,) to the servos at `places`. After the first goal, every packet feeds the watchdogs."""
        goal, now_s = self._telemetry.goal, link.port.now_s()
        ids = self._ids[places]
        if now_s - self._wrote_s > _STALL * self._watchdog * _WATCHDOG_TICK_S:
            self._settings.look_for_trips()
        self._wrote_s = now_s
        if self._goal_type is not None:
            rows = np.empty(len(ids), self._goal_type)
            rows["id"], rows["goal"] = ids, ticks
            data = rows.tobytes()
        else:
            pairs = zip(ids.tolist(), ticks.tolist(), strict=True)
            data = b"".join(bytes([servo]) + goal.to_bytes(tick) for servo, tick in pairs)
        link.send(link.sync_packet(goal.address, goal.size, data))
        if self._watchdog and places is not self._fed:
            self._fed = places
            self._settings.arm(ids.tolist(), self._watchdog)

    def _accepted(self, goals_rad: Doubles) -> bool:
        """Offer the goals to the rejoining members; return whether one of them gets goals from now on."""
        if not self._rejoining:
            return False
        ticks = self._goals.ticks(goals_rad, _NO_PLACES)
        near = [
            self._goals.allows(member.index, goals_rad[member.index]) and member.accepts(int(ticks[member.index]))
            for member in self._rejoining
        ]
        return any(near)

    def _update_places(self) -> None:
        """Find the members that get goals; the array is replaced only if its content changes."""
        self._rejoining = [member for member in self._members if member.state == "rejoining"]
        places = [member.index for member in self._members if member.gets_goals]
        if self._places.tolist() != places:
            self._places = np.array(places, np.intp)

    def statistics(self) -> Facts:
        """Return the counters of the report."""
        return {
            **self._counts,
            "silent": [member.id for member in self._members if not member.listed],
            "faults": list(self._faults),
            "stored_warnings": [f"{', '.join(joints)}: {problem}" for problem, joints in self._warnings.items()],
            **self._unconfirmed(self._released),
            "supply_mA": round(self._telemetry.supply_mA(), 1),
            "supply_peak_mA": round(self._peak_mA, 1),
        }

    def poll(self, now_s: float) -> Readings:
        """Read the position of all servos that are not silent, more of some, and probe or start up others.

        Blocks for `StatusPoll.budget_s` at most, except for requests that `RegisterLink.grants` allows in addition.
        Raises BusError if no servo has answered for so long that the bus has failed.
        """
        self._arrived.clear()
        return super().poll(now_s)

    def _ask(self, link: RegisterLink, now_s: float) -> bool:
        stamp_s = self._stamp_s = link.port.now_s()
        if self._released:
            for member in self._members:
                member.stopped()
        if self._asked:
            self._pass_on()
        with link.within(self._poll.budget_s, self._read_deadline_s + TURN_S):
            answered = self._poll.step(stamp_s)
            self._settings.command(stamp_s)
            self._bring_back(link, stamp_s)
            self._settings.compare(stamp_s)
            self._poll.blocks(stamp_s)
        self._notices.log(stamp_s)
        self._peak_mA = max(self._peak_mA, self._telemetry.supply_mA())
        self._update_places()
        return answered

    def _readings(self, now_s: float) -> Readings:
        """Return the readings. Ages are measured by the port's clock, since `now_s` may have another origin."""
        stamp_s = self._stamp_s if self._link is not None else self._now_s()
        for index in self._arrived:
            self._hold(index)
        return self._telemetry.readings(self.joints, [member.fault for member in self._members], self._arrived, stamp_s)

    def _bring_back(self, link: RegisterLink, now_s: float) -> None:
        """Run one poll's share of the jobs of returning members; an unanswered request ends it."""
        left, longest = _EXCHANGES, link.framing.reads(1, LONGEST_READ)
        for member in [member for member in self._members if member.state != "online"]:
            while left and member.waits and member.due(now_s):
                if not link.grants("return", longest, alone=True, late_s=AWAY_LATE_S):
                    return
                left -= 1
                self._powered |= {member.id}
                if member.step(now_s):
                    self._counts["reconnects"] += not member.recalled
                    self._arrived.add(member.index)
                    self._forget(member)
                    self._telemetry.ticks[member.index] = member.stands_ticks
                    self._telemetry.seen_s[member.index] = member.stands_s
                elif member.job is None or not link.judged:
                    break

    # --- the port -----------------------------------------------------------------------------------------------

    def _left(self) -> None:
        for member in self._members:
            member.gone()
        self._update_places()

    def _returned(self, link: RegisterLink, now_s: float) -> None:
        """Suspect all members, so that each is probed alone first."""
        for member in self._members:
            member.suspect(link.port.now_s(), pause_s=0.0)
