"""Sessions of zenoh (zenoh.io), which carries the messages between robots and servers.

Without a configuration everything stays on this machine: a server listens on 127.0.0.1:7447, a robot connects there,
without multicast scouting. A file of zenoh's own form (JSON5: endpoints, TLS, access control)
replaces all that; docs/guide/remote.md has one for TLS with certificates of both sides. An endpoint that is neither
on loopback nor encrypted needs `--insecure`.
"""

from __future__ import annotations

import json
import re
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from sfms_robot.endpoint import is_loopback
from sfms_robot.errors import ConfigError, PortError, optional

if TYPE_CHECKING:
    import zenoh

PORT: Final = 7447  # zenoh's own
LOOPBACK: Final = f"tcp/127.0.0.1:{PORT}"
LEASE_MS: Final = 2000  # a link that is silent for so long is dead, and is opened again
QUEUE: Final = 16  # messages that wait for a busy machine, the most that zenoh takes; with its own 2 frames are lost
RETRY: Final = {"period_init_ms": 250, "period_max_ms": 250, "period_increase_factor": 1.0}
AWAY_S: Final = 5.0  # without a router, after which that is reported
SAFE: Final = ("tls", "quic", "unixsock-stream", "unixpipe", "serial", "vsock")  # encrypted, or not a network

Role = Literal["serve", "call"]


@dataclass(frozen=True)
class Router:
    """The router that a session connects to, or is.

    Attributes:
        file: zenoh's configuration; None for loopback.
        insecure: allow endpoints beyond loopback without TLS.
    """

    file: Path | None = None
    insecure: bool = False

    def __str__(self) -> str:
        return LOOPBACK if self.file is None else f"the endpoints of {self.file}"


LOCAL: Final = Router()


def check_zenoh() -> None:
    """Raise MissingExtra where zenoh is not installed."""
    with optional("listening from another machine"):
        import zenoh  # noqa: F401


def check_name(name: str, what: str) -> str:
    """Return `name`, which becomes a part of keys. Raises ConfigError for one that cannot."""
    if not re.fullmatch(r"[\w.-]+", name, re.ASCII):
        raise ConfigError(f"{what}: expected a name of letters, digits, '-', '_' and '.', got {name!r}")
    return name


def session_config(role: Role, router: Router = LOCAL, endpoint: str | None = None) -> zenoh.Config:
    """Return how a session connects: as the router's file says, else on loopback, else at `endpoint`.

    Raises ConfigError for a file or an endpoint that zenoh does not take, or that anyone on the network could use;
    MissingExtra without zenoh.
    """
    check_zenoh()
    import zenoh

    if (file := router.file) is not None:
        if not file.is_file():
            raise ConfigError(f"{file}: no such file (a configuration of zenoh, JSON5)")
        try:
            given = zenoh.Config.from_file(str(file))
        except Exception as error:  # zenoh raises its own and plain exceptions alike
            raise ConfigError(f"{file}: zenoh cannot use it: {_first_line(error)}") from error
        if not router.insecure:
            _check_secure(given, file)
        return given
    where = [endpoint or LOOPBACK]
    settings: dict[str, Any] = {
        "mode": "router" if role == "serve" else "client",
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "connect/retry": RETRY,
        "transport/link/tx/queue/size/real_time": QUEUE,
        "listen/endpoints": where if role == "serve" else [],
        "connect/endpoints": [] if role == "serve" else where,
    }
    if role == "call":
        settings["connect/timeout_ms"] = -1  # for ever; `Connection` waits in a thread
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except Exception as error:
            raise ConfigError(f"zenoh endpoint {endpoint!r}: {_first_line(error)}") from error
    return config


def _check_secure(config: zenoh.Config, file: Path) -> None:
    """Raise ConfigError for an endpoint beyond loopback without TLS, and for multicast that may find one."""
    mode = json.loads(config.get_json("mode")) or "peer"
    found: list[tuple[str, str]] = []
    for key in ("listen", "connect"):
        endpoints = json.loads(config.get_json(f"{key}/endpoints"))
        if isinstance(endpoints, dict):
            endpoints = endpoints.get(mode, [])
        found += [(f"{key}.endpoints", each) for each in endpoints if not _is_secure(each)]
    looks = json.loads(config.get_json("scouting/multicast/enabled")) is not False
    if looks and not (mode == "client" and endpoints):
        found.append(("scouting.multicast.enabled", "true"))
    if found:
        raise ConfigError(
            f"{file}: {found[0][0]}: expected loopback or TLS, got {found[0][1]}: "
            "see TLS in docs/guide/remote.md, or --insecure on a network that you trust"
        )


def _is_secure(endpoint: str) -> bool:
    protocol, _, address = endpoint.partition("/")
    host = re.split("[?#]", address)[0].rpartition(":")[0].strip("[]")
    return protocol in SAFE or host == "localhost" or is_loopback(host)


def serve_session(config: zenoh.Config) -> zenoh.Session:
    """Open a session that others connect to. Raises PortError where it cannot listen."""
    import zenoh

    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise PortError(f"zenoh cannot listen: {_first_line(error)}") from error


def close_session(session: Any) -> None:
    """Close a session. Idempotent. (`Any`: zenoh declares no types.)"""
    session.close()


class Connection:
    """A session that is being opened in a thread, for as long as its router is away.

    Attributes:
        problem: why it cannot be opened; None as long as it may.
    """

    def __init__(self, config: zenoh.Config) -> None:
        self._config = config
        self._session: zenoh.Session | None = None
        self._changed = threading.Condition()
        self._closed = False
        self.problem: str | None = None
        threading.Thread(target=self._open, name="zenoh", daemon=True).start()

    @property
    def session(self) -> zenoh.Session | None:
        """The session; None while no router answers."""
        return self._session

    def wait(self, limit_s: float) -> zenoh.Session | None:
        """Wait for the session; return None when it is not open by then. Raises PortError when it cannot be opened."""
        with self._changed:
            self._changed.wait_for(lambda: self._session is not None or self.problem is not None, limit_s)
        if self.problem is not None:
            raise PortError(self.problem)
        return self._session

    def close(self) -> None:
        """Close the session, at once or when it opens. Idempotent."""
        with self._changed:
            self._closed = True
            session, self._session = self._session, None
        if session is not None:
            close_session(session)

    def _open(self) -> None:
        import zenoh

        try:
            session = zenoh.open(self._config)
        except zenoh.ZError as error:
            with self._changed:
                self.problem = f"zenoh cannot connect: {_first_line(error)}"
                self._changed.notify_all()
            return
        with self._changed:
            if not self._closed:
                self._session = session
            self._changed.notify_all()
        if self._closed:
            close_session(session)


def _first_line(error: BaseException) -> str:
    """Return the message of zenoh, without the places in its source."""
    text = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return text.partition(" at /")[0].rstrip(".")
