"""A port on which silence costs time and any request or answer can be lost; its wire ends at an emulated device."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from sfms_robot.emulator.dynamixel2_chain import Dynamixel2Chain
from sfms_robot.emulator.protocol1_chain import Protocol1Chain
from sfms_robot.servo.chain.dynamixel2_link import Dynamixel2Link
from sfms_robot.servo.chain.link import RegisterLink
from sfms_robot.servo.chain.protocol1_link import Protocol1Link
from sfms_robot.servo.registers import Table

BAUD = 1_000_000
SILENCE_S = 0.003


@dataclass
class LossyPort:
    """`servo.port.Port`. `fate` says of each packet what happens to it: "" arrives and is answered, "request" is
    lost on the way there, "answer" on the way back; when it is used up everything arrives.
    """

    device: object
    fate: Iterator[str] = iter(())
    t: float = 0.0
    name: str = "lossy"
    baud: int = BAUD
    packets: int = 0
    inbox: bytearray = field(default_factory=bytearray)

    def write(self, data: bytes) -> None:
        self.packets += 1
        self.t += len(data) * 10 / self.baud
        fate = next(self.fate, "")
        if fate == "request":
            return
        answer = self.device.receive(data, self.baud, self.t)
        if fate != "answer":
            self.inbox += answer

    def read(self, n: int, deadline_s: float) -> bytes:
        data = bytes(self.inbox[:n])
        del self.inbox[:n]
        self.t = self.t + len(data) * 10 / self.baud if data else max(self.t, deadline_s)
        return data

    def discard_input(self) -> None:
        self.inbox.clear()

    def now_s(self) -> float:
        return self.t

    def wait_until(self, time_s: float) -> None:
        self.t = max(self.t, time_s)

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def close(self) -> None:
        self.inbox.clear()


def device_of(table: Table, *rows: dict[str, object]) -> Dynamixel2Chain | Protocol1Chain:
    """Emulated servos of one model in this process; a row may name id, start_ticks, firmware and registers."""
    usual = {"model": table.model, "baud": BAUD, "start_ticks": table.center_ticks, "firmware": table.firmware[0] or 1}
    filled = [{**usual, "registers": {}, "supply_v": None, "id": i + 1, **row} for i, row in enumerate(rows or ({},))]
    kind = Dynamixel2Chain if table.protocol == 2 else Protocol1Chain
    return kind.from_rows(filled, {table.model: table})


def link_on(port: LossyPort, table: Table) -> RegisterLink:
    if table.protocol == 2:
        return Dynamixel2Link(port, port.baud, SILENCE_S)
    return Protocol1Link(port, port.baud, SILENCE_S, table.family)
