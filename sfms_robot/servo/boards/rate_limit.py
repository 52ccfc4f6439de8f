"""A port that knows when its bytes have left, and questions on it whose answers have no frame.

At 9600 baud a command is on its way for a fifth of a second while `write` has long returned. Whoever sends more before
that only fills a buffer; so the port says until when it is busy.
"""

from __future__ import annotations

from sfms_robot.config.wire_time import BITS
from sfms_robot.servo.port import Port

_CHUNK = 4096


class RateLimitedPort:
    """One open port, which this owns.

    Args:
        patience_s: how long an answer may take beyond the time of its bytes.

    Attributes:
        busy_until_s: when the last byte sent will have left.
        awaiting: a request is open.
    """

    def __init__(self, port: Port, baud: int, patience_s: float) -> None:
        self.port = port
        self.busy_until_s = port.now_s()
        self.awaiting = False
        self._byte_s = BITS / baud
        self._patience_s = patience_s
        self._answer = bytearray()
        self._length = 0
        self._until_s = 0.0

    @property
    def free(self) -> bool:
        return self.port.now_s() >= self.busy_until_s

    def send(self, data: bytes) -> float:
        """When the first of these bytes leaves. Raises BusError when the port is gone, as all here do."""
        start_s = max(self.port.now_s(), self.busy_until_s)
        self.port.write(data)
        self.busy_until_s = start_s + len(data) * self._byte_s
        return start_s

    def wait(self, until_s: float) -> None:
        """Block until then; what comes in meanwhile is dropped."""
        while self.port.now_s() < until_s and self.port.read(_CHUNK, until_s):
            pass

    def request(self, request: bytes, length: int) -> None:
        """Ask for `length` bytes, without waiting; `answer` says what came."""
        self.port.discard_input()
        self.send(request)
        self.awaiting = True
        self._answer.clear()
        self._length = length
        self._until_s = self.busy_until_s + length * self._byte_s + self._patience_s

    def answer(self, block: bool = False) -> bytes | None:
        """The answer; b"" when it did not come, or has another length; None while it may still come."""
        deadline_s = self._until_s if block else self.port.now_s()
        while len(self._answer) < self._length and (data := self.port.read(_CHUNK, deadline_s)):
            self._answer += data
        if len(self._answer) < self._length and not block and self.port.now_s() < self._until_s:
            return None
        self.awaiting = False
        return bytes(self._answer) if len(self._answer) == self._length else b""

    def exchange(self, request: bytes, length: int) -> bytes | None:
        """Request and answer in one; None when there is none. Blocks until the answer is overdue at most."""
        self.request(request, length)
        return self.answer(block=True) or None
