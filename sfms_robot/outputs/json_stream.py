"""Face and pose as JSON to WebSocket clients of this machine: `--output json[:PORT]`.

One object a frame, 50 a second:

    t             loop time [s]
    state         of the run
    pose          roll, pitch, yaw [rad], x, y, z [m], axes as in `frames`
    shapes        the 52 ARKit blendshapes by name, 0..1
    events        begun since the last frame: kind, start_s, duration_s, size, swings, probability
    yaw, pitch    of the pose, in degrees
    ts            loop time [ms], a whole number
    source, frame "sfms-robot", "base"

ts, source and frame are there for stackchan-mcp's pose follower, which reads them together with yaw and pitch.

The limits are those of the page. Requests with a name of another machine (Host), or of a page of another site (Origin),
are refused. A connection that is not open after `CONNECTION_S` is closed, and if there are `MOST_CLIENTS` of these, the
oldest makes room. A client that reads slowly misses frames. A client that sends more than `MOST_RECEIVED` messages,
which are not used, is disconnected.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from http import HTTPStatus
from typing import Final

import orjson
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from sfms_robot.endpoint import LOOPBACK, ServerThread, address_text, host_problem, origin_problem, port_number
from sfms_robot.errors import NOTE, ConfigError
from sfms_robot.frames import BLENDSHAPES, POSE, POSE_CHANNELS, SHAPES
from sfms_robot.ports import Facts, Output, OutputFrame

PORT: Final = 8782
MOST_CLIENTS: Final = 32
CONNECTION_S: Final = 10.0
MOST_RECEIVED: Final = 100
MOST_UNREAD: Final = 65_536  # bytes that wait for a client; with more it misses frames
_RECEIVED_S: Final = 0.01  # pause after each message of a client
_LONGEST: Final = 4096  # bytes of a client's message
_STOP_S: Final = 1.0
_SOURCE: Final = "sfms-robot"
_DEGREES: Final = 57.29577951308232

logger = logging.getLogger(__name__)
_handshakes = logging.getLogger(f"{__name__}.handshakes")  # failed handshakes are not a problem of the run
_handshakes.setLevel(logging.CRITICAL)


def json_of(frame: OutputFrame) -> bytes:
    """Return the object of a frame."""
    pose = dict(zip(POSE_CHANNELS, (round(value, 5) for value in frame.motion[POSE].tolist()), strict=True))
    shapes = dict(zip(BLENDSHAPES, (round(value, 4) for value in frame.motion[SHAPES].tolist()), strict=True))
    events = [
        {
            "kind": each.kind,
            "start_s": each.start_s,
            "duration_s": each.duration_s,
            "size": each.size,
            "swings": each.swings,
            "probability": each.probability,
        }
        for each in frame.events
    ]
    return orjson.dumps(
        {
            "t": round(frame.time_s, 4),
            "state": frame.state,
            "pose": pose,
            "shapes": shapes,
            "events": events,
            "yaw": round(pose["yaw"] * _DEGREES, 3),
            "pitch": round(pose["pitch"] * _DEGREES, 3),
            "ts": round(frame.time_s * 1e3),
            "source": _SOURCE,
            "frame": "base",
        }
    )


class JsonStream(ServerThread, Output):
    """Server of JSON frames. Holds its port from construction on. Raises ConfigError, PortError."""

    kind = "json"

    def __init__(self, argument: str = "") -> None:
        port = port_number(argument.removeprefix(":")) if argument else PORT
        if port is None:
            raise ConfigError(
                f"--output json:{argument}: expected a TCP port of this machine from 0 to 65535 (0: any free one), "
                f"got {argument!r}"
            )
        super().__init__("--output json", LOOPBACK, port, 2 * _STOP_S)
        self.peer = address_text(*self.address)
        self._counts = dict.fromkeys(("refused", "missed"), 0)
        self._clients = set[ServerConnection]()  # open connections; used in the server's thread
        self._opening: dict[ServerConnection, None] = {}  # connections that are not open yet, oldest first

    def open(self) -> None:
        """Accept clients from now on. Idempotent."""
        if self._thread.ident is None:
            self.start()
            logger.log(NOTE, "output json: ws://%s/", self.peer)

    def send(self, frame: OutputFrame, now_s: float) -> None:
        """Send a frame to each client that reads."""
        if self._clients:
            with suppress(RuntimeError):  # the server's loop is closed
                self._loop.call_soon_threadsafe(self._send, json_of(frame).decode())

    def statistics(self) -> Facts:
        """Return counts of connected clients, of refused requests, and of frames that slow clients missed."""
        return {"clients": len(self._clients), **self._counts}

    def _send(self, message: str) -> None:
        reading = [each for each in self._clients if each.transport.get_write_buffer_size() <= MOST_UNREAD]
        self._counts["missed"] += len(self._clients) - len(reading)
        broadcast(reading, message)

    async def _serve(self) -> None:
        class Client(RoomyConnection):
            opening = self._opening

        async with serve(
            self._served,
            sock=self._socket,
            process_request=self._problem,
            create_connection=Client,
            compression=None,
            open_timeout=CONNECTION_S,
            close_timeout=_STOP_S,
            max_size=_LONGEST,
            max_queue=1,
            server_header=None,
            logger=_handshakes,
        ):
            await self._closing.wait()

    def _problem(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the answer to a request that is refused; None to accept it."""
        host = request.headers.get("Host", "")
        problem = host_problem(host) or origin_problem(request.headers.get("Origin"), host)
        if problem is None and len(self._clients) >= MOST_CLIENTS:
            problem = f"{MOST_CLIENTS} clients are connected already"
        if problem is None:
            return None
        self._counts["refused"] += 1
        return connection.respond(HTTPStatus.FORBIDDEN, problem + "\n")

    async def _served(self, client: ServerConnection) -> None:
        """Keep a client until it closes; read and drop what it sends."""
        self._opening.pop(client, None)
        self._clients.add(client)
        try:
            for _ in range(MOST_RECEIVED):
                await client.recv()
                await asyncio.sleep(_RECEIVED_S)
            await client.close(1008, "this server reads no messages")
        except ConnectionClosed:
            return
        finally:
            self._clients.discard(client)


class RoomyConnection(ServerConnection):
    """Connection that makes room for itself if too many are still opening. `opening`: these, oldest first."""

    opening: dict[ServerConnection, None]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Abort the oldest connection that is not open yet if there are too many."""
        super().connection_made(transport)
        if len(self.opening) >= MOST_CLIENTS:
            next(iter(self.opening)).transport.abort()
        self.opening[self] = None

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection from `opening`."""
        self.opening.pop(self, None)
        super().connection_lost(exc)
