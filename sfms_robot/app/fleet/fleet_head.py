"""`run --fleet NAME`: a head among others, over zenoh.

    sfms/NAME/state     the status document (`RunStatus`) as JSON: once a second, at every change of state, and as
                        the answer to a query; with a `nonce`, and `malformed`, the count of refused messages
    sfms/NAME/command   JSON, as a query that is answered {"done": command} or {"error": line}, or as a put:
                        {"command": "halt"}
                        {"command": "resume", "proof": hex} {"command": "end", "proof": hex}
                        {"command": "calm", "rates": {kind: per minute}}
                        {"command": "knobs", "intensity": {region: value}, "style": {region: value}}
    sfms/NAME/halt      whatever is put here halts the head; the text says who. sfms/*/halt halts all

`proof` is an HMAC by the fleet's key over name, command and nonce (`proof`): the key itself is never sent, and a nonce
counts once, so that a message that was overheard is of no use.

The network may be away: the head goes on, and tells again when it is back. Halting by network is a convenience: an
emergency stop is a switch on the head (docs/safety.md).
"""

from __future__ import annotations

import hmac
import json
import logging
import os
import secrets
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.app.listen.knobs import KNOB_KINDS, LiveKnobs
from sfms_robot.config import Calmness
from sfms_robot.config.base import parse
from sfms_robot.config.overlay import config_folder
from sfms_robot.endpoint import whole_number
from sfms_robot.errors import ConfigError, RobotError
from sfms_robot.network import LOCAL, Connection, Router, check_name, session_config
from sfms_robot.ports import Observer, Tick
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.safety import Interrupt

if TYPE_CHECKING:
    import zenoh

ROOT: Final = "sfms"
TAKEN: Final = ("listen",)  # names whose keys mean something else
TELL_S: Final = 1.0
COMMANDS: Final = ("halt", "resume", "end", "calm", "knobs")
KEYED: Final = ("resume", "end")  # commands that need the fleet's key
_LONGEST: Final = 4096
_LONGEST_NAME: Final = 80
_SHORTEST_KEY: Final = 32

log = logging.getLogger(__name__)


def fleet_name(name: str) -> str:
    """`name`, which a head may have. Raises ConfigError."""
    if name in TAKEN:
        raise ConfigError(f"--fleet {name!r}: that name is taken ({', '.join(TAKEN)})")
    return check_name(name, "--fleet")


def fleet_key(file: Path | None) -> bytes:
    """Return the key in `file` (None: `fleet.key` beside the overlays of heads), which is made if it is not there.

    Raises ConfigError for a file that others can read, or that holds no key.
    """
    file = file or config_folder() / "fleet.key"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        with open(os.open(file, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w", encoding="ascii") as made:
            made.write(secrets.token_hex(32))
    if (mode := file.stat().st_mode & 0o777) & 0o077:
        raise ConfigError(f"--fleet-key {file}: expected mode 600, got {mode:o}: chmod 600 {file}")
    key = file.read_bytes().strip()
    if len(key) < _SHORTEST_KEY:
        raise ConfigError(f"--fleet-key {file}: expected a key of {_SHORTEST_KEY} characters or more, got {len(key)}")
    return key


def proof(key: bytes, name: str, command: str, nonce: str) -> str:
    """Return what shows a head that the sender of a command holds the key: HMAC-SHA256 of "NAME COMMAND NONCE", hex."""
    return hmac.new(key, f"{name} {command} {nonce}".encode(), "sha256").hexdigest()


class FleetControls:
    """What a command may do to a run, from any thread.

    Attributes:
        nonce: goes into the proof of the next command that needs the key.
    """

    def __init__(
        self,
        halt: HaltLatch,
        interrupt: Interrupt,
        knobs: LiveKnobs | None,
        calm: Callable[[Calmness], None] | None,
    ) -> None:
        self._lock = threading.Lock()
        self.nonce = secrets.token_hex(8)
        self._halt, self._interrupt, self._knobs, self._calm = halt, interrupt, knobs, calm

    def halt(self, by: str) -> None:
        """Halt; `by` is the name that the client gives itself."""
        self._halt.close(_plain(by) or "the fleet", "fleet")

    def obey(self, message: bytes, name: str = "", key: bytes | None = None) -> dict[str, str]:
        """Return the effect of a command, or why it has none. Never raises.

        `name`: of the head; `key`: of the fleet, which `KEYED` commands need; None where none is needed.
        """
        try:
            asked = json.loads(message[:_LONGEST], parse_int=whole_number) if len(message) <= _LONGEST else None
            if not isinstance(asked, dict) or asked.get("command") not in COMMANDS:
                raise ConfigError(f'no command: {{"command": ...}} with one of {", ".join(COMMANDS)}')
            if key is not None and asked["command"] in KEYED:
                self._check_proof(asked, name, key)
            self._do(asked["command"], asked)
        except (RobotError, ValueError, TypeError, RecursionError) as error:
            return {"error": (str(error).splitlines() or ["no command"])[0]}
        return {"done": asked["command"]}

    def _check_proof(self, asked: Mapping[str, Any], name: str, key: bytes) -> None:
        """Raise ConfigError unless `asked` comes from a holder of the key; the nonce is used up then."""
        with self._lock:
            wanted = proof(key, name, asked["command"], self.nonce)
            if not hmac.compare_digest(wanted.encode(), str(asked.get("proof")).encode()):
                raise ConfigError(
                    f"{asked['command']}: proof: expected the fleet's key (--fleet-key) and the last nonce"
                )
            self.nonce = secrets.token_hex(8)

    def _do(self, command: str, asked: Mapping[str, Any]) -> None:
        if command == "halt":
            self.halt(str(asked.get("by", "")))
        elif command == "resume":
            self._halt.resume("fleet")
        elif command == "end":
            self._interrupt.ask()
        elif command == "calm":
            calmness = parse(Calmness, _mapping(asked, "rates"), "calm")
            if self._calm is None:
                raise ConfigError("calm: this run's listener decides no events")
            self._calm(calmness)
        else:
            self._turn(asked)

    def _turn(self, asked: Mapping[str, Any]) -> None:
        if self._knobs is None:
            raise ConfigError("knobs: this run has none")
        for kind in KNOB_KINDS:
            for region, value in _mapping(asked, kind).items():
                if not isinstance(value, int | float):
                    raise ConfigError(f"knobs: {kind} of {region} = {value!r} is no number")
                setattr(self._knobs[region], kind, float(value))


class FleetHead(Observer):
    """`ports.Observer` that sends from a thread of its own.

    Args:
        name: of this head among others.
        document: returns the state that is sent.
        router: that joins the fleet.
        key: of the fleet (`fleet_key`); None: commands need none.

    Raises ConfigError, MissingExtra.
    """

    def __init__(
        self,
        name: str,
        document: Callable[[], Mapping[str, Any]],
        controls: FleetControls,
        router: Router = LOCAL,
        key: bytes | None = None,
    ) -> None:
        self._key = key
        self._name, self._document, self._controls = fleet_name(name), document, controls
        self._connection = Connection(session_config("call", router))
        self._changed = threading.Condition()
        self._news = self._over = False
        self._malformed = 0
        self._state: tuple[str, tuple[str, ...]] = ("", ())
        self._thread = threading.Thread(target=self._work, name="fleet", daemon=True)
        self._thread.start()

    def tick(self, seen: Tick) -> None:
        state = seen.state, seen.why
        if state != self._state:
            self._state = state
            with self._changed:
                self._news = True
                self._changed.notify()

    def close(self) -> None:
        """Idempotent; tells how it ended first."""
        with self._changed:
            self._over = True
            self._changed.notify()
        self._thread.join(TELL_S)
        self._connection.close()

    def _work(self) -> None:
        session = None
        while session is None:
            try:
                session = self._connection.wait(TELL_S)
            except RobotError as error:
                log.error("fleet: %s; the head goes on without", error)
                return
            if self._over:
                return
        key = f"{ROOT}/{self._name}"
        session.declare_queryable(f"{key}/state", lambda query: query.reply(f"{key}/state", self._told()))
        session.declare_queryable(f"{key}/command", self._on_query)
        session.declare_subscriber(f"{key}/command", lambda sample: self._obey(sample.payload.to_bytes()))
        session.declare_subscriber(f"{key}/halt", self._on_halt)
        while True:
            session.put(f"{key}/state", self._told())
            with self._changed:
                if self._over:
                    return
                self._changed.wait_for(lambda: self._news or self._over, TELL_S)
                self._news = False

    def _told(self) -> bytes:
        more = {"name": self._name, "nonce": self._controls.nonce, "malformed": self._malformed}
        return json.dumps({**self._document(), **more}, allow_nan=False).encode()

    def _on_query(self, query: zenoh.Query) -> None:
        answer = self._obey(b"" if query.payload is None else query.payload.to_bytes())
        query.reply(f"{ROOT}/{self._name}/command", json.dumps({"name": self._name, **answer}).encode())

    def _obey(self, message: bytes) -> dict[str, str]:
        answer = self._controls.obey(message, self._name, self._key)
        if "error" in answer:
            self._malformed += 1
            if self._malformed == 1:
                log.warning("fleet: %s/%s/command: %s (more are only counted)", ROOT, self._name, answer["error"])
        return answer

    def _on_halt(self, sample: zenoh.Sample) -> None:
        self._controls.halt(sample.payload.to_bytes()[:_LONGEST_NAME].decode(errors="replace"))


def _mapping(asked: Mapping[str, Any], key: str) -> dict[str, Any]:
    given = asked.get(key, {})
    if not isinstance(given, dict):
        raise ConfigError(f"{key} is no mapping")
    return given


def _plain(text: str) -> str:
    return "".join(each for each in text if each.isprintable())[:_LONGEST_NAME].strip()
