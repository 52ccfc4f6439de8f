"""Registers that are written in every poll until the servo says that it holds the value: torque off, the watchdog.

The value goes first, unasked for and to all servos in one packet: whatever becomes of the answers, it has been said.
Only then is it read back, as far as the poll has time; what nobody has confirmed is written again in the next poll.
Values are absolute, so that writing one twice does no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from sfms_robot.servo.chain.link import Answer, RegisterLink
from sfms_robot.servo.registers import Field

_VERIFIED: Final = 8  # servos that are read back in one poll

ReadSome = Callable[[tuple[int, int], Sequence[int]], Mapping[int, Answer]]
Seen = Callable[[int, Field, int], None]
Requests = dict[int, tuple[Field, int]]


class RepeatedWrites:
    """What is not confirmed yet: by register name, then by index in bus order, (register, value)."""

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
        """`read_first`: for a register whose value says what happened, which a write would hide."""
        self._pending.setdefault(field.name, {})[index] = field, value
        if read_first:
            self._read_first.add((index, field.name))

    def drop(self, index: int, name: str | None = None) -> None:
        """No longer: of one register, or of all."""
        for each in [name] if name is not None else list(self._pending):
            self._pending.get(each, {}).pop(index, None)

    def drop_all(self, name: str) -> None:
        """No longer: of nobody."""
        self._pending.pop(name, None)

    def clear(self) -> None:
        self._pending.clear()
        self._read_first.clear()

    def step(self, link: RegisterLink, asked: Callable[[int], bool], read: ReadSome, seen: Seen) -> None:
        """A poll's share: all are written, those that `asked` allows are read back.

        Args:
            read: (address, length), ids -> answers of those that answered; nothing when there is no time for it.
            seen: index, register and value of every servo that told it.

        Raises BusError when the port fails.
        """
        for name, requests in list(self._pending.items()):
            if not requests:
                del self._pending[name]
                continue
            for field, values in _alike(requests):
                told = {self._ids[i]: field.to_bytes(v) for i, v in values.items() if (i, name) not in self._read_first}
                if told:
                    link.sync_write(field.address, told)
                ids = [self._ids[i] for i in values if asked(i)][:_VERIFIED]
                for servo, answer in (read((field.address, field.size), ids) if ids else {}).items():
                    index = self._index[servo]
                    if len(answer.data) == field.size:
                        value = field.from_bytes(answer.data)
                        self._read_first.discard((index, name))
                        if value == values[index]:
                            requests.pop(index, None)
                        else:  # to the back: others have their turn
                            requests[index] = requests.pop(index)
                        seen(index, field, value)


def _alike(requests: Requests) -> list[tuple[Field, dict[int, int]]]:
    """One packet has one address and one length: models that keep a register elsewhere get a packet of their own."""
    packets: dict[tuple[int, int], tuple[Field, dict[int, int]]] = {}
    for index, (field, value) in requests.items():
        packets.setdefault((field.address, field.size), (field, {}))[1][index] = value
    return list(packets.values())
