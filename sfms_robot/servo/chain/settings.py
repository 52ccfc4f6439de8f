"""The values that the registers of each servo should hold while the bus runs, and whether they do.

Startup has written most of them. Three change while the bus runs: torque of servos that are to be limp, the watchdog,
and the force of a servo that is reduced. They are written in every poll until the servo reports the value: first the
write, unprompted and to all servos in one packet; only then it is read back, as far as the poll has time. Values are
absolute, so that writing one twice does no harm.

All other registers are read back once a second, of several servos at once, as many as the rest of a poll has time for,
and at most one request in a poll. A register that differs is a named fault.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Final

from sfms_robot.servo.chain.link import RegisterLink
from sfms_robot.servo.chain.member import ONLINE, REDUCED, Member
from sfms_robot.servo.chain.poll import StatusPoll
from sfms_robot.servo.chain.startup import Startup
from sfms_robot.servo.chain.telemetry import Block
from sfms_robot.servo.policy import torque_register
from sfms_robot.servo.registers import Field, Table, span_of

BUS_WATCHDOG: Final = "bus_watchdog"
_VERIFIED: Final = 8  # servos that are read back in one poll
_ROUND_S: Final = 1.0  # in which all servos are compared once
_TOGETHER: Final = 8  # servos in one request
_BLOCK: Final = 40  # bytes of one servo in one request, at most

Seen = Callable[[Member, Field, int], None]
Requests = dict[int, tuple[Field, int]]


class RepeatedWrites:
    """Writes that are not confirmed yet: by register name, then by index in bus order, (register, value)."""

    def __init__(self, ids: Sequence[int]) -> None:
        self._ids = list(ids)
        self._index = {servo: index for index, servo in enumerate(ids)}
        self._pending: dict[str, Requests] = {}
        self._read_first: set[tuple[int, str]] = set()

    def __bool__(self) -> bool:
        return any(self._pending.values())

    def __contains__(self, key: tuple[int, str]) -> bool:
        index, name = key
        return index in self._pending.get(name, ())

    def want(self, index: int, field: Field, value: int, *, read_first: bool = False) -> None:
        """Request a value. `read_first`: read the register before a write would overwrite what it reports."""
        self._pending.setdefault(field.name, {})[index] = field, value
        if read_first:
            self._read_first.add((index, field.name))

    def drop(self, index: int, name: str | None = None) -> None:
        """Drop the requests of a servo: of one register, or of all."""
        for each in [name] if name is not None else list(self._pending):
            self._pending.get(each, {}).pop(index, None)

    def drop_all(self, name: str) -> None:
        """Drop the requests of one register."""
        self._pending.pop(name, None)

    def clear(self) -> None:
        """Drop all requests."""
        self._pending.clear()
        self._read_first.clear()

    def step(self, link: RegisterLink, poll: StatusPoll, members: Sequence[Member], seen: Seen) -> None:
        """Write all requests, and read back those of listed members.

        Args:
            seen: called with member, register and value for every servo that reported it.

        Raises BusError if the port fails.
        """
        for name, requests in list(self._pending.items()):
            if not requests:
                del self._pending[name]
                continue
            # One packet has one address and one length: models with another address get another packet.
            packets: dict[Block, tuple[Field, dict[int, int]]] = {}
            for index, (field, value) in requests.items():
                packets.setdefault((field.address, field.size), (field, {}))[1][index] = value
            for where, (field, values) in packets.items():
                read_first = {index for index in values if (index, name) in self._read_first}
                written = {self._ids[i]: field.to_bytes(v) for i, v in values.items() if i not in read_first}
                if written:
                    link.sync_write(field.address, written)
                ids = [self._ids[i] for i in values if members[i].listed][:_VERIFIED]
                for servo, answer in (poll.read_some(link, "confirmed", where, ids) if ids else {}).items():
                    index = self._index[servo]
                    if len(answer.data) == field.size:
                        value = field.from_bytes(answer.data)
                        self._read_first.discard((index, name))
                        if value == values[index]:
                            requests.pop(index, None)
                        else:  # to the back: the others have their turn
                            requests[index] = requests.pop(index)
                        seen(members[index], field, value)


class Settings:
    """The settings of the servos of one bus, by index in bus order.

    Args:
        members, tables: of each servo; a table may be replaced while the bus runs.
        torque: the register of torque enable.
    """

    def __init__(self, members: Sequence[Member], tables: Sequence[Table], torque: Field) -> None:
        self._members = members
        self._tables = tables
        self._torque = torque
        self._writes = RepeatedWrites([member.id for member in members])
        self._startup: Startup | None = None
        self._changed: dict[int, dict[str, int]] = {}  # values other than those of startup
        self._differing: dict[int, dict[str, tuple[int, int]]] = {}  # (seen, wanted) by name
        self._round: list[tuple[Block, list[int]]] = []  # reads still to be made in this round, and of which servos
        self._part_s = _ROUND_S  # of a round that one servo's block takes
        self._due_s = 0.0

    def attach(self, startup: Startup) -> None:
        """Use this startup, over the wire in use from now on."""
        self._startup = startup

    def wanted(self, index: int) -> Mapping[str, int]:
        """Return registers and values that should be in force now."""
        startup = self._startup.wanted(index) if self._startup is not None else {}
        return {**startup, **self._changed.get(index, {})}

    def change(self, index: int, name: str, value: int) -> None:
        """Give a register another value than startup did, from now on."""
        self._changed.setdefault(index, {})[name] = value
        self._writes.want(index, self._tables[index][name], value)

    def changed(self, name: str) -> list[int]:
        """Return the servos that were given another value than 0 in a register."""
        return [index for index, values in self._changed.items() if values.get(name)]

    def forget(self, index: int) -> None:
        """Forget changes of a servo that was started up again."""
        self._writes.drop(index)
        self._changed.pop(index, None)
        self._differing.pop(index, None)

    def clear(self) -> None:
        """Forget all changes."""
        self._writes.clear()
        self._changed.clear()
        self._differing.clear()

    # --- written until they are confirmed -----------------------------------------------------------------------

    def command(self, link: RegisterLink, poll: StatusPoll, now_s: float) -> None:
        """Write torque off and less force, then read them back; again in the next poll unless it is confirmed."""
        troubled = [member for member in self._members if member.state is not ONLINE]
        released = [member for member in troubled if member.to_release]
        self._writes.drop_all(self._torque.name)
        for member in released:
            self._writes.want(member.index, self._torque, 0)
        for member in troubled:
            if member.state is REDUCED:
                self._reduce(member)
        if not self._writes:
            return
        self._writes.step(link, poll, self._members, partial(self._seen, now_s))
        for member in released:
            member.off_written |= member.to_release

    def _seen(self, now_s: float, member: Member, field: Field, value: int) -> None:
        """Take the value of a register that was written."""
        if field.name == self._torque.name:
            member.take_torque(bool(value), now_s)
        elif field.name == BUS_WATCHDOG and value < 0:  # it has tripped
            self._writes.drop(member.index, BUS_WATCHDOG)
            member.distrust("watchdog", now_s)

    def arm(self, indices: Iterable[int], watchdog: int) -> None:
        """Set the watchdogs that stop the servo."""
        armed = self.changed(BUS_WATCHDOG)
        for index in indices:
            if index not in armed and self._tables[index].watchdog == "stops":
                self.change(index, BUS_WATCHDOG, watchdog)

    def look_for_trips(self) -> None:
        """Read all armed watchdogs: a servo whose watchdog has tripped ignores goals until it is brought back."""
        for index in self.changed(BUS_WATCHDOG):
            value = self._changed[index][BUS_WATCHDOG]
            self._writes.want(index, self._tables[index][BUS_WATCHDOG], value, read_first=True)

    def _reduce(self, member: Member) -> None:
        """Halve the force that startup gave a servo: one value, however often this is called."""
        index = member.index
        bounded = member.servo.safety.current_limit_mA is not None and "goal_current" in self._tables[index].fields
        name = "goal_current" if bounded else torque_register(member.servo.map)
        if name is None or name in self._changed.get(index, ()) or name not in self._tables[index].fields:
            return
        self.change(index, name, self.wanted(index).get(name, self._tables[index][name].high) // 2)

    # --- compared once a second ---------------------------------------------------------------------------------

    def compare(self, link: RegisterLink, poll: StatusPoll, now_s: float) -> None:
        """Read a poll's share of a round. A servo that does not answer is read in the next round."""
        if now_s < self._due_s:
            return
        if not self._round:
            self._begin_round()
        if not self._round:
            return
        where, indices = self._round[0]
        count = poll.fitting(link, "settings", where[1], min(_TOGETHER, len(indices)))
        asked, self._round[0] = indices[:count], (where, indices[count:])
        self._due_s = now_s + self._part_s * count
        if count == len(indices):
            del self._round[0]
        there = {self._members[index].id: index for index in asked if _compared(self._members[index])}
        for servo, answer in poll.read_some(link, "settings", where, list(there)).items():
            if len(answer.data) == where[1]:
                self._judge(there[servo], where[0], answer.data)

    def _begin_round(self) -> None:
        blocks: dict[Block, list[int]] = {}
        for member in self._members:
            if _compared(member):
                fields = self._tables[member.index].fields
                for where in _blocks(fields[name] for name in self.wanted(member.index) if name in fields):
                    blocks.setdefault(where, []).append(member.index)
        self._round = list(blocks.items())
        self._part_s = _ROUND_S / max(1, sum(map(len, blocks.values())))

    def _judge(self, index: int, start: int, data: bytes) -> None:
        """Compare the registers of a member; one that was changed while the bus runs is written once more."""
        differing, fields = self._differing.setdefault(index, {}), self._tables[index].fields
        for name, value in self.wanted(index).items():
            field = fields.get(name)
            if field is None or not start <= field.address <= start + len(data) - field.size:
                continue
            seen = field.from_bytes(data[field.address - start :])
            if seen == value or (index, name) in self._writes:
                differing.pop(name, None)
                continue
            differing[name] = seen, value
            if name in self._changed.get(index, ()):
                self._writes.want(index, field, value)
        self._members[index].take_registers(differing)


def _compared(member: Member) -> bool:
    return member.gets_goals and member.listed


def _blocks(fields: Iterable[Field]) -> list[Block]:
    """Return the blocks in which to read registers of one servo: those close enough together are read at once."""
    groups: list[list[Field]] = []
    for field in sorted(fields, key=lambda each: each.address):
        if groups and field.address + field.size - groups[-1][0].address <= _BLOCK:
            groups[-1].append(field)
        else:
            groups.append([field])
    return [span_of(group) for group in groups]
