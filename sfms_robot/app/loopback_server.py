"""A small HTTP server by the standard library: status, metrics, the fleet's page. On loopback unless a host is named.

It runs in a process that has servos or listeners to serve, so clients may cost little: at most `MOST_CONNECTIONS` are
open, each for one request and for at most `CONNECTION_S`. The oldest connection makes room for a new one, so that a
client that sends its request at once is answered beside any number of slow ones.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from sfms_robot.endpoint import HIGHEST_PORT, LOOPBACK, port_number
from sfms_robot.errors import ConfigError, PortError
from sfms_robot.origin import host_problem

MOST_CONNECTIONS: Final = 32
CONNECTION_S: Final = 10.0  # for the request and for the answer, however either trickles
_NO_DESCRIPTOR_S: Final = 0.1  # pause where no connection can be taken: else the thread would spin until one can

AUTO: Final = "auto"  # `--status` without a port: `PORT`, or the next that is free
PORT: Final = 8775
_TRIED: Final = 20

Document = Callable[[], Mapping[str, Any]]


class LoopbackServer(ThreadingHTTPServer):
    """HTTP server that holds its port from construction until `close`; clients wait until `begin`.

    Raises OSError for a port that is in use.

    Attributes:
        port: the port that is bound; of 0, a free one.
        url: of its root; `note`: what people should know of it.
        document: gives what `Answer` has to say, at the time of a request.
    """

    daemon_threads = True
    request_queue_size = 128

    def __init__(
        self,
        port: int,
        answer: type[Answer],
        name: str,
        *,
        host: str = LOOPBACK,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Bind the port. `now`: a monotonic clock [s]."""
        super().__init__((host, port), answer)
        self.port = int(self.server_address[1])
        self.url, self.note = f"http://{host}:{self.port}/", ""
        self._name, self._now = name, now
        self._since_s: dict[Any, float] = {}  # connection -> when it was taken, oldest first
        self._thread: threading.Thread | None = None

    def begin(self, document: Document = dict) -> None:
        """Answer from now on, in threads, with this document."""
        self.document = document
        if self._thread is None:
            self._thread = threading.Thread(target=self.serve_forever, name=self._name, daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Give the port back. Idempotent."""
        if self._thread is not None:
            self.shutdown()
            self._thread.join()
            self._thread = None
        self.server_close()

    def get_request(self) -> tuple[Any, Any]:
        """Take a connection. Raises OSError, after a pause, where no descriptor is free for it."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(_NO_DESCRIPTOR_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a new thread."""
        self._since_s[request] = self._now()
        super().process_request(request, client_address)

    def service_actions(self) -> None:
        """End connections that are too many or too old. Called after each that is taken, and twice a second."""
        for place, (request, since_s) in enumerate(reversed(list(self._since_s.items()))):
            if place >= MOST_CONNECTIONS or self._now() - since_s >= CONNECTION_S:
                with suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)  # its thread finds the end of the stream, and closes it

    def shutdown_request(self, request: Any) -> None:
        """Close a connection that was served."""
        self._since_s.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print a traceback, unless the client has gone without waiting for the answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class Answer(BaseHTTPRequestHandler):
    """One request; subclasses define `do_GET` and `do_POST`."""

    server: LoopbackServer

    def parse_request(self) -> bool:
        """Read the request; answer 403 to one that calls this machine by a name that is not its own."""
        if not super().parse_request():
            return False
        problem = host_problem(self.headers.get("Host", ""))
        if problem is not None:
            self.answer(403, f"{problem}\n".encode(), "text/plain")
        return problem is None

    def answer(self, code: int, body: bytes, kind: str) -> None:
        """Send an answer. `kind`: its Content-Type."""
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Frame-Options", "DENY")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Log nothing: a line per request helps no reader."""


# --- the status of a run --------------------------------------------------------------------------------------------


def status_server(wanted: str) -> LoopbackServer:
    """Bind the port of `--status [PORT]`: how a run is, as one JSON document (`runtime.observers`). Read only.

    `wanted`: a port, "0" for any that is free, or `AUTO`. Raises ConfigError for what is no port, PortError for one
    that is in use.
    """
    if wanted != AUTO and port_number(wanted) is None:
        raise ConfigError(f"--status {wanted}: is no TCP port (0 to {HIGHEST_PORT}, 0 for a free one, or none)")
    ports = [*range(PORT, PORT + _TRIED), 0] if wanted == AUTO else [int(wanted)]
    problem: object = None
    for port in ports:
        try:
            server = LoopbackServer(port, _Answer, "status")
        except OSError as error:
            problem = error.strerror or error
            continue
        if wanted == AUTO and port != PORT:
            server.note = f" ({PORT} is taken)"
        return server
    raise PortError(f"--status {wanted}: {problem} (another port, or 0 for a free one)")


class _Answer(Answer):
    def do_GET(self) -> None:
        if self.path not in ("/", "/status"):
            self.send_error(404)
            return
        self.answer(200, json.dumps(self.server.document(), allow_nan=False).encode(), "application/json")
