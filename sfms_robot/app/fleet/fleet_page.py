"""`sfms-robot fleet page`: a tile per head and a button that halts all, in a browser, on loopback.

    GET  /        the page
    GET  /heads   {"heads": [tile, ...]} (`fleet_client.tile`)
    POST /halt    {"heads": [name, ...]}, none: all     POST /resume  the same

Pages of other sites may not send commands: their browser tells whose page it is (Origin), and a command is JSON.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from sfms_robot.app.fleet.fleet_client import Fleet, FleetBoard
from sfms_robot.app.loopback_server import Answer, LoopbackServer
from sfms_robot.errors import PortError, RobotError
from sfms_robot.origin import origin_problem

PORT: Final = 8776
PAGE: Final = Path(__file__).with_name("fleet.html")
_LONGEST: Final = 4096


class FleetPage:
    """Serves from construction until `close`. Raises PortError for a port that is taken (0: any free one)."""

    def __init__(self, fleet: Fleet, port: int = PORT) -> None:
        board = FleetBoard()
        for document in fleet.states():
            board.told(document)
        fleet.follow(board.told)
        try:
            self._server = _Server(port, fleet, board)
        except OSError as error:
            raise PortError(f"--port {port}: {error.strerror or error} (another, or 0 for a free one)") from error
        self.url = self._server.url
        self._server.begin()

    def close(self) -> None:
        """Give the port back."""
        self._server.close()


class _Server(LoopbackServer):
    def __init__(self, port: int, fleet: Fleet, board: FleetBoard) -> None:
        super().__init__(port, _Answer, "fleet page")
        self.fleet, self.board = fleet, board


class _Answer(Answer):
    def do_GET(self) -> None:
        assert isinstance(self.server, _Server)
        if self.path == "/":
            self.answer(200, PAGE.read_bytes(), "text/html; charset=utf-8")
        elif self.path == "/heads":
            self._json(200, {"heads": self.server.board.tiles()})
        else:
            self.send_error(404)

    def do_POST(self) -> None:
        assert isinstance(self.server, _Server)
        problem = origin_problem(self.headers.get("Origin"), self.headers.get("Host", ""))
        if problem is not None or self.headers.get_content_type() != "application/json":
            self._json(403, {"error": problem or "a command is JSON (Content-Type: application/json)"})
            return
        fleet = self.server.fleet
        orders: Mapping[str, Callable[[list[str]], Any]] = {
            "/halt": lambda heads: fleet.halt(heads, "the fleet's page"),
            "/resume": fleet.resume,
        }
        order = orders.get(self.path)
        if order is None:
            self.send_error(404)
            return
        try:
            self._json(200, {"answers": order(self._heads())})
        except (RobotError, ValueError) as error:
            self._json(400, {"error": str(error)})

    def _heads(self) -> list[str]:
        length = int(self.headers.get("Content-Length") or 0)
        if not 0 <= length <= _LONGEST:
            raise ValueError(f"a command of {length} bytes")
        told = json.loads(self.rfile.read(length) or b"{}")
        heads = told.get("heads", []) if isinstance(told, dict) else None
        if not isinstance(heads, list) or not all(isinstance(each, str) for each in heads):
            raise ValueError("heads is no list of names")
        return heads

    def _json(self, code: int, told: Mapping[str, Any]) -> None:
        self.answer(code, json.dumps(told).encode(), "application/json")
