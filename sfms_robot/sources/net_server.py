"""Server for programs that work with a run: accepts connections, passes on messages, and sends.

Over TCP a message follows its length (uint32); a WebSocket carries one in each of its messages. Both share a port. A
connection that begins with "GET " is HTTP and requests a WebSocket: read as a length, these bytes are more than any
message has. Pages of the web may not connect: a browser sends the page's origin, and only pages of this machine, or
from the very address that they call, are admitted (`endpoint.origin_problem`).

A client cannot delay a tick of the servo loop:

1. The server runs in one thread. The loop passes messages to send through a bounded queue.
2. A connection is read in small turns with pauses between them: TCP itself holds up a client that sends faster.
3. A slow reader receives the newest `OUTBOX` messages; older ones are left out and counted.
   Faults of a program's own messages are sent to it, as messages of type "error", before they are counted.
4. A client that sends no hello, or has gone without closing, is disconnected.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
import sys
from collections import deque
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing, suppress
from typing import Any, Final

from websockets.exceptions import InvalidHandshake, WebSocketException
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request
from websockets.server import ServerProtocol

from sfms_robot.endpoint import ServerThread, address_text, origin_problem
from sfms_robot.errors import PacketError, Said
from sfms_robot.sources.net_messages import LONGEST, Message, SenderClock, json_message, parse_message

logger = logging.getLogger(__name__)

MOST_CONNECTIONS: Final = 8
HELLO_S: Final = 5.0  # until the first message
OUTBOX: Final = 50  # messages: two seconds of microphone
TURN_MESSAGES: Final = 16  # read from one connection before a pause, in which the others are read
TURN_BYTES: Final = 65_536
TURN_S: Final = 0.01
MOST_MALFORMED: Final = 100  # malformed messages; one more closes the connection
LAST_WORDS_S: Final = 0.2  # time for a program to read why its connection closes
_SLICE: Final = TURN_BYTES // TURN_MESSAGES  # bytes read at once from a WebSocket
_MOST_READ: Final = 4 * LONGEST  # bytes of a WebSocket's message; a longer one closes the connection
_STOP_S: Final = 2.0
_HTTP: Final = b"GET "
_LENGTH: Final = struct.Struct("<I")
_REASON: Final = 120  # bytes of a closing frame's text


class NetServer(ServerThread):
    """A server that holds one address from construction until `close`; clients wait until `start`. Raises PortError.

    A subclass defines the meaning of messages.

    Args:
        flag: the option that names the address, for errors.
        port: TCP port; 0: any free one.

    Attributes:
        counts: connections, refusals, messages, malformed messages, and messages that slow readers missed.
        connections: the open connections; for the server's thread.
    """

    def __init__(self, flag: str, host: str, port: int) -> None:
        self.counts = dict.fromkeys(("connections", "refused", "messages", "malformed", "missed"), 0)
        self.connections = set[NetProgram]()
        self._said = Said()
        super().__init__(flag, host, port, _STOP_S)
        self._posted = deque[Callable[[], None]](maxlen=4 * OUTBOX)

    def received(self, connection: NetProgram, message: Message) -> None:
        """Process a message, in the server's thread.

        Raises PacketError for a message that this connection may not send; the connection is closed with that line.
        """
        raise NotImplementedError

    def gone(self, connection: NetProgram) -> None:
        """Note, in the server's thread, that a connection is closed or is about to be. Idempotent."""
        raise NotImplementedError

    def post(self, work: Callable[[], None]) -> None:
        """Call `work` in the server's thread, soon. Too many waiting calls drop the oldest. Never blocks."""
        self._posted.append(work)
        if len(self._posted) == 1:  # measured after it was added: `_work` may just have emptied the queue
            with suppress(RuntimeError):  # closed
                self._loop.call_soon_threadsafe(self._work)

    def say_once(self, key: str, text: str) -> None:
        """Log `text` the first time that `key` occurs, ignoring the numbers in it."""
        if self._said.first(key):
            logger.warning("%s (said once)", text)

    def _work(self) -> None:
        while self._posted:
            self._posted.popleft()()

    async def _serve(self) -> None:
        server = await asyncio.start_server(lambda *ends: NetProgram(self, *ends).run(), sock=self._socket)
        await self._closing.wait()
        server.close()
        open_still = list(self.connections)
        for connection in open_still:
            connection.end("the robot stops", refused=False)
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        if tasks:
            await asyncio.wait(tasks, timeout=LAST_WORDS_S)
        for connection in open_still:
            connection.abort()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


class NetProgram:
    """A connected program, over TCP or a WebSocket.

    Attributes:
        name: its name from the hello, and its address.
        greeted: True once its hello was accepted.
        malformed: number of its messages that could not be read.
        clock: conversion of its time stamps to our clock.
        wants: kinds of messages that it requested.
    """

    def __init__(self, server: NetServer, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.name = address_text(*writer.get_extra_info("peername", ("an unknown address", 0))[:2])
        self.greeted, self.malformed, self.clock = False, 0, SenderClock()
        self._told = Said()
        self.wants = frozenset[str]()
        self._server, self._reader, self._writer = server, reader, writer
        self._loop = asyncio.get_running_loop()
        self._wire: TcpWire | WebSocketWire | None = None
        self._over = False
        self._outbox = deque[bytes](maxlen=OUTBOX)
        self._waiting = asyncio.Event()  # something to send

    async def run(self) -> None:
        """Serve the program until either side closes."""
        server = self._server
        server.counts["connections"] += 1
        if len(server.connections) >= MOST_CONNECTIONS:
            server.counts["refused"] += 1
            server.say_once("full", f"{self.name}: refused, {MOST_CONNECTIONS} programs are connected already")
            self.abort()
            return
        server.connections.add(self)
        _find_the_dead(self._writer.get_extra_info("socket"))
        self._writer.transport.set_write_buffer_limits(high=65_536)
        deadline = self._loop.call_later(HELLO_S, self._silent)
        sending = self._loop.create_task(self._send())
        try:
            await self._receive()
        except (OSError, asyncio.IncompleteReadError):
            pass  # the program has disconnected
        except PacketError as error:
            self._fault("malformed", "closed", str(error))
        finally:
            deadline.cancel()
            sending.cancel()
            server.connections.discard(self)
            server.gone(self)  # a second call if `end` was called before
            self._writer.close()

    def send(self, message: bytes) -> None:
        """Queue a message until the client reads; only the newest are kept. Called in the server's thread."""
        self._server.counts["missed"] += len(self._outbox) == self._outbox.maxlen
        self._outbox.append(message)
        self._waiting.set()

    def tell(self, problem: str) -> None:
        """Send a fault of the program's messages, as a message of type "error"; it stays connected."""
        self.send(json_message(type="error", error=problem))

    def tell_once(self, problem: str) -> None:
        """Send and log a problem the first time that it occurs, ignoring the numbers in it."""
        if self._told.first(problem):
            self.tell(problem)
            self._server.say_once(problem, f"{self.name}: {problem}")

    def end(self, reason: str, refused: bool = True) -> None:
        """Send the reason, as a message of type "error", and close. `refused`: the client caused it."""
        if self._over:
            return
        self._over = True
        self._server.gone(self)
        if self._wire is not None:
            for message in (*self._outbox, json_message(type="error", error=reason)):
                self._writer.write(self._wire.packed(message))
            self._writer.write(self._wire.closing(reason, refused))
        self._writer.close()
        self._loop.call_later(HELLO_S, self.abort)  # a client that does not read cannot keep it open

    def abort(self) -> None:
        """Close without a message."""
        self._over = True
        self._writer.transport.abort()

    async def _send(self) -> None:
        with suppress(OSError):
            while True:
                await self._waiting.wait()
                assert self._wire is not None  # nothing is sent before the hello
                while self._outbox:
                    self._writer.write(self._wire.packed(self._outbox.popleft()))
                    await self._writer.drain()
                self._waiting.clear()

    async def _receive(self) -> None:
        head = await self._reader.readexactly(len(_HTTP))
        self._wire = wire = WebSocketWire(self._writer) if head == _HTTP else TcpWire()
        looked = size = 0
        async with aclosing(wire.messages(self._reader, head)) as messages:
            async for data in messages:
                if self._over:
                    return
                looked, size = looked + 1, size + len(data or b"")
                if data is not None:
                    self._take(data)
                if looked >= TURN_MESSAGES or size >= TURN_BYTES:
                    looked = size = 0
                    await asyncio.sleep(TURN_S * len(self._server.connections))

    def _take(self, data: bytes) -> None:
        self._server.counts["messages"] += 1
        try:
            message = parse_message(data)
        except PacketError as error:
            self.malformed += 1
            ends = not self.greeted or self.malformed > MOST_MALFORMED
            self._fault("malformed", "left out", str(error), ends)
            return
        try:
            self._server.received(self, message)
        except PacketError as error:
            self._fault("refused", "refused", str(error))

    def _silent(self) -> None:
        if not self.greeted:
            self._fault("refused", "closed", f"no hello within {HELLO_S:g} s")

    def _fault(self, count: str, done: str, reason: str, ends: bool = True) -> None:
        """Send a fault to the program, count and log it, and close the connection if `ends`."""
        if not ends:
            self.tell(reason)
        self._server.counts[count] += 1
        self._server.say_once(f"{done} {reason}", f"{self.name}: {done}: {reason}")
        if ends:
            self.end(reason)


class TcpWire:
    """TCP framing: each message follows its length."""

    async def messages(self, reader: asyncio.StreamReader, head: bytes) -> AsyncGenerator[bytes | None, None]:
        """Yield messages, and None for other work that took time. `head`: the first four bytes.

        Raises PacketError for bytes after which the stream cannot be read.
        """
        while True:
            (length,) = _LENGTH.unpack(head)
            if not 0 < length <= LONGEST:
                raise PacketError(f"a message of {length} bytes (1 to {LONGEST}, behind its length in 4 bytes)")
            yield await reader.readexactly(length)
            head = await reader.readexactly(_LENGTH.size)

    def packed(self, message: bytes) -> bytes:
        """Return the bytes to send for a message; empty if the other side is not ready for messages."""
        return _LENGTH.pack(len(message)) + message

    def closing(self, reason: str, refused: bool) -> bytes:
        """Return the bytes to send before the connection is closed."""
        return b""


class WebSocketWire:
    """The server's side of a WebSocket (RFC 6455); methods as in `TcpWire`."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._protocol = ServerProtocol(max_size=_MOST_READ)
        self._writer = writer

    async def messages(self, reader: asyncio.StreamReader, head: bytes) -> AsyncGenerator[bytes | None, None]:
        protocol, data, parts = self._protocol, head, list[Frame]()
        while data:
            protocol.receive_data(data)
            problem, events = None, protocol.events_received()
            for event in events:
                if isinstance(event, Request):
                    problem = self._shake(event)
                elif isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                    parts.append(event)
                    if event.fin:
                        message, text = b"".join(part.data for part in parts), parts[0].opcode is Opcode.TEXT
                        parts.clear()
                        if text and message.decode(errors="ignore").encode() != message:
                            protocol.fail(CloseCode.INVALID_DATA)  # RFC 6455, 8.1
                            problem = "no WebSocket: a text that is not UTF-8"
                            break
                        yield message
                yield None
            if not events:
                yield None
            if failed := protocol.handshake_exc or protocol.parser_exc:
                problem = problem or f"no WebSocket: {_line(failed)}"
            if problem is not None:
                raise PacketError(problem)
            self._writer.write(self._answer())
            if protocol.close_expected():
                return
            data = await reader.read(_SLICE)

    def packed(self, message: bytes) -> bytes:
        try:
            (self._protocol.send_text if message[:1] == b"{" else self._protocol.send_binary)(message)
        except WebSocketException:  # the handshake is not complete, or the other side is closing
            return b""
        return self._answer()

    def closing(self, reason: str, refused: bool) -> bytes:
        code = CloseCode.POLICY_VIOLATION if refused else CloseCode.GOING_AWAY
        with suppress(WebSocketException):  # it is closing already
            self._protocol.send_close(code, reason.encode()[:_REASON].decode(errors="ignore"))
        return self._answer()

    def _answer(self) -> bytes:
        """Return the bytes that the protocol has to send, such as a handshake or a pong."""
        return b"".join(self._protocol.data_to_send())

    def _shake(self, request: Request) -> str | None:
        """Answer a request for a WebSocket; return the reason if it is refused, else None."""
        problem = origin_problem(request.headers.get("Origin"), request.headers.get("Host", ""))
        answer = self._protocol.accept(request) if problem is None else self._protocol.reject(403, f"{problem}\n")
        self._protocol.send_response(answer)
        return problem


def _line(error: BaseException) -> str:
    """Return the text of the innermost cause, on one line."""
    while error.__cause__ is not None and isinstance(error, InvalidHandshake):
        error = error.__cause__
    return " ".join(str(error).split())[:160] or type(error).__name__


def _find_the_dead(of: Any) -> None:
    """Let the system detect within 11 s that a peer has gone without closing, if it can (Linux)."""
    of.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    of.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if sys.platform == "linux":
        for option, value in ((socket.TCP_KEEPIDLE, 5), (socket.TCP_KEEPINTVL, 2), (socket.TCP_KEEPCNT, 3)):
            of.setsockopt(socket.IPPROTO_TCP, option, value)
        of.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 11_000)
