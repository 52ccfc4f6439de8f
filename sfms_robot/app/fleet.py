"""A fleet of heads, over zenoh: `run --fleet NAME` (`FleetHead`), `sfms-robot fleet` (`Fleet`) and its page.

    sfms/NAME/state     the status document (`RunStatus`) as JSON: once a second, at every change of state, and as
                        the answer to a query; with a `nonce`, and `malformed`, the count of refused messages
    sfms/NAME/command   JSON, as a query that is answered {"done": command} or {"error": line}, or as a put:
                        {"command": "halt"}
                        {"command": "resume", "proof": hex} {"command": "end", "proof": hex}
                        {"command": "calm", "rates": {kind: per minute}}
                        {"command": "knobs", "intensity": {region: value}, "style": {region: value}}
    sfms/NAME/halt      anything that is put here halts the head; the text names the sender. sfms/*/halt halts all

`proof` is an HMAC with the fleet's key over name, command and nonce (see the function `proof`). The key itself is never
sent, and a nonce is valid once, so an intercepted message is of no use.

If the network is lost, the head continues, and sends again when it is back. Halting by network is a convenience: an
emergency stop is a switch on the head (docs/safety.md).
"""

from __future__ import annotations

import hmac
import json
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from sfms_robot.app.listen.knobs import RunControls
from sfms_robot.config.base import Finite, one_line
from sfms_robot.data import Names, user_dir
from sfms_robot.endpoint import LOOPBACK
from sfms_robot.errors import ConfigError, PortError, RobotError, first_line
from sfms_robot.network import AWAY_S, Connection, Router, check_name, session_config
from sfms_robot.ports import Facts, Observer, Tick
from sfms_robot.processes import start_thread

if TYPE_CHECKING:
    import zenoh

    from sfms_robot.viewer.web_server import LocalServer

ROOT: Final = "sfms"
TAKEN: Final = ("listen",)  # names whose keys mean something else
TELL_S: Final = 1.0
ASK_S: Final = 2.0  # time that heads have to answer
GONE_S: Final = 3.0  # a head without news for this long counts as away
PAGE: Final = Path(__file__).with_name("fleet_page.html")
_LONGEST: Final = 4096
_LONGEST_NAME: Final = 80
_SHORTEST_KEY: Final = 32

log = logging.getLogger(__name__)


def fleet_name(name: str) -> str:
    """Return the name of a head in a fleet. Raises ConfigError for a name that is not allowed."""
    if name in TAKEN:
        raise ConfigError(f"--fleet {name!r}: that name is taken ({', '.join(TAKEN)})")
    return check_name(name, "--fleet")


def fleet_key(file: Path | None) -> bytes:
    """Return the key in `file` (None: `fleet.key` in the folder of `user_dir`), which is created if it is missing.

    Raises ConfigError for a file that others can read, or that holds no key.
    """
    file = file or user_dir() / "fleet.key"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch(0o600, exist_ok=False)
        file.write_text(secrets.token_hex(32), encoding="ascii")
    if (mode := file.stat().st_mode & 0o777) & 0o077:
        raise ConfigError(f"--fleet-key {file}: expected mode 600, got {mode:o}: chmod 600 {file}")
    key = file.read_bytes().strip()
    if len(key) < _SHORTEST_KEY:
        raise ConfigError(f"--fleet-key {file}: expected a key of {_SHORTEST_KEY} characters or more, got {len(key)}")
    return key


def proof(key: bytes, name: str, command: str, nonce: str) -> str:
    """Return the proof that the sender of a command holds the key: HMAC-SHA256 of "NAME COMMAND NONCE", hex."""
    return hmac.new(key, f"{name} {command} {nonce}".encode(), "sha256").hexdigest()


# --- commands -------------------------------------------------------------------------------------------------------


class _Halt(BaseModel):
    command: Literal["halt"]
    by: Any = ""


class _Keyed(BaseModel):
    """A command that needs the fleet's key."""

    command: Literal["resume", "end"]
    proof: Any = None


class _Calm(BaseModel):
    command: Literal["calm"]
    rates: dict[str, Any] = {}


class _Knobs(BaseModel):
    command: Literal["knobs"]
    intensity: dict[str, Annotated[Finite, Field(strict=True)]] = {}
    style: dict[str, Annotated[Finite, Field(strict=True)]] = {}


_Command = Annotated[_Halt | _Keyed | _Calm | _Knobs, Field(discriminator="command")]
_COMMAND: Final[TypeAdapter[_Command]] = TypeAdapter(_Command)


class FleetControls:
    """A receiver of commands, from any thread, that carries them out on a run.

    Args:
        run: the controls of the run.
        name: name of the head. key: key of the fleet (`fleet_key`), which `_Keyed` commands need; None: none is needed.

    Attributes:
        nonce: part of the proof of the next command that needs the key.
    """

    def __init__(self, run: RunControls, name: str, key: bytes | None) -> None:
        self._lock = threading.Lock()
        self.nonce = secrets.token_hex(8)
        self.run, self.name, self._key = run, name, key

    def halt(self, by: str) -> None:
        """Halt; `by` is the name that the client gives itself."""
        name = "".join(each for each in by if each.isprintable())[:_LONGEST_NAME].strip()
        self.run.halt.close(name or "the fleet", "fleet")

    def obey(self, message: bytes) -> dict[str, str]:
        """Carry out a command; return it as done, or the reason why it has no effect. Never raises."""
        try:
            command = _COMMAND.validate_json(message if len(message) <= _LONGEST else b"")
            match command:
                case _Halt():
                    self.halt(str(command.by))
                case _Keyed():
                    if self._key is not None:
                        self._check_proof(command, self._key)
                    if command.command == "end":
                        self.run.interrupt.ask()
                    else:
                        self.run.halt.resume("fleet")
                case _Calm():
                    if self.run.set_rates is None:
                        raise ConfigError("calm: this run's listener decides no events")
                    self.run.calm(command.rates)
                case _Knobs():
                    self.run.knobs.turn(command.intensity, command.style)
        except ValidationError as error:
            return {"error": " ".join(one_line(error.errors()[0]).split())}
        except RobotError as error:
            return {"error": first_line(error)}
        return {"done": command.command}

    def _check_proof(self, command: _Keyed, key: bytes) -> None:
        """Raise ConfigError unless a command comes from a holder of the key; such a command uses up the nonce."""
        with self._lock:
            wanted = proof(key, self.name, command.command, self.nonce)
            given = str(command.proof).encode(errors="replace")
            if not hmac.compare_digest(wanted.encode(), given):
                raise ConfigError(
                    f"{command.command}: proof: expected the fleet's key (--fleet-key) and the last nonce"
                )
            self.nonce = secrets.token_hex(8)


class FleetHead(Observer):
    """`ports.Observer` that sends the state of a run to the fleet, in a thread.

    Args:
        controls: controls of the run, with the name of this head in the fleet.
        router: router that connects the fleet.

    Raises ConfigError, MissingExtra.
    """

    def __init__(self, controls: FleetControls, router: Router) -> None:
        self._name, self._controls = fleet_name(controls.name), controls
        self._connection = Connection(session_config("call", router))
        self._news, self._over = threading.Event(), False
        self._malformed = 0
        self._state: tuple[str, Names] = ("", ())
        self._thread = start_thread(self._work, "fleet")

    def tick(self, seen: Tick) -> None:
        """Send the state soon if it has changed."""
        state = seen.state, seen.why
        if state != self._state:
            self._state = state
            self._news.set()

    def close(self) -> None:
        """Send the final state of the run, and disconnect. Idempotent."""
        self._over = True
        self._news.set()
        self._thread.join(TELL_S)
        self._connection.close()

    def _work(self) -> None:
        try:
            while (session := self._connection.wait(TELL_S)) is None:
                if self._over:
                    return
        except RobotError as error:
            log.error("fleet: %s; the head continues without it", error)
            return
        key = f"{ROOT}/{self._name}"
        session.declare_queryable(f"{key}/state", lambda query: query.reply(f"{key}/state", self._state_json()))
        session.declare_queryable(f"{key}/command", self._on_query)
        session.declare_subscriber(f"{key}/command", lambda sample: self._obey(sample.payload.to_bytes()))
        session.declare_subscriber(
            f"{key}/halt",
            lambda sample: self._controls.halt(sample.payload.to_bytes()[:_LONGEST_NAME].decode(errors="replace")),
        )
        while True:
            over = self._over  # read before sending, so that the last state is sent
            session.put(f"{key}/state", self._state_json())
            if over:
                return
            self._news.wait(TELL_S)
            self._news.clear()

    def _state_json(self) -> bytes:
        document = {
            **self._controls.run.document(),
            "name": self._name,
            "nonce": self._controls.nonce,
            "malformed": self._malformed,
        }
        return json.dumps(document, allow_nan=False).encode()

    def _on_query(self, query: zenoh.Query) -> None:
        answer = self._obey(b"" if query.payload is None else query.payload.to_bytes())
        query.reply(f"{ROOT}/{self._name}/command", json.dumps({"name": self._name, **answer}).encode())

    def _obey(self, message: bytes) -> dict[str, str]:
        answer = self._controls.obey(message)
        if "error" in answer:
            self._malformed += 1
            if self._malformed == 1:
                log.warning("fleet: %s/%s/command: %s (more are only counted)", ROOT, self._name, answer["error"])
        return answer


# --- the side that watches and commands -----------------------------------------------------------------------------


@contextmanager
def open_fleet(zenoh: Path | None, insecure: bool = False, key: Path | None = None) -> Iterator[Fleet]:
    """Connect to the router of the heads while inside. Blocks for `AWAY_S` at most.

    Raises PortError when no router answers, ConfigError, MissingExtra.
    """
    router = Router(zenoh, insecure)
    with closing(Connection(session_config("call", router))) as connection:
        if (session := connection.wait(AWAY_S)) is None:
            raise PortError(f"no answer at {router}: is `sfms-robot serve`, or another zenoh router, running?")
        yield Fleet(session, key)


@dataclass
class Fleet:
    """The heads behind a router (`open_fleet`). `key`: file of the fleet's key (`fleet_key`).

    Attributes:
        malformed: number of messages that hold no document.
    """

    session: Any
    key: Path | None = None
    malformed: int = 0

    def states(self) -> list[Facts]:
        """Return the status document of every head that answers, by name. Blocks for `ASK_S` at most."""
        return sorted(self._ask(f"{ROOT}/*/state", b""), key=lambda each: str(each.get("name")))

    def command(self, heads: Sequence[str], command: Facts) -> list[Facts]:
        """Send a command to `heads`, or to all if none is named; return their answers."""
        keys = [f"{ROOT}/{fleet_name(head)}/command" for head in heads] or [f"{ROOT}/*/command"]
        return [answer for key in keys for answer in self._ask(key, json.dumps(dict(command)).encode())]

    def resume(self, heads: Sequence[str]) -> list[Facts]:
        """Resume `heads`, or all, with the fleet's key. Raises ConfigError for a key that cannot be used."""
        key = fleet_key(self.key)
        answers: list[Facts] = []
        for each in self.states():
            name = str(each.get("name"))
            if not heads or name in heads:
                signed = proof(key, name, "resume", str(each.get("nonce")))
                answers += self.command([name], {"command": "resume", "proof": signed})
        return answers

    def halt(self, heads: Sequence[str], by: str) -> list[Facts]:
        """Halt `heads`, or all. It is sent twice: on the keys for halting, which need no answer, and as a command."""
        for key in [f"{ROOT}/{fleet_name(head)}/halt" for head in heads] or [f"{ROOT}/*/halt"]:
            self.session.put(key, by.encode())
        return self.command(heads, {"command": "halt", "by": by})

    def follow(self, receive: Callable[[Facts], None]) -> None:
        """Call `receive` with every document from now on, in a thread of zenoh."""
        self.session.declare_subscriber(f"{ROOT}/*/state", lambda sample: self._read(sample, receive))

    def _ask(self, key: str, payload: bytes) -> list[Facts]:
        answers: list[Facts] = []
        for reply in self.session.get(key, payload=payload, timeout=ASK_S):
            if reply.ok is not None:
                self._read(reply.ok, answers.append)
        return answers

    def _read(self, sample: Any, receive: Callable[[Facts], None]) -> None:
        try:
            given = json.loads(sample.payload.to_bytes())
        except (ValueError, RecursionError):
            given = None
        if isinstance(given, dict) and isinstance(given.get("person") or {}, dict):
            receive(given)
            return
        self.malformed += 1
        if self.malformed == 1:
            log.warning("fleet: %s: expected a JSON document of a head (more are only counted)", sample.key_expr)


def tile(name: str, document: Facts, age_s: float = 0.0) -> Facts:
    """Return a summary of a head; `here` is False if it has ended or sent no news for `GONE_S`."""
    state = str(document.get("state", "?"))
    return {
        "name": name,
        **{key: document.get(key) for key in ("head", "listener", "port", "note", "time_s", "motion", "hottest")},
        "here": age_s < GONE_S and state not in ("stopped", "fault"),
        "age_s": round(age_s, 1),
        "state": state,
        "why": document.get("why", []),
        "voice_db": (document.get("person") or {}).get("voice_db"),
        "faults": document.get("faults", {}),
    }


def fleet_page(fleet: Fleet, port: int) -> LocalServer:
    """Serve a tile per head and a button that halts all, on loopback, until `close`. Raises PortError.

    GET /: the page. GET /heads: {"heads": [tile, ...]}. POST /halt, /resume: {"heads": [name, ...]}; no name: all.
    """
    import asyncio

    from starlette.requests import Request
    from starlette.responses import HTMLResponse, JSONResponse, Response
    from starlette.routing import Route

    from sfms_robot.viewer.web_server import LocalServer, json_body

    newest: dict[str, tuple[float, Facts]] = {}  # newest document of each head, and when it came

    def put(document: Facts) -> None:
        newest[str(document.get("name", "?"))] = time.monotonic(), document

    for document in fleet.states():
        put(document)
    fleet.follow(put)

    def page(request: Request) -> Response:
        inline = "default-src 'self' data: 'unsafe-inline'; frame-ancestors 'none'"
        return HTMLResponse(PAGE.read_bytes(), headers={"content-security-policy": inline})

    def tiles(request: Request) -> Response:
        heads, now_s = sorted(newest.copy().items()), time.monotonic()
        return JSONResponse({"heads": [tile(name, document, now_s - came_s) for name, (came_s, document) in heads]})

    async def order(request: Request) -> Response:
        heads = (await json_body(request)).get("heads", [])
        if not isinstance(heads, list) or not all(isinstance(each, str) for each in heads):
            raise ConfigError("heads: expected a list of names")
        if request.url.path == "/resume":
            answers = await asyncio.to_thread(fleet.resume, heads)
        else:
            answers = await asyncio.to_thread(fleet.halt, heads, "the fleet's page")
        return JSONResponse({"answers": answers})

    routes = [Route("/", page), Route("/heads", tiles)]
    routes += [Route(path, order, methods=["POST"]) for path in ("/halt", "/resume")]
    server = LocalServer("--port", lambda _: routes, LOOPBACK, port)
    server.begin()
    return server
