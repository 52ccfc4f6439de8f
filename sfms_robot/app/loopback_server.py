"""A small HTTP server on loopback, by the standard library: what it answers is in the file of who serves it."""

from __future__ import annotations

import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from sfms_robot.endpoint import LOOPBACK


class LoopbackServer(ThreadingHTTPServer):
    """Holds its port from construction until `close`; who asks before `begin` waits. Raises OSError for one in use.

    Attributes:
        port: that it has; of 0, one that was free.
        url: of its root.
    """

    daemon_threads = True

    def __init__(self, port: int, answer: type[Answer], name: str) -> None:
        super().__init__((LOOPBACK, port), answer)
        self.port = int(self.server_address[1])
        self.url = f"http://{LOOPBACK}:{self.port}/"
        self._name = name
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Answer from now on, in threads of its own. Idempotent."""
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

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), ConnectionError):  # who has gone without waiting for the answer
            super().handle_error(request, client_address)


class Answer(BaseHTTPRequestHandler):
    """One request; says what `do_GET` and `do_POST` of its heirs have for it."""

    def answer(self, code: int, body: bytes, kind: str) -> None:
        """`kind`: the Content-Type."""
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Frame-Options", "DENY")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nobody needs a line per request."""
