"""Outputs whose peer is a WebSocket server: one connection without a thread, and the base class of such outputs.

A peer that is slower than its output only misses frames: a frame is left out while the one before waits for the
network. The buffers are small, so that the frames that arrive are new. A peer that accepts no data, or sends none where
it should, for `SILENT_S` is lost.
"""

from __future__ import annotations

import errno
import logging
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Final

import orjson
from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from sfms_robot.endpoint import address_text
from sfms_robot.errors import OutputError, Said
from sfms_robot.outputs.registry import parse_address
from sfms_robot.ports import Facts, Output, OutputFrame

Message = Facts

CONNECT_S: Final = 1.0
SILENT_S: Final = 2.0
GOODBYE_S: Final = 0.3
_SLICE: Final = 65_536
_MOST_SLICES: Final = 16  # slices read at a time from a peer that sends too much
_SEND_BUFFER: Final = 8192  # bytes; the system doubles it
_SHARE_WINDOW: Final = 250  # frames over which a slow peer is noticed
_MOST_QUOTED: Final = 40  # characters of an answer in an error

logger = logging.getLogger(__name__)


class WebSocketPeer:
    """A connection to a WebSocket server. Nothing blocks, except for the constructor and `until`.

    Args:
        path: path of the address, beginning with "/".
        absent: advice in the error for an address where no program listens.

    Attributes:
        heard_s: time at which the last message arrived [s of `time.monotonic`].
        closed: True if the peer closed the connection or is gone; False as long as it may be there.
        sent, dropped: numbers of frames.

    Raises OutputError, as every method does that sends or receives.
    """

    def __init__(self, host: str, port: int, path: str, absent: str) -> None:
        self.heard_s = self._moved_s = time.monotonic()
        self.closed = False
        self.sent = self.dropped = 0
        self._out = bytearray()
        self._parts: list[bytes | bytearray | memoryview] = []
        self._messages: list[bytes] = []
        self._end: OutputError | None = None
        self._protocol = ClientProtocol(parse_uri(f"ws://{address_text(host, port)}{path}"))
        try:
            self._socket = socket.create_connection((host, port), CONNECT_S)
        except (OSError, UnicodeError) as error:
            raise OutputError(_unreached(error, host, absent)) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._protocol.send_request(self._protocol.connect())
        try:
            until_s = time.monotonic() + CONNECT_S
            while self._protocol.state is State.CONNECTING:
                if (left_s := until_s - time.monotonic()) <= 0:
                    raise OutputError(f"a program listens there, but does not answer within {CONNECT_S:g} s")
                self._exchange(left_s)
        except OutputError:
            self._socket.close()
            raise

    def send(self, message: Message, now_s: float, may_drop: bool = True) -> bool:
        """Send a message, or leave it out while an older one waits for the network. Return whether it was accepted."""
        self._exchange()
        if not self._out:
            self._moved_s = now_s
        elif now_s - self._moved_s > SILENT_S:
            raise OutputError(f"has accepted no data for {SILENT_S:g} s")
        if self._out and may_drop:
            self.dropped += 1
            return False
        self._protocol.send_text(orjson.dumps(message, option=orjson.OPT_SERIALIZE_NUMPY))
        self.sent += may_drop
        self._flush()
        return True

    def receive(self) -> list[Message]:
        """Return the messages that have arrived since, oldest first."""
        self._exchange()
        taken, self._messages = self._messages, []
        return [_parsed(each) for each in taken]

    def until(self, until_s: float) -> Iterator[Message]:
        """Yield the messages that arrive until `until_s` of `time.monotonic`, waiting for them."""
        while (left_s := until_s - time.monotonic()) > 0:
            if not self._messages:
                self._exchange(left_s)
            yield from self.receive()

    def close(self) -> None:
        """Send a close frame, wait `GOODBYE_S` at most for the answer, and close. Idempotent.

        The socket is read until then, because a socket closed with unread bytes discards the data that was sent last.
        """
        until_s = time.monotonic() + GOODBYE_S
        with suppress(OutputError, OSError):
            if self._protocol.state is State.OPEN:
                self._protocol.send_close()
            while self._end is None and (left_s := until_s - time.monotonic()) > 0:
                self._flush()
                self._read(left_s)
        self._socket.close()

    def _exchange(self, wait_s: float = 0.0) -> None:
        """Write waiting data and read data that has arrived, waiting up to `wait_s` for the first of it.

        After the connection has ended, raises the reason, once all messages before the end are taken.
        """
        if self._end is None:
            try:
                self._flush()
                self._read(wait_s)
            except OutputError as error:
                self._end = error
        if self._end is not None and not self._messages:
            raise self._end

    def _read(self, wait_s: float) -> None:
        with suppress(BlockingIOError, TimeoutError):
            self._socket.settimeout(wait_s)
            for _ in range(_MOST_SLICES):
                try:
                    data = self._socket.recv(_SLICE)
                except (ConnectionError, ValueError) as error:
                    raise self._gone() from error
                if not data:
                    raise self._gone()
                self._take(data)
                self._socket.settimeout(0.0)

    def _take(self, data: bytes) -> None:
        self._protocol.receive_data(data)
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._parts.append(event.data)
                if event.fin:
                    self._messages.append(b"".join(self._parts))
                    self._parts.clear()
                    self.heard_s = time.monotonic()
        if (problem := self._protocol.handshake_exc) is not None:
            answer = f"HTTP {problem.response.status_code}" if isinstance(problem, InvalidStatus) else "other bytes"
            where = f"the program that listens there has no WebSocket at {self._protocol.uri.path}"
            raise OutputError(f"{where}: it answers {answer}")
        if self._protocol.parser_exc is not None:
            raise OutputError("answers with bytes that are not of a WebSocket")
        if self._protocol.close_rcvd is not None:
            raise self._gone()

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            self._out += data
        if not self._out:
            return
        self._socket.settimeout(0.0)
        with suppress(BlockingIOError):
            try:
                del self._out[: self._socket.send(self._out)]
            except ConnectionError as error:
                raise self._gone() from error

    def _gone(self) -> OutputError:
        self.closed = True
        received = self._protocol.close_rcvd
        reason = f" ({received.reason or received.code})" if received else ""
        return OutputError(f"has closed the connection{reason}")


def _unreached(error: OSError | UnicodeError, host: str, absent: str) -> str:
    """Return why there is no connection."""
    if isinstance(error, socket.gaierror | UnicodeError):
        return f"no host of the network has the name {host}"
    if isinstance(error, TimeoutError):
        return f"does not answer within {CONNECT_S:g} s: {absent}"
    if error.errno in (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH):
        return f"{(error.strerror or 'not reached').lower()}: {absent}"
    return str(error.strerror or error)


def _parsed(data: bytes) -> Message:
    """Return the object that a message holds. Raises OutputError."""
    with suppress(orjson.JSONDecodeError):
        if isinstance(message := orjson.loads(data), dict):
            return message
    raise OutputError(f"answers with {data[:_MOST_QUOTED].decode('utf-8', 'replace')!r}, which is not a JSON object")


class WebSocketOutput(Output):
    """An output whose peer is a WebSocket server that accepts JSON objects.

    A subclass defines `kind`, the attributes below, `greet` and `message`, and `heard` if answers matter.

    Attributes:
        usual_port, path: usual port and path of the server.
        absent: advice in the error for an address where no program listens.
        answers: whether the peer sends messages all the time, so that silence is a loss.
    """

    usual_port: int
    path: str = "/"
    absent: str
    answers = True

    def __init__(self, address: str) -> None:
        self.host, self.port = parse_address(self.kind, address, self.usual_port)
        self.peer = address_text(self.host, self.port)
        self._link: WebSocketPeer | None = None
        self._dropped = 0  # frames dropped on earlier connections
        self._counts = (0, 0)  # sent and dropped frames at the last check for a slow peer
        self._noted = Said()

    @property
    def link(self) -> WebSocketPeer:
        """The connection. Raises OutputError if there is none."""
        if self._link is None:
            raise OutputError("is not connected")
        return self._link

    def open(self) -> None:
        self._link = WebSocketPeer(self.host, self.port, self.path, self.absent)
        self._counts = (0, 0)
        try:
            self.greet()
        except BaseException:
            self.close()
            raise

    def send(self, frame: OutputFrame, now_s: float) -> None:
        link = self.link
        self.heard(link.receive(), now_s)
        if self.answers and now_s - link.heard_s > SILENT_S:
            raise OutputError(f"has sent nothing for {SILENT_S:g} s")
        message = self.message(frame, now_s)
        if message is not None and link.send(message, now_s):
            self.shown(frame, now_s)
        self._note_slow()

    def statistics(self) -> Facts:
        """Return the frames that a slow peer missed."""
        link = self._link
        return {"dropped": self._dropped + (link.dropped if link else 0)}

    def close(self) -> None:
        """Send the last message if the peer is still there, and disconnect. Idempotent."""
        if (link := self._link) is None:
            return
        with suppress(OutputError, OSError):
            if not link.closed:
                self.farewell()
        self._link = None
        self._dropped += link.dropped
        link.close()

    def greet(self) -> None:
        """Lead the peer to neutral over a new connection. Raises OutputError."""
        raise NotImplementedError

    def message(self, frame: OutputFrame, now_s: float) -> Message | None:
        """Return the message of a frame; None: nothing is sent."""
        raise NotImplementedError

    def heard(self, messages: Sequence[Message], now_s: float) -> None:
        """Process the peer's messages. Raises OutputError if they end the connection."""

    def shown(self, frame: OutputFrame, now_s: float) -> None:
        """Record that a frame was sent."""

    def farewell(self) -> None:
        """Send the last message of a connection."""

    def say(self, message: Message) -> None:
        """Send a message that is not left out when the network is slow."""
        self.link.send(message, time.monotonic(), may_drop=False)

    def note_once(self, text: str) -> None:
        """Log a warning of this output, the first time."""
        if self._noted.first(text):
            logger.warning("output %s:%s: %s", self.kind, self.peer, text)

    def _note_slow(self) -> None:
        """Report once that the peer takes fewer than three of four frames."""
        link = self.link
        sent, dropped = link.sent - self._counts[0], link.dropped - self._counts[1]
        if sent + dropped < _SHARE_WINDOW:
            return
        self._counts = link.sent, link.dropped
        if dropped > sent / 3:
            self.note_once(
                f"is slower than {self.rate_hz:g} frames a second; frames that it has no time for are left out"
            )
