"""The side of the network: a thread that takes connections, hands messages to who asked for them, and sends.

What a stranger can do costs the servo loop no tick:

1. All of it happens in one thread of its own. The loop hands over what is to be sent through a bounded queue.
2. A connection is read in small turns with pauses between them: who sends faster is held up by TCP itself.
3. Who reads too slowly gets the newest `OUTBOX` messages; older ones are left out and counted.
4. Who says nothing after connecting, and who has gone without saying so, is closed.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import re
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Protocol

from sfms_robot.errors import PacketError, PortError
from sfms_robot.sources.net_messages import Message, json_message, parse_message
from sfms_robot.sources.net_wire import HTTP, TcpWire, WebSocketWire, Wire

logger = logging.getLogger(__name__)

MOST_CONNECTIONS: Final = 8
HELLO_S: Final = 5.0  # until the first message
OUTBOX: Final = 50  # messages: two seconds of microphone
TURN_MESSAGES: Final = 16  # of one connection, then the others, and a pause
TURN_BYTES: Final = 65_536
TURN_S: Final = 0.01
MOST_MALFORMED: Final = 100  # then the connection is closed
_SLICE: Final = 1024  # bytes that are looked at at once
LAST_WORDS_S: Final = 0.2  # that a program gets to read why it is closed
_STOP_S: Final = 2.0
_MOST_SAID: Final = 20


class Handler(Protocol):
    """Who decides what messages mean. Called in the server's thread."""

    def received(self, connection: Connection, message: Message) -> None:
        """Raises PacketError for what this connection may not send: it is closed with that line."""

    def gone(self, connection: Connection) -> None: ...


class NetServer:
    """Holds one address from construction until `close`; whoever connects waits until `start`.

    Raises PortError when the address cannot be had.

    Attributes:
        address: host and port that are bound.
        counts: connections, refused ones, messages, malformed ones, and messages that slow readers missed.
    """

    def __init__(self, flag: str, host: str, port: int, handler: Handler) -> None:
        """`flag`: what the command line calls it, for the error's text. Port 0: any that is free."""
        self.counts = dict.fromkeys(("connections", "refused", "messages", "malformed", "missed"), 0)
        self._handler = handler
        self._said: set[str] = set()
        self._connections: set[Connection] = set()
        self._socket = _bound(flag, host, port)
        self.address: tuple[str, int] = self._socket.getsockname()[:2]
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._posted: deque[Callable[[], None]] = deque(maxlen=4 * OUTBOX)
        self._thread = threading.Thread(target=self._run, name="net", daemon=True)

    def start(self) -> None:
        """Take connections from now on. Idempotent."""
        if self._thread.ident is None:
            self._thread.start()

    def post(self, work: Callable[[], None]) -> None:
        """Have `work` called in the server's thread; the oldest is dropped when too much waits. Never blocks."""
        idle = not self._posted
        self._posted.append(work)
        if idle:
            with suppress(RuntimeError):  # closed
                self._loop.call_soon_threadsafe(self._work)

    def connections(self) -> list[Connection]:
        """Those that are open. In the server's thread."""
        return list(self._connections)

    def say_once(self, key: str, text: str) -> None:
        """One line in the log for `key`, whatever its numbers, the first time."""
        key = re.sub(r"\d+", "", key)
        if key not in self._said and len(self._said) < _MOST_SAID:
            self._said.add(key)
            logger.warning("%s (said once)", text)

    def close(self) -> None:
        """Close every connection and give the port back. Blocks until then. Idempotent."""
        if self._thread.ident is None:
            self._loop.close()
            self._socket.close()
        elif self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join(_STOP_S)

    def opened(self, connection: Connection) -> bool:
        """Whether it may stay."""
        self.counts["connections"] += 1
        if len(self._connections) >= MOST_CONNECTIONS:
            self.counts["refused"] += 1
            self.say_once("full", f"{connection.name}: refused, {MOST_CONNECTIONS} programs are connected already")
            return False
        self._connections.add(connection)
        return True

    def closed(self, connection: Connection) -> None:
        self._connections.discard(connection)
        self._handler.gone(connection)

    def message(self, connection: Connection, data: bytes) -> None:
        """One message of a connection, whatever it is."""
        self.counts["messages"] += 1
        try:
            message = parse_message(data)
        except PacketError as error:
            self.counts["malformed"] += 1
            connection.malformed += 1
            self.say_once(f"malformed {error}", f"{connection.name}: left out: {error}")
            if not connection.greeted or connection.malformed > MOST_MALFORMED:
                connection.end(str(error))
            return
        try:
            self._handler.received(connection, message)
        except PacketError as error:
            self.counts["refused"] += 1
            self.say_once(f"refused {error}", f"{connection.name}: refused: {error}")
            connection.end(str(error))

    def pause_s(self) -> float:
        """Between two turns of one connection."""
        return TURN_S * max(1, len(self._connections))

    def _work(self) -> None:
        while self._posted:
            self._posted.popleft()()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()
            self._socket.close()

    async def _serve(self) -> None:
        server = await self._loop.create_server(lambda: Connection(self, self._loop), sock=self._socket)
        await self._closing.wait()
        server.close()
        open_still = self.connections()
        for connection in open_still:
            connection.end("the robot stops", refused=False)
        if open_still:
            await asyncio.wait([connection.lost for connection in open_still], timeout=LAST_WORDS_S)
        for connection in open_still:
            connection.abort()
        await asyncio.sleep(0)


class Connection(asyncio.Protocol):
    """One program that is connected, over TCP or a WebSocket.

    Attributes:
        name: who it is, for people: what it calls itself, and its address.
        greeted: its hello was accepted.
        malformed: messages of it that could not be read.
        wants: what it is sent.
        lost: done when it is closed.
    """

    def __init__(self, server: NetServer, loop: asyncio.AbstractEventLoop) -> None:
        self.name = "somebody"
        self.greeted = False
        self.malformed = 0
        self.wants: frozenset[str] = frozenset()
        self.lost = loop.create_future()
        self._server = server
        self._loop = loop
        self._transport: asyncio.Transport | None = None  # None: closed, or about to be
        self._socket_transport: asyncio.Transport | None = None
        self._wire: Wire | None = None
        self._unread = bytearray()
        self._turning = False
        self._full = False
        self._outbox: deque[bytes] = deque(maxlen=OUTBOX)
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        peer = transport.get_extra_info("peername")
        self.name = f"{peer[0]}:{peer[1]}"
        self._transport = self._socket_transport = transport
        _tell_of_the_dead(transport.get_extra_info("socket"))
        transport.set_write_buffer_limits(high=65_536)
        if not self._server.opened(self):
            self.abort()
            return
        self._deadline = self._loop.call_later(HELLO_S, self._silent)

    def data_received(self, data: bytes) -> None:
        self._unread += data
        if self._wire is None:
            if len(self._unread) < len(HTTP):
                return
            self._wire = WebSocketWire() if self._unread.startswith(HTTP) else TcpWire()
        if not self._turning:
            self._turn()

    def connection_lost(self, error: Exception | None) -> None:
        self._transport = None
        if self._deadline is not None:
            self._deadline.cancel()
        self._server.closed(self)
        if not self.lost.done():
            self.lost.set_result(None)

    def pause_writing(self) -> None:
        self._full = True

    def resume_writing(self) -> None:
        self._full = False
        while self._outbox and not self._full:
            self._write(self._outbox.popleft())

    def send(self, message: bytes) -> None:
        """Now, or when it reads again: then the newest. In the server's thread."""
        if not self._full:
            self._write(message)
            return
        self._server.counts["missed"] += len(self._outbox) == self._outbox.maxlen
        self._outbox.append(message)

    def end(self, reason: str, refused: bool = True) -> None:
        """Tell why, as a message of type "error", and close. `refused`: it was the program's own doing."""
        transport = self._transport
        if transport is None:
            return
        if self._wire is not None:
            self._write(json_message(type="error", error=reason))
            transport.write(self._wire.closing(reason, refused))
        self._transport = None
        transport.close()
        self._loop.call_later(HELLO_S, transport.abort)  # who does not read does not keep it open

    def abort(self) -> None:
        """Close without a word."""
        self._transport = None
        if self._socket_transport is not None:
            self._socket_transport.abort()

    def _write(self, message: bytes) -> None:
        if self._transport is not None and self._wire is not None:
            self._transport.write(self._wire.packed(message))

    def _turn(self) -> None:
        """Look at some of what came in; at the rest after a pause, in which nothing is read."""
        self._turning, messages, looked = False, 0, 0
        while self._unread and self._transport is not None:
            if messages >= TURN_MESSAGES or looked >= TURN_BYTES:
                self._turning = True
                self._transport.pause_reading()
                self._loop.call_later(self._server.pause_s(), self._next_turn)
                return
            piece = bytes(self._unread[:_SLICE])
            del self._unread[:_SLICE]
            looked += len(piece)
            messages += self._look(piece)

    def _next_turn(self) -> None:
        if self._transport is not None:
            self._transport.resume_reading()
            self._turn()

    def _look(self, piece: bytes) -> int:
        """How many messages it completed, and what else was to be looked at."""
        wire, count = self._wire, 0
        assert wire is not None
        try:
            for data in wire.push(piece):
                count += 1
                if data is not None and self._transport is not None:
                    self._server.message(self, data)
        except PacketError as error:
            self._server.counts["malformed"] += 1
            self._server.say_once(f"wire {error}", f"{self.name}: closed: {error}")
            self._answer(wire)
            self.end(str(error))
            return count
        self._answer(wire)
        if wire.over and self._transport is not None:
            self._transport.close()
        if self.greeted and self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
        return count

    def _answer(self, wire: Wire) -> None:
        if self._transport is not None and (answer := wire.answer()):
            self._transport.write(answer)

    def _silent(self) -> None:
        self._server.counts["refused"] += 1
        self._server.say_once("silent", f"{self.name}: closed: no hello within {HELLO_S:g} s")
        self.end(f"no hello within {HELLO_S:g} s")


def _bound(flag: str, host: str, port: int) -> socket.socket:
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except (OSError, UnicodeError) as error:
        used = getattr(error, "errno", None) == errno.EADDRINUSE
        problem = "is used by another program" if used else getattr(error, "strerror", None) or error
        raise PortError(f"{flag}: TCP port {port} on {host}: {problem}") from error


def _tell_of_the_dead(of: socket.socket) -> None:
    """A peer that has gone without a word is found out: within 11 s, where the system can."""
    of.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    of.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if sys.platform == "linux":
        for option, value in ((socket.TCP_KEEPIDLE, 5), (socket.TCP_KEEPINTVL, 2), (socket.TCP_KEEPCNT, 3)):
            of.setsockopt(socket.IPPROTO_TCP, option, value)
        of.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 11_000)
