"""The register file of an emulated servo: bytes at addresses, fields by name, and the indirect block.

An indirect data register is a window: byte k of the block shows the byte whose address stands in `indirect_address_k`.
Where the block lies is the firmware map's business (X330 servos up to firmware 52 have it elsewhere than later ones).
"""

from __future__ import annotations

from collections.abc import Iterator

from sfms_robot.servo.registers import Field, Table


class RegisterFile:
    """Values by register name; raw bytes by address. Reading an absent register gives its default.

    `size`: bytes that can be read; default: the whole table and no more.
    """

    def __init__(self, table: Table, size: int | None = None) -> None:
        self.table = table
        self.raw = bytearray(table.size if size is None else size)
        self._covers: dict[tuple[int, int], tuple[Field, ...]] = {}
        fields = table.fields
        self._windows = {  # address of an indirect data byte -> address of the word that says what it shows
            field.address: fields[f"indirect_address_{name.removeprefix('indirect_data_')}"].address
            for name, field in fields.items()
            if name.startswith("indirect_data_") and f"indirect_address_{name.removeprefix('indirect_data_')}" in fields
        }
        self._first_window = min(self._windows, default=table.size)
        self._last_window = max(self._windows, default=-1)

    def get(self, name: str, default: int = 0) -> int:
        field = self.table.fields.get(name)
        return default if field is None else field.from_bytes(self.raw[field.address : field.address + field.size])

    def put(self, name: str, value: int) -> None:
        """At most what the register can show; does nothing where the model has no such register."""
        field = self.table.fields.get(name)
        if field is not None:
            self.raw[field.address : field.address + field.size] = field.to_bytes(_shown(field, value))

    def covered(self, address: int, length: int) -> tuple[Field, ...]:
        """The registers that lie, wholly or in part, in a block."""
        found = self._covers.get((address, length))
        if found is None:
            end = address + length
            found = tuple(f for f in self.table.fields.values() if f.address < end and f.address + f.size > address)
            if len(self._covers) < 1024:  # rubbish from a host must not fill the memory
                self._covers[address, length] = found
        return found

    def has_windows(self, address: int, length: int) -> bool:
        return address <= self._last_window and address + length > self._first_window

    def seen_through(self, address: int, length: int) -> Iterator[int]:
        """The addresses that the bytes of a block really are."""
        for at in range(address, address + length):
            word = self._windows.get(at)
            if word is None:
                yield at
                continue
            target = self.raw[word] | self.raw[word + 1] << 8
            yield target if target < len(self.raw) and target not in self._windows else at


def _shown(field: Field, value: int) -> int:
    """The nearest value that fits the register's size and sign rule."""
    if field.sign == "twos_complement":
        half = 1 << 8 * field.size - 1
        return min(max(value, -half), half - 1)
    if field.sign == "offset_2048":
        return min(max(value, -2048), 2047)
    bits = int(field.sign.removeprefix("sign_bit_")) if field.signed else 8 * field.size
    most = (1 << bits) - 1
    return min(max(value, -most if field.signed else 0), most)
