"""A port whose wire ends at an emulated device in this process: bytes go in, answers come out, nothing waits."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Time:
    """Virtual time: moves when told."""

    t: float = 0.0

    def now_s(self) -> float:
        return self.t

    def wait_until(self, time_s: float) -> None:
        self.t = max(self.t, time_s)


@dataclass
class DevicePort:
    """`servo.port.Port`. `waits` are the deadlines of reads that came back empty."""

    device: object
    baud: int
    clock: Time
    name: str = "emulated"
    inbox: bytearray = field(default_factory=bytearray)
    waits: list[float] = field(default_factory=list)
    sent: list[bytes] = field(default_factory=list)
    closed: bool = False

    def write(self, data: bytes) -> None:
        assert not self.closed
        self.sent.append(data)
        self.inbox += self.device.receive(data, self.baud, self.clock.t)

    def read(self, n: int, deadline_s: float) -> bytes:
        data = bytes(self.inbox[:n])
        del self.inbox[:n]
        if not data:
            self.waits.append(deadline_s)
        return data

    def discard_input(self) -> None:
        self.inbox.clear()

    def now_s(self) -> float:
        return self.clock.t

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def close(self) -> None:
        self.closed = True
