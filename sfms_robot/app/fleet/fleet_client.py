"""`sfms-robot fleet`: who is there, and halt or resume of some or all. The other side of `fleet_head`.

`sfms-robot fleet page`: a tile per head and a button that halts all, in a browser, on loopback.

    GET  /        the page
    GET  /heads   {"heads": [tile, ...]} (`tile`)
    POST /halt    {"heads": [name, ...]}, none: all     POST /resume  the same

Pages of other sites may not send commands: their browser tells whose page it is (Origin), and a command is JSON.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Self

from sfms_robot.app.fleet.fleet_head import ROOT, fleet_key, fleet_name, proof
from sfms_robot.app.loopback_server import Answer, LoopbackServer
from sfms_robot.errors import PortError, RobotError
from sfms_robot.network import AWAY_S, Connection, Router, session_config
from sfms_robot.origin import origin_problem

ASK_S: Final = 2.0  # that heads have to answer
GONE_S: Final = 3.0  # a head that has told nothing for so long is away
PORT: Final = 8776
PAGE: Final = Path(__file__).with_name("fleet.html")
_LONGEST: Final = 4096

Document = Mapping[str, Any]

log = logging.getLogger(__name__)


class Fleet:
    """A connection to the router that joins the heads. Opens in `__enter__`, which waits for `AWAY_S` at most.

    Attributes:
        malformed: count of messages that hold no document.

    Raises PortError when no router answers, ConfigError, MissingExtra.
    """

    def __init__(self, zenoh: Path | None = None, insecure: bool = False, key: Path | None = None) -> None:
        self._router, self._key = Router(zenoh, insecure), key
        self.malformed = 0
        self._connection: Connection | None = None
        self._session: Any = None

    def __enter__(self) -> Self:
        self._connection = Connection(session_config("call", self._router))
        self._session = self._connection.wait(AWAY_S)
        if self._session is None:
            self._connection.close()
            raise PortError(
                f"nobody answers at {self._router}: is `sfms-robot serve`, or another zenoh router, running?"
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._connection is not None:
            self._connection.close()

    def states(self) -> list[Document]:
        """The status document of every head that answers, by name. Blocks for `ASK_S` at most."""
        found = self._ask(f"{ROOT}/*/state", b"")
        return sorted(found, key=lambda each: str(each.get("name")))

    def command(self, heads: Sequence[str], command: Mapping[str, Any]) -> list[Document]:
        """What each of `heads` answers to a command; all heads where none is named."""
        keys = [f"{ROOT}/{fleet_name(head)}/command" for head in heads] or [f"{ROOT}/*/command"]
        return [answer for key in keys for answer in self._ask(key, json.dumps(dict(command)).encode())]

    def resume(self, heads: Sequence[str]) -> list[Document]:
        """Resume `heads`, or all, by the fleet's key. Raises ConfigError for a key that cannot be used."""
        key = fleet_key(self._key)
        answers: list[Document] = []
        for each in self.states():
            name = str(each.get("name"))
            if not heads or name in heads:
                signed = proof(key, name, "resume", str(each.get("nonce")))
                answers += self.command([name], {"command": "resume", "proof": signed})
        return answers

    def halt(self, heads: Sequence[str], by: str) -> list[Document]:
        """Halt `heads`, or all; said twice: on the keys for halting, which ask for no answer, and as a command."""
        for key in [f"{ROOT}/{fleet_name(head)}/halt" for head in heads] or [f"{ROOT}/*/halt"]:
            self._session.put(key, by.encode())
        return self.command(heads, {"command": "halt", "by": by})

    def follow(self, tell: Callable[[Document], None]) -> None:
        """`tell` of every document from now on, in a thread of zenoh's."""
        self._session.declare_subscriber(f"{ROOT}/*/state", lambda sample: self._tell(sample, tell))

    def _ask(self, key: str, payload: bytes) -> list[Document]:
        answers: list[Document] = []
        for reply in self._session.get(key, payload=payload, timeout=ASK_S):
            if reply.ok is not None:
                self._tell(reply.ok, answers.append)
        return answers

    def _tell(self, sample: Any, tell: Callable[[Document], None]) -> None:
        try:
            told = json.loads(sample.payload.to_bytes())
        except (ValueError, RecursionError):
            told = None
        if isinstance(told, dict) and isinstance(told.get("person") or {}, dict):
            tell(told)
            return
        self.malformed += 1
        if self.malformed == 1:
            log.warning("fleet: %s: expected a JSON document of a head (more are only counted)", sample.key_expr)


class FleetBoard:
    """The newest of every head, and who went away. From any thread."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._heads: dict[str, tuple[float, Document]] = {}
        self._lock = threading.Lock()

    def told(self, document: Document) -> None:
        with self._lock:
            self._heads[str(document.get("name", "?"))] = (self._now_s(), document)

    def tiles(self) -> list[dict[str, Any]]:
        """One per head, by name: what a page shows of it."""
        with self._lock:
            heads = sorted(self._heads.items())
        return [tile(name, document, self._now_s() - at_s) for name, (at_s, document) in heads]


def tile(name: str, document: Document, age_s: float = 0.0) -> dict[str, Any]:
    """A head in a few words; `here` False: it has told nothing for `GONE_S`, or it has ended."""
    state = str(document.get("state", "?"))
    hottest = document.get("hottest")
    return {
        "name": name,
        "head": document.get("head"),
        "listener": document.get("listener"),
        "port": document.get("port"),
        "here": age_s < GONE_S and state not in ("stopped", "fault"),
        "age_s": round(age_s, 1),
        "state": state,
        "why": document.get("why", []),
        "note": document.get("note"),
        "time_s": document.get("time_s"),
        "voice_db": (document.get("person") or {}).get("voice_db"),
        "motion": document.get("motion"),
        "hottest": hottest,
        "faults": document.get("faults", {}),
    }


# --- the page -------------------------------------------------------------------------------------------------------


def fleet_page(fleet: Fleet, port: int = PORT) -> LoopbackServer:
    """Serve the page until `close`. Raises PortError for a port that is taken (0: any free one)."""
    board = FleetBoard()
    for document in fleet.states():
        board.told(document)
    fleet.follow(board.told)
    try:
        server = _Server(port, fleet, board)
    except OSError as error:
        raise PortError(f"--port {port}: {error.strerror or error} (another, or 0 for a free one)") from error
    server.begin()
    return server


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
