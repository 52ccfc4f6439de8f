"""`--status [PORT]`: how the run is, as one JSON document over HTTP, on loopback only.

    GET http://127.0.0.1:PORT/     the document of `runtime.observers`, whole, as it is at that moment

Read only: who can read it can change nothing.
"""

from __future__ import annotations

import json
from typing import Final

from sfms_robot.app.loopback_server import Answer, Document, LoopbackServer
from sfms_robot.endpoint import HIGHEST_PORT, port_number
from sfms_robot.errors import ConfigError, PortError

AUTO: Final = "auto"  # `--status` without a port: `PORT`, or the next that is free
PORT: Final = 8775
_TRIED: Final = 20


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
        self.port, self.url = self._server.port, self._server.url
        self._taken = f" ({PORT} is taken)" if wanted == AUTO and self.port != PORT else ""

    def __str__(self) -> str:
        """Where it is, for people."""
        return self.url + self._taken

    def serve(self, document: Document) -> None:
        """Answer with this document from now on, in threads of its own."""
        self._server.document = document
        self._server.begin()

    def close(self) -> None:
        """Give the port back. Idempotent."""
        self._server.close()


class _Answer(Answer):
    def do_GET(self) -> None:
        if self.path not in ("/", "/status"):
            self.send_error(404)
            return
        self.answer(200, json.dumps(self.server.document(), allow_nan=False).encode(), "application/json")


def _bound(wanted: str) -> LoopbackServer:
    if wanted != AUTO and port_number(wanted) is None:
        raise ConfigError(f"--status {wanted}: is no TCP port (0 to {HIGHEST_PORT}, 0 for a free one, or none)")
    ports = [*range(PORT, PORT + _TRIED), 0] if wanted == AUTO else [int(wanted)]
    problem: object = None
    for port in ports:
        try:
            return LoopbackServer(port, _Answer, "status")
        except OSError as error:
            problem = error.strerror or error
    raise PortError(f"--status {wanted}: {problem} (another port, or 0 for a free one)")
