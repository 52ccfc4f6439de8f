"""The page's process: a server, and the two pipes to the run that it shows."""

from __future__ import annotations

import asyncio
import errno
import logging
import pickle
import secrets
import socket
import ssl
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import orjson
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from sfms_robot.errors import ConfigError, PortError, RobotError
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.origin import is_loopback
from sfms_robot.processes import ParentPipe, PipeWriter, give_way
from sfms_robot.viewer.page_process import BEAT_S, Address
from sfms_robot.viewer.page_server import PageServer
from sfms_robot.viewer.visitor_commands import LONGEST_PERSON, Command

SceneOf = Callable[[str, Sequence[str]], RobotScene | None]
NICE: Final = 5  # the servo loop goes first
TRIED: Final = 20  # ports
MOST_UNSENT: Final = 100  # pieces of voice and face for a run that does not read: older ones are left out
SEND_BUFFER: Final = 65_536  # bytes on their way to a visitor: pictures that are a second old are of no use
HALF_OPEN_S: Final = 10.0  # for a TLS handshake, and for the head of a request


class PromptHttp(H11Protocol):
    """HTTP of uvicorn on one connection, which ends when the head of a request is not there in time."""

    half_open_s = HALF_OPEN_S

    def connection_made(self, transport: Any) -> None:
        """Wait for the first request."""
        super().connection_made(transport)
        self._await_request()

    def handle_events(self) -> None:
        """Read what came, and stop waiting when a request begins."""
        before = self.scope
        super().handle_events()
        if self.scope is not before:
            self._deadline.cancel()

    def on_response_complete(self) -> None:
        """Wait for the next request, which may have come already."""
        self._await_request()
        super().on_response_complete()

    def _await_request(self) -> None:
        self._deadline = self.loop.call_later(self.half_open_s, self.transport.abort)


class PageLoop(asyncio.SelectorEventLoop):
    """Event loop whose servers end a TLS handshake that is not over in time."""

    async def create_server(self, *given: Any, ssl: Any = None, **more: Any) -> asyncio.Server:
        """Make a server as asyncio does."""
        return await super().create_server(*given, ssl=ssl, ssl_handshake_timeout=ssl and HALF_OPEN_S, **more)


class RunPipe:
    """`page_server.Run` at the other end of a pipe. Nothing blocks."""

    def __init__(self, parent: ParentPipe) -> None:
        self._writer = PipeWriter(parent.outgoing, MOST_UNSENT, "run")

    def command(self, visitor: int, command: Command) -> None:
        """Send a command of a visitor."""
        self.send(visitor, command=command.name, values=command.values)

    def person(self, visitor: int, message: bytes) -> None:
        """Send a piece of a visitor's voice, or a face."""
        self._writer.offer(pickle.dumps((visitor, message)))

    def left(self, visitor: int) -> None:
        """Report that a visitor has the controls no more."""
        self.send(visitor, left=True)

    def watched(self, visitors: int) -> None:
        """Send the number of visitors."""
        self.send(0, watched=visitors)

    def beat(self) -> None:
        """Send a sign of life."""
        self._writer.send(pickle.dumps(None))

    def send(self, visitor: int, **document: Any) -> None:
        """Send a document."""
        self._writer.send(pickle.dumps((visitor, document)))


class FromRun:
    """Messages of the run, handled in the server's loop; of pictures that come together the newest is shown."""

    def __init__(self, page: PageServer, scene_of: SceneOf) -> None:
        self._page, self._scene_of = page, scene_of
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[Any] = deque()

    def put(self, message: Any) -> None:
        """Take a message, in the thread that reads."""
        self._waiting.append(message)
        self._loop.call_soon_threadsafe(self._handle)

    def _handle(self) -> None:
        picture: bytes | None = None
        for _ in range(len(self._waiting)):
            message = self._waiting.popleft()
            if isinstance(message, bytes):
                if picture is not None:
                    self._page.keep(picture)
                picture = message
            else:
                if picture is not None:
                    self._page.show(picture)
                    picture = None
                self._document(message[0], orjson.loads(message[1]))
        if picture is not None:
            self._page.show(picture)

    def _document(self, visitor: int, told: dict[str, Any]) -> None:
        do = told.pop("do")
        if do == "begin":
            self._page.begin(told, partial(self._scene_of, told.pop("scene", ""), told.pop("packages", ())))
        elif do == "end":
            self._page.end(told["report"])
        elif do == "error":
            self._page.answer(visitor, orjson.dumps({"type": "error", "error": told["error"]}))
        elif do == "recorded":
            file = told["file"]
            self._page.recorded(None if file is None else Path(file), told["record"])
        else:
            self._page.tell(orjson.dumps({"type": do, **told}), keep=do != "status")


def main(scene_of: SceneOf = lambda *_: None) -> None:
    """Serve until the pipe ends. `scene_of`: returns the picture of a head by its name."""
    parent = ParentPipe()
    address = parent.receive()
    give_way(NICE)
    with asyncio.Runner(loop_factory=PageLoop) as runner:
        runner.run(_serve(address, parent, scene_of))


async def _serve(address: Address, parent: ParentPipe, scene_of: SceneOf) -> None:
    run = RunPipe(parent)
    try:
        place = listen_at(address)
        _check_certificate(address)
    except RobotError as error:
        run.send(0, problem=str(error), of=type(error).__name__)
        return
    over = asyncio.Event()
    page = PageServer(run, place.token)
    loop = asyncio.get_running_loop()
    parent.forward(FromRun(page, scene_of).put, lambda: loop.call_soon_threadsafe(over.set))
    server = web_server(
        page.app,
        ws="websockets-sansio",
        loop="none",
        ws_max_size=LONGEST_PERSON,
        ws_per_message_deflate=False,
        ssl_certfile=address.certificate,
        ssl_keyfile=address.key,
    )
    serving = asyncio.create_task(server.serve(sockets=[place.socket]))
    page.prepare()
    run.send(0, bound=place.url, token=place.token, taken=place.taken)
    while not over.is_set():
        run.beat()
        with suppress(TimeoutError):
            await asyncio.wait_for(over.wait(), BEAT_S)
    server.should_exit = True
    await serving


def web_server(app: ASGIApp, **options: Any) -> uvicorn.Server:
    """Return the server of a page. `options`: further ones of `uvicorn.Config`.

    Of a text that is not UTF-8 nothing is logged: its connection is closed with code 1007.
    """
    logging.getLogger("uvicorn.error").addFilter(lambda record: UnicodeDecodeError not in (record.exc_info or ()))
    config = uvicorn.Config(
        app,
        http=PromptHttp,
        lifespan="off",
        log_config=None,
        log_level="error",
        access_log=False,
        timeout_graceful_shutdown=1,
        server_header=False,
        **options,
    )
    return uvicorn.Server(config)


class Listening(NamedTuple):
    """A socket that listens, and its address.

    Attributes:
        url: address to open in a browser, with its token where there is one.
        taken: port that was asked for and is used by another program; None where it was free.
    """

    socket: socket.socket
    url: str
    token: str | None
    taken: int | None


def listen_at(address: Address) -> Listening:
    """Listen at an address, or on the next port that is free. Raises PortError where there is none."""
    listening = _bound(address)
    host, port = listening.getsockname()[:2]
    token = None if is_loopback(host) else secrets.token_urlsafe(12)
    taken = None if address.port in (0, port) else address.port
    return Listening(listening, _url(address, host, port, token), token, taken)


def _bound(address: Address) -> socket.socket:
    ports = [0] if address.port == 0 else [*range(address.port, min(address.port + TRIED, 65536)), 0]
    for port in ports:
        try:
            family, _, _, _, where = socket.getaddrinfo(address.host, port, type=socket.SOCK_STREAM)[0]
            listening = socket.create_server(where[:2], family=family)
        except (OSError, UnicodeError) as error:
            if getattr(error, "errno", None) not in (errno.EADDRINUSE, errno.EACCES):
                problem = getattr(error, "strerror", None) or error
                raise PortError(f"--view {address.host}:{port}: {problem}") from error
        else:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            return listening
    raise PortError(f"--view {address.host}:{address.port}: no port is free")


def _url(address: Address, host: str, port: int, token: str | None) -> str:
    """Return the address to open; for a socket that listens on all addresses, with this machine's local name."""
    scheme = "http" if address.certificate is None else "https"
    if host in ("0.0.0.0", "::"):
        host = f"{socket.gethostname().partition('.')[0]}.local"
    name = f"[{host}]" if ":" in host else host
    return f"{scheme}://{name}:{port}/" + ("" if token is None else f"?token={token}")


def _check_certificate(address: Address) -> None:
    if address.certificate is not None:
        try:
            ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(address.certificate, address.key)
        except (ssl.SSLError, OSError) as error:
            problem = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
            pair = f"--view-cert {address.certificate}, --view-key {address.key}"
            raise ConfigError(f"{pair}: not a certificate with its key: {problem}") from error
