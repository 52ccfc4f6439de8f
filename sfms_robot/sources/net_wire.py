"""How messages travel: behind their length over TCP, or as a WebSocket's own. Bytes in, bytes out; opens no socket.

Both forms share one port. Who begins with "GET" speaks HTTP and wants a WebSocket: as a length that would be more than
any message has. Pages of the web may not connect: a browser tells whose page it is, and only pages that this machine
serves, or that came from the very address they call, are let in (`origin`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from websockets.exceptions import InvalidHandshake, WebSocketException
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request
from websockets.server import ServerProtocol

from sfms_robot.errors import PacketError
from sfms_robot.origin import origin_problem
from sfms_robot.sources.net_messages import LONGEST, MessageBuffer, framed

HTTP: Final = b"GET "
_REASON: Final = 120  # bytes of a closing frame's text


class TcpWire:
    """One connection on which each message goes behind its length.

    Attributes:
        over: the other side has said that it ends.
    """

    over = False

    def __init__(self) -> None:
        self._buffer = MessageBuffer()

    def push(self, data: bytes) -> Iterator[bytes | None]:
        """Yield messages that are whole now, and None for what else was to be looked at, such as a ping.

        Raises PacketError for bytes after which nothing can be read.
        """
        return self._buffer.push(data)

    def packed(self, message: bytes) -> bytes:
        """Return a message as it is sent; empty while the other side is not ready for any."""
        return framed(message)

    def closing(self, reason: str, refused: bool) -> bytes:
        """Return what is sent before the connection is closed."""
        return b""

    def answer(self) -> bytes:
        """Return what the form itself has to send: a handshake, a pong."""
        return b""


class WebSocketWire:
    """A WebSocket (RFC 6455), server's side; methods as of `TcpWire`."""

    def __init__(self) -> None:
        self._protocol = ServerProtocol(max_size=LONGEST)
        self._parts: list[Frame] = []

    def push(self, data: bytes) -> Iterator[bytes | None]:
        self._protocol.receive_data(data)
        for event in self._protocol.events_received():
            if isinstance(event, Request):
                self._shake(event)
            elif isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._parts.append(event)
                if event.fin:
                    parts, self._parts = self._parts, []
                    message = b"".join(part.data for part in parts)
                    if parts[0].opcode is Opcode.TEXT and message.decode(errors="ignore").encode() != message:
                        self._protocol.fail(CloseCode.INVALID_DATA)  # RFC 6455, 8.1
                        raise PacketError("no WebSocket: a text that is not UTF-8")
                    yield message
            yield None
        if self._protocol.handshake_exc is not None:
            raise PacketError(f"no handshake of a WebSocket: {_line(self._protocol.handshake_exc)}")
        if self._protocol.parser_exc is not None:
            raise PacketError(f"no WebSocket: {_line(self._protocol.parser_exc)}")

    def packed(self, message: bytes) -> bytes:
        try:
            if message[:1] == b"{":
                self._protocol.send_text(message)
            else:
                self._protocol.send_binary(message)
        except WebSocketException:  # the handshake is not over, or the other side closes
            return b""
        return self.answer()

    def closing(self, reason: str, refused: bool) -> bytes:
        code = CloseCode.POLICY_VIOLATION if refused else CloseCode.GOING_AWAY
        try:
            self._protocol.send_close(code, reason.encode()[:_REASON].decode(errors="ignore"))
        except WebSocketException:
            return b""
        return self.answer()

    def answer(self) -> bytes:
        return b"".join(self._protocol.data_to_send())

    @property
    def over(self) -> bool:
        return self._protocol.close_expected()

    def _shake(self, request: Request) -> None:
        problem = origin_problem(request.headers.get("Origin"), request.headers.get("Host", ""))
        if problem is None:
            self._protocol.send_response(self._protocol.accept(request))
        else:
            self._protocol.send_response(self._protocol.reject(403, problem + "\n"))
            raise PacketError(problem)


Wire = TcpWire | WebSocketWire


def _line(error: BaseException) -> str:
    """The innermost cause, on one line."""
    while error.__cause__ is not None and isinstance(error, InvalidHandshake):
        error = error.__cause__
    return " ".join(str(error).split())[:160] or type(error).__name__
