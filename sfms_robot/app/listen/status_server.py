"""`--status PORT`: how the run is, as one JSON document over HTTP, on loopback only.

    GET http://127.0.0.1:PORT/     the document of `runtime.status`, whole, as it is at that moment

Read only: who can read it can change nothing.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from sfms_robot.errors import PortError

LOOPBACK: Final = "127.0.0.1"


@contextmanager
def status_server(port: int, document: Callable[[], Mapping[str, Any]]) -> Iterator[int]:
    """Serve while inside; yields the port, which the system chooses for 0. Raises PortError for one that is in use."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path not in ("/", "/status"):
                self.send_error(404)
                return
            body = json.dumps(document(), allow_nan=False).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Nobody needs a line per request."""

    try:
        server = ThreadingHTTPServer((LOOPBACK, port), Handler)
    except OSError as error:
        raise PortError(f"--status {port}: {error.strerror or error} (another port, or 0 for a free one)") from error
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, name="status", daemon=True)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
