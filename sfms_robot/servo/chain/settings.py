"""The values that the registers of each servo should hold while the bus runs, and the check that they do.

Startup has written most of them. Three change while the bus runs: torque of servos that are to be limp, the watchdog,
and the force of a servo that is reduced. Each is written in every poll until the servo reports the value. The write
goes to all servos in one packet, and does not wait for a read; then the registers are read back, as far as the poll has
time. Values are absolute, so writing one twice does no harm.

All other registers are read back once a second, by at most one request in a poll, which reads as many servos as the
rest of the poll has time for. A register that differs is a named fault.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Final

from sfms_robot.servo.chain.member import Member
from sfms_robot.servo.chain.poll import StatusPoll
from sfms_robot.servo.chain.telemetry import Block
from sfms_robot.servo.policy import torque_register
from sfms_robot.servo.registers import Field, span_of

BUS_WATCHDOG: Final = "bus_watchdog"
_VERIFIED: Final = 8  # servos whose write is read back in one poll
_ROUND_S: Final = 1.0  # time in which all servos are compared once
_TOGETHER: Final = 8  # servos compared by one request
_BLOCK: Final = 40  # bytes of one servo in one request, at most


class Settings:
    """The settings of the servos of one bus, by id.

    Args:
        members: members of the bus; their tables may be replaced while it runs.
        torque: the register of torque enable.
        poll: reads registers back in the rest of its time.
    """

    def __init__(self, members: Sequence[Member], torque: Field, poll: StatusPoll) -> None:
        self._poll = poll
        self._members = {member.id: member for member in members}
        self._torque = torque
        self._pending: dict[str, dict[int, tuple[Field, int]]] = {}  # writes not confirmed yet, by register name
        self._read_first = set[tuple[int, str]]()  # (id, name) of pending writes that are read before they are written
        self._changed: dict[int, dict[str, int]] = {}  # values that replace those of startup
        self._differing: dict[int, dict[str, tuple[int, int]]] = {}  # (seen, wanted) by name
        self._round: list[tuple[Block, int]] = []  # reads of one servo each, still to be made in this round
        self._part_s = _ROUND_S  # share of a round for one block of one servo
        self._due_s = 0.0

    def wanted(self, servo: int) -> Mapping[str, int]:
        """Return registers and values that should be in force now."""
        return {**self._members[servo].startup.wanted(), **self._changed.get(servo, {})}

    def changed(self, name: str) -> list[int]:
        """Return the ids of servos in which a register was changed to another value than 0."""
        return [servo for servo, values in self._changed.items() if values.get(name)]

    def forget(self, servo: int) -> None:
        """Forget changes of a servo that was started up again."""
        for requests in self._pending.values():
            requests.pop(servo, None)
        self._changed.pop(servo, None)
        self._differing.pop(servo, None)

    def clear(self) -> None:
        """Forget all changes."""
        for state in (self._pending, self._changed, self._differing, self._read_first):
            state.clear()

    # --- written until they are confirmed -----------------------------------------------------------------------

    def command(self, now_s: float) -> None:
        """Write torque off and less force, then read them back. Later polls repeat this until it is confirmed.

        Raises BusError if the port fails.
        """
        troubled = [member for member in self._members.values() if member.state != "online"]
        released = [member for member in troubled if member.to_release]
        self._pending[self._torque.name] = {member.id: (self._torque, 0) for member in released}
        for member in troubled:
            if member.state == "reduced":
                self._reduce(member)
        for name, requests in self._pending.items():
            self._write(name, requests, now_s)
        for member in released:
            member.off_written |= member.to_release

    def _write(self, name: str, requests: dict[int, tuple[Field, int]], now_s: float) -> None:
        """Write all requests of one register, and read back those of listed members."""
        # One packet has one address and one length, so models with another address get another packet.
        for field in dict.fromkeys(field for field, _ in requests.values()):
            values = {servo: value for servo, (each, value) in requests.items() if each == field}
            written = {s: field.to_bytes(v) for s, v in values.items() if (s, name) not in self._read_first}
            if written:
                self._poll.link.sync_write(field.address, written)
            ids = [servo for servo in values if self._members[servo].listed][:_VERIFIED]
            answers = self._poll.read_some("confirmed", (field.address, field.size), ids) if ids else {}
            for servo, answer in answers.items():
                if len(answer.data) == field.size:
                    self._read_first.discard((servo, name))
                    request = requests.pop(servo)
                    if (value := field.from_bytes(answer.data)) != request[1]:
                        requests[servo] = request  # to the end, so that the others have their turn
                    self._seen(self._members[servo], name, value, now_s)

    def _seen(self, member: Member, name: str, value: int, now_s: float) -> None:
        """Process the value that was read back from a written register."""
        if name == self._torque.name:
            member.take_torque(bool(value), now_s)
        elif name == BUS_WATCHDOG and value < 0:  # it has tripped
            self._pending[BUS_WATCHDOG].pop(member.id, None)
            member.distrust(now_s)

    def arm(self, servos: Iterable[int], watchdog: int) -> None:
        """Arm the watchdogs of `servos`, of those models whose watchdog stops the servo."""
        armed = self.changed(BUS_WATCHDOG)
        for servo in servos:
            if servo not in armed and self._members[servo].startup.table.watchdog == "stops":
                self._change(servo, BUS_WATCHDOG, watchdog)

    def look_for_trips(self) -> None:
        """Read all armed watchdogs: a servo whose watchdog has tripped ignores goals until it is brought back."""
        for servo in self.changed(BUS_WATCHDOG):
            self._change(servo, BUS_WATCHDOG, self._changed[servo][BUS_WATCHDOG])
            self._read_first.add((servo, BUS_WATCHDOG))

    def _reduce(self, member: Member) -> None:
        """Halve the force that startup set for a servo. Further calls change nothing."""
        fields = member.startup.table.fields
        bounded = member.servo.safety.current_limit_mA is not None and "goal_current" in fields
        field = fields["goal_current"] if bounded else torque_register(member.startup.table)
        if field is not None and field.name not in self._changed.get(member.id, ()):
            self._change(member.id, field.name, self.wanted(member.id).get(field.name, field.high) // 2)

    def _change(self, servo: int, name: str, value: int) -> None:
        """Request another value for a register than that of startup, from now on."""
        self._changed.setdefault(servo, {})[name] = value
        self._pending.setdefault(name, {})[servo] = self._members[servo].startup.table[name], value

    # --- compared once a second ---------------------------------------------------------------------------------

    def compare(self, now_s: float) -> None:
        """Read and compare a poll's share of a round. A servo that does not answer is read in the next round."""
        if now_s < self._due_s:
            return
        if not self._round:
            blocks = [(where, servo) for servo in self._members for where in self._compared_blocks(servo)]
            self._round = sorted(blocks, key=itemgetter(0))
            self._part_s = _ROUND_S / max(1, len(blocks))
        if not self._round:
            return
        where = self._round[0][0]
        servos = [servo for block, servo in self._round[:_TOGETHER] if block == where]
        asked = servos[: self._poll.fitting("settings", where[1], len(servos))]
        del self._round[: len(asked)]
        self._due_s = now_s + self._part_s * len(asked)
        there = [servo for servo in asked if _compared(self._members[servo])]
        for servo, answer in self._poll.read_some("settings", where, there).items():
            if len(answer.data) == where[1]:
                self._judge(servo, where[0], answer.data)

    def _compared_blocks(self, servo: int) -> list[Block]:
        """Return the blocks in which the registers of a servo are read. Registers close together share a block."""
        groups: list[list[Field]] = []
        fields = self._members[servo].startup.table.fields
        names = self.wanted(servo) if _compared(self._members[servo]) else ()
        for field in sorted((fields[name] for name in names if name in fields), key=lambda each: each.address):
            if groups and field.address + field.size - groups[-1][0].address <= _BLOCK:
                groups[-1].append(field)
            else:
                groups.append([field])
        return [span_of(group) for group in groups]

    def _judge(self, servo: int, start: int, data: bytes) -> None:
        """Compare the registers of a member; write one again if it was changed while the bus runs."""
        differing, member = self._differing.setdefault(servo, {}), self._members[servo]
        for name, value in self.wanted(servo).items():
            field = member.startup.table.fields.get(name)
            if field is None or not start <= field.address <= start + len(data) - field.size:
                continue
            seen = field.from_bytes(data[field.address - start :])
            if seen == value or servo in self._pending.get(name, ()):
                differing.pop(name, None)
                continue
            differing[name] = seen, value
            if name in self._changed.get(servo, ()):
                self._change(servo, name, value)
        member.take_registers(differing)


def _compared(member: Member) -> bool:
    return member.gets_goals and member.listed
