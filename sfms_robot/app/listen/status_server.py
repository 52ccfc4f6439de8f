"""`--status [PORT]`: how the run is, as one JSON document over HTTP, on loopback only.

    GET http://127.0.0.1:PORT/     the document of `runtime.status`, whole, as it is at that moment

Read only: who can read it can change nothing.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from sfms_robot.endpoint import HIGHEST_PORT, LOOPBACK, port_number
from sfms_robot.errors import ConfigError, PortError

AUTO: Final = "auto"  # `--status` without a port: `PORT`, or the next that is free
PORT: Final = 8775
_TRIED: Final = 20

Document = Callable[[], Mapping[str, Any]]


class StatusServer:
    """Holds its port from construction until `close`; whoever asks before `serve` waits.

    Args:
        wanted: a port, "0" for any that is free, or `AUTO`.

    Raises ConfigError for what is no port, PortError for one that is in use.

    Attributes:
        port: that it has.
        url: of the document.
    """

    def __init__(self, wanted: str) -> None:
        self._server = _bound(wanted)
        self.port = int(self._server.server_address[1])
        self.url = f"http://{LOOPBACK}:{self.port}/"
        self._taken = f" ({PORT} is taken)" if wanted == AUTO and self.port != PORT else ""
        self._thread: threading.Thread | None = None

    def __str__(self) -> str:
        """Where it is, for people."""
        return self.url + self._taken

    def serve(self, document: Document) -> None:
        """Answer with this document from now on, in threads of its own."""
        self._server.document = document
        if self._thread is None:
            self._thread = threading.Thread(target=self._server.serve_forever, name="status", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Give the port back. Idempotent."""
        if self._thread is not None:
            self._server.shutdown()
            self._thread.join()
            self._thread = None
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, port: int) -> None:
        super().__init__((LOOPBACK, port), _Handler)
        self.document: Document = dict

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), ConnectionError):  # who has gone without waiting for the answer
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        if self.path not in ("/", "/status"):
            self.send_error(404)
            return
        assert isinstance(self.server, _Server)
        body = json.dumps(self.server.document(), allow_nan=False).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nobody needs a line per request."""


def _bound(wanted: str) -> _Server:
    if wanted != AUTO and port_number(wanted) is None:
        raise ConfigError(f"--status {wanted}: is no TCP port (0 to {HIGHEST_PORT}, 0 for a free one, or none)")
    ports = [*range(PORT, PORT + _TRIED), 0] if wanted == AUTO else [int(wanted)]
    problem: object = None
    for port in ports:
        try:
            return _Server(port)
        except OSError as error:
            problem = error.strerror or error
    raise PortError(f"--status {wanted}: {problem} (another port, or 0 for a free one)")
