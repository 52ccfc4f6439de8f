"""What the registers of each servo are to hold while the bus runs, and whether they do.

Startup has written most of them. Two change on the way, the watchdog and the force of a servo that is reduced: they
are written until they are confirmed. All are read back once a second, of several servos at once, as many as the rest
of a poll has time for, and at most one request in a poll. What differs is a named fault.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Protocol

from sfms_robot.servo.chain.link import RegisterLink
from sfms_robot.servo.chain.member import Member
from sfms_robot.servo.chain.repeated_writes import RepeatedWrites
from sfms_robot.servo.chain.status_poll import StatusPoll
from sfms_robot.servo.chain.telemetry import Block
from sfms_robot.servo.policy import torque_register
from sfms_robot.servo.registers import Field, Table

_ROUND_S: Final = 1.0  # in which everybody is compared once
_TOGETHER: Final = 8  # servos in one request
_BLOCK: Final = 40  # bytes of one servo in one request, at most


class Wanted(Protocol):
    """The part of `Startup` that matters here."""

    def wanted(self, index: int) -> Mapping[str, int]: ...


class Settings:
    """Of the servos of one bus, by index in bus order.

    Args:
        members, tables: of each servo; a table may be replaced while the bus runs.
        writes: takes what is to be written until it is confirmed.
    """

    def __init__(self, members: Sequence[Member], tables: Sequence[Table], writes: RepeatedWrites) -> None:
        self._members = members
        self._tables = tables
        self._writes = writes
        self._startup: Wanted | None = None
        self._changed: dict[int, dict[str, int]] = {}  # what holds something else than startup wanted
        self._differing: dict[int, dict[str, tuple[int, int]]] = {}  # (seen, wanted) by name
        self._round: list[tuple[Block, list[int]]] = []  # who is still to be asked for what in this round
        self._part_s = _ROUND_S  # of a round that one servo's block takes
        self._due_s = 0.0

    def attach(self, startup: Wanted) -> None:
        """The wire in use from now on."""
        self._startup = startup

    def wanted(self, index: int) -> Mapping[str, int]:
        """Registers and values that are to be in force now."""
        startup = self._startup.wanted(index) if self._startup is not None else {}
        return {**startup, **self._changed.get(index, {})}

    def change(self, index: int, name: str, value: int) -> None:
        """From now on a register is to hold another value than startup gave it."""
        self._changed.setdefault(index, {})[name] = value
        self._writes.want(index, self._tables[index][name], value)

    def changed(self, name: str) -> list[int]:
        """Who was told to hold something else than 0 in a register."""
        return [index for index, values in self._changed.items() if values.get(name)]

    def reduce(self, index: int) -> None:
        """Half the force that startup gave it: one value, however often this is called."""
        member = self._members[index]
        bounded = member.servo.safety.current_limit_mA is not None and "goal_current" in self._tables[index].fields
        name = "goal_current" if bounded else torque_register(member.servo.map)
        if name is None or name in self._changed.get(index, ()) or name not in self._tables[index].fields:
            return
        self.change(index, name, self.wanted(index).get(name, self._tables[index][name].high) // 2)

    def forget(self, index: int) -> None:
        """It was started up anew."""
        self._writes.drop(index)
        self._changed.pop(index, None)
        self._differing.pop(index, None)

    def clear(self) -> None:
        self._writes.clear()
        self._changed.clear()
        self._differing.clear()

    def compare(self, link: RegisterLink, poll: StatusPoll, now_s: float) -> None:
        """A poll's share of a round. Who does not answer is asked in the next round."""
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
        """Registers of a member, compared: what was changed on the way is written once more."""
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
    return member.gets_goals and member.liveness.listed


def _blocks(fields: Iterable[Field]) -> list[Block]:
    """What to read for registers of one servo: those that lie close enough together at once."""
    blocks: list[Block] = []
    for field in sorted(fields, key=lambda each: each.address):
        end = field.address + field.size
        if blocks and end - blocks[-1][0] <= _BLOCK:
            blocks[-1] = blocks[-1][0], max(blocks[-1][1], end - blocks[-1][0])
        else:
            blocks.append((field.address, field.size))
    return blocks
