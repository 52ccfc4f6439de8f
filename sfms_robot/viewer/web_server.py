"""Web server for all web addresses of this program: the page, the people study, status, metrics, the fleet's page.

Each of them is a list of routes. `application` puts them behind the access rules, `web_server` serves the application
and limits the cost of a client, `LocalServer` does both in a thread. The rules are the same for all:

1. Host: a request that calls this machine by a name that is not its own is refused (`endpoint.host_problem`).
2. Origin: WebSockets, and requests other than GET and HEAD, are refused if they come from pages of other sites.
3. Token: if bound beyond loopback, commands and recordings need the token of the printed address.
4. Time: a TLS handshake and the head of a request must be complete within `CONNECTION_S`.

A process that has servos or listeners to serve uses a `LocalServer`: a connection is for one request and ends
`CONNECTION_S` after it began, and the oldest of more than `MOST_CONNECTIONS` makes room for a new one. A client that
sends its request at once is therefore answered, regardless of the number of slow ones.
"""

from __future__ import annotations

import asyncio
import gzip
import logging
import lzma
import secrets
import socket
import ssl
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import orjson
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from sfms_robot.data import Report
from sfms_robot.endpoint import LOOPBACK, address_text, host_problem, is_loopback, listen, origin_problem, port_number
from sfms_robot.errors import ConfigError, InputError, RobotError
from sfms_robot.viewer.page_process import Address

if TYPE_CHECKING:  # it imports numpy, and a port in use must be reported at once
    from sfms_robot.ports import Document

MOST_CONNECTIONS: Final = 32
CONNECTION_S: Final = 10.0
LONGEST_BODY: Final = 4096  # bytes of a command
STATUS_PORT: Final = 8775
AUTO: Final = "auto"  # `--status` without a port: `STATUS_PORT`, or the next that is free
OTHER_PORTS: Final = 20  # further ports that are tried if the usual one is taken
SEND_BUFFER: Final = 65_536  # bytes on their way to a visitor; few, as pictures that are a second old are of no use
STATIC: Final = Path(__file__).with_name("static")
_HEADERS: Final = {
    "content-security-policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; "
    "connect-src 'self' ws: wss:; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",
}
_GZIP_LEVEL: Final = 6


# --- the access rules -----------------------------------------------------------------------------------------------


def application(routes: Sequence[BaseRoute]) -> ASGIApp:
    """Return the application of some routes behind the access rules; a RobotError of a route becomes status 400."""
    app = Starlette(routes=list(routes), exception_handlers={RobotError: _refused})

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            return
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        problem = host_problem(host)
        if problem is None and scope.get("method") not in ("GET", "HEAD"):  # a WebSocket has no method
            problem = origin_problem(headers.get("origin"), host)

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    answer.setdefault(name, value)
            await send(message)

        inner = app if problem is None else PlainTextResponse(problem + "\n", 403)
        await inner(scope, receive, with_headers)

    return guarded


async def _refused(request: Request, error: Exception) -> Response:
    return PlainTextResponse(f"{error}\n", 400)


async def json_body(request: Request) -> Report:
    """Return the JSON object that a request carries; {} for an empty body. Raises InputError."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > LONGEST_BODY:
            raise InputError(f"a message of more than {LONGEST_BODY} bytes")
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":  # others need no preflight
        raise InputError("a message is JSON (Content-Type: application/json)")
    try:
        given = orjson.loads(body or b"{}")
    except orjson.JSONDecodeError:
        given = None
    if not isinstance(given, dict):
        raise InputError("a message is one JSON object")
    return given


# --- connections ----------------------------------------------------------------------------------------------------


class PromptConnection(H11Protocol):
    """HTTP connection that ends when the head of a request is not complete in time."""

    limit_s = CONNECTION_S
    deadline: asyncio.TimerHandle

    def connection_made(self, transport: Any) -> None:
        """Wait for the first request."""
        super().connection_made(transport)
        self._await_request()

    def handle_events(self) -> None:
        """Read what arrived, and stop waiting when a request begins."""
        before = self.scope
        super().handle_events()
        if self.scope is not before:
            self.deadline.cancel()

    def on_response_complete(self) -> None:
        """Wait for the next request, which may be here already."""
        self._await_request()
        super().on_response_complete()

    def _await_request(self) -> None:
        self.deadline = self.loop.call_later(self.limit_s, self.transport.abort)


class BriefConnection(PromptConnection):
    """HTTP connection for one request, to be answered within the limit; the oldest of too many connections is ended."""

    handle_events = H11Protocol.handle_events
    on_response_complete = H11Protocol.on_response_complete

    def connection_made(self, transport: Any) -> None:
        """End the oldest connection if there are too many."""
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            others = (each for each in self.connections if isinstance(each, PromptConnection))
            oldest = min(others, key=lambda each: each.deadline.when())
            self.connections.discard(oldest)
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the limit."""
        self.deadline.cancel()
        super().connection_lost(exc)


class WebLoop(asyncio.SelectorEventLoop):
    """Event loop whose servers end a TLS handshake that is not over in time, and wait quietly for descriptors."""

    async def create_server(self, *given: Any, ssl: Any = None, **more: Any) -> asyncio.Server:
        """Make a server as asyncio does, with a limit for TLS handshakes."""
        return await super().create_server(*given, ssl=ssl, ssl_handshake_timeout=ssl and CONNECTION_S, **more)

    def call_exception_handler(self, context: Report) -> None:
        """Report an error, unless no descriptor is free for a connection: asyncio tries again a second later."""
        if "out of system resource" not in context["message"]:
            super().call_exception_handler(context)


def web_server(app: ASGIApp, connection: type[H11Protocol] = PromptConnection, **options: Any) -> uvicorn.Server:
    """Return the server of an application. `options`: further options of `uvicorn.Config`.

    A text message that is not UTF-8 is not logged: its connection is closed with code 1007.
    """
    logging.getLogger("uvicorn.error").addFilter(lambda record: UnicodeDecodeError not in (record.exc_info or ()))
    return uvicorn.Server(
        uvicorn.Config(
            app,
            http=connection,
            loop=f"{__name__}:WebLoop",
            lifespan="off",
            log_config=None,
            log_level="error",
            access_log=False,
            timeout_graceful_shutdown=1,
            server_header=False,
            **options,
        )
    )


class LocalServer:
    """Server in a thread. It holds its port from construction until `close`; clients wait until `begin`.

    Args:
        flag: its option, as a name in errors and for its thread.
        routes: function that makes routes from a function that returns the present document.
        others: number of further ports that are tried.

    Attributes:
        port: the port that is bound; for 0, a free one.
        url: address of its root. note: " (PORT is taken)" if another port than the requested one is bound.

    Raises PortError.
    """

    def __init__(
        self, flag: str, routes: Callable[[Document], Sequence[BaseRoute]], host: str, port: int, others: int = 0
    ) -> None:
        self._socket = listen(flag, host, port, others)
        self.port: int = self._socket.getsockname()[1]
        self.url = f"http://{address_text(host, self.port)}/"
        self.note = "" if port in (0, self.port) else f" ({port} is taken)"
        self._document: Document = dict
        app = application(routes(lambda: self._document()))
        self._server = web_server(app, BriefConnection, ws="none", headers=[("connection", "close")])
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), name=flag, daemon=True)

    def begin(self, document: Document = dict) -> None:
        """Start to answer, with this document."""
        self._document = document
        if self._thread.ident is None:
            self._thread.start()

    def close(self) -> None:
        """Release the port; blocks for a second at most. Idempotent."""
        self._server.should_exit = True
        if self._thread.ident is not None:
            self._thread.join()
        self._socket.close()


def status_server(wanted: str) -> LocalServer:
    """Bind the port of `--status [PORT]`: the state of a run as one JSON document (`runtime.observers`). Read only.

    `wanted`: a port, "0" for any that is free, or `AUTO`. Raises ConfigError, PortError.
    """
    port = STATUS_PORT if wanted == AUTO else port_number(wanted)
    if port is None:
        raise ConfigError(f"--status {wanted}: expected a TCP port from 0 to 65535 (0: any free one), or no value")

    def routes(document: Document) -> list[BaseRoute]:
        def status(request: Request) -> Response:
            return JSONResponse(document())

        return [Route(path, status) for path in ("/", "/status")]

    return LocalServer("--status", routes, LOOPBACK, port, OTHER_PORTS if wanted == AUTO else 0)


class ListeningSocket(NamedTuple):
    """A socket that listens, and its address.

    Attributes:
        url: address to open in a browser, with its token if there is one.
        taken: port that was requested and is used by another program; None if it was free.
    """

    socket: socket.socket
    url: str
    token: str | None
    taken: int | None


def listen_at(address: Address) -> ListeningSocket:
    """Listen at an address of `--view`, or on the next port that is free. Raises PortError, ConfigError."""
    listening = listen("--view", address.host, address.port, OTHER_PORTS)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    if address.certificate is not None:
        try:
            ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(address.certificate, address.key)
        except (ssl.SSLError, OSError) as error:
            problem = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
            pair = f"--view-cert {address.certificate}, --view-key {address.key}"
            raise ConfigError(f"{pair}: not a certificate with its key: {problem}") from error
    host, port = listening.getsockname()[:2]
    token = None if is_loopback(host) else secrets.token_urlsafe(12)
    name = f"{socket.gethostname().partition('.')[0]}.local" if host in ("0.0.0.0", "::") else host
    scheme = "http" if address.certificate is None else "https"
    url = f"{scheme}://{address_text(name, port)}/" + ("" if token is None else f"?token={token}")
    return ListeningSocket(listening, url, token, None if address.port in (0, port) else address.port)


# --- files ----------------------------------------------------------------------------------------------------------


class CompressedFiles(StaticFiles):
    """Files of a folder, with gzip for clients that accept it, otherwise plain. Parts of a file are plain.

    A file that is stored as FILE.xz, to be small where it is installed, is served as FILE, and always whole.
    """

    def __init__(self, folder: Path = STATIC) -> None:
        super().__init__(directory=folder)
        self._folder = folder
        self._stored = {str(file.relative_to(folder).with_suffix("")) for file in folder.rglob("*.xz")}
        self._packed: dict[tuple[Path, float], asyncio.Task[bytes]] = {}

    def prepare(self, pattern: str = "*") -> None:
        """Start to compress files of the folder itself; other files are compressed at the first request."""
        for file in sorted(self._folder.glob(pattern)):
            if file.is_file():
                self._gzip(file)

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return the response with a file."""
        stored = path in self._stored
        plain = await super().get_response(f"{path}.xz" if stored else path, scope)
        wanted = Headers(scope=scope)
        if not isinstance(plain, FileResponse) or plain.status_code != 200 or (scope["method"] != "GET" and not stored):
            return plain
        plain.headers["Vary"] = "Accept-Encoding"
        headers = {key: value for key, value in plain.headers.items() if key not in ("content-length", "accept-ranges")}
        file = Path(plain.path)
        if "gzip" in wanted.get("accept-encoding", "") and (stored or "range" not in wanted):
            return Response(await self._gzip(file), headers=headers | {"Content-Encoding": "gzip"})
        return Response(await asyncio.to_thread(_plain, file), headers=headers) if stored else plain

    def _gzip(self, file: Path) -> asyncio.Task[bytes]:
        """Return the task of a thread that compresses the file; there is one task for each version of a file."""
        version = (file, file.stat().st_mtime)
        if version not in self._packed:
            work = asyncio.to_thread(lambda: gzip.compress(_plain(file), _GZIP_LEVEL, mtime=0))
            self._packed[version] = asyncio.create_task(work)
        return self._packed[version]


def _plain(file: Path) -> bytes:
    return lzma.decompress(file.read_bytes()) if file.suffix == ".xz" else file.read_bytes()
