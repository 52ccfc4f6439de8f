"""Sessions of zenoh (zenoh.io), which carries the messages between robots and servers.

Without a configuration everything stays on this machine: a server listens on 127.0.0.1:7447, a robot connects there,
without multicast scouting. A configuration file of zenoh (JSON5: endpoints, TLS, access control) replaces all these
settings; docs/guide/remote.md has one for TLS with certificates of both sides. An endpoint that is neither on loopback
nor encrypted needs `--insecure`.
"""

from __future__ import annotations

import json
import logging
import os
import re
import secrets
import struct
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from sfms_robot.endpoint import is_loopback, port_number
from sfms_robot.errors import ConfigError, PortError, RobotError, Said, first_line, optional

if TYPE_CHECKING:
    import zenoh

PORT: Final = 7447  # zenoh's default
LOOPBACK: Final = f"tcp/127.0.0.1:{PORT}"
LEASE_MS: Final = 2000  # a link that is silent for this long counts as dead, and is opened again
QUEUE: Final = 16  # messages queued for a busy machine, zenoh's maximum; with its default of 2, frames are lost
RETRY: Final = {"period_init_ms": 250, "period_max_ms": 250, "period_increase_factor": 1.0}
AWAY_S: Final = 5.0  # time without a router, after which that is reported
SAFE: Final = ("tls", "quic", "unixsock-stream", "unixpipe", "serial", "vsock")  # encrypted, or not a network

Role = Literal["serve", "call"]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Router:
    """The router that a session connects to, or acts as.

    Attributes:
        file: configuration file of zenoh; None for loopback.
        insecure: allow endpoints beyond loopback without TLS.
    """

    file: Path | None = None
    insecure: bool = False

    def __str__(self) -> str:
        return LOOPBACK if self.file is None else f"the endpoints of {self.file}"


LOCAL: Final = Router()


def check_zenoh() -> None:
    """Raise MissingExtra where zenoh is not installed."""
    with optional("a network of other machines, or of ROS 2,"):
        import zenoh  # noqa: F401


def check_name(name: str, what: str) -> str:
    """Return `name`, which becomes a part of keys. Raises ConfigError for a name that cannot be one."""
    if not re.fullmatch(r"[\w.-]+", name, re.ASCII):
        raise ConfigError(f"{what}: expected a name of letters, digits, '-', '_' and '.', got {name!r}")
    return name


def session_config(role: Role, router: Router = LOCAL) -> zenoh.Config:
    """Return the configuration of a session: that of the router's file, else loopback.

    Raises ConfigError for a file that zenoh rejects, or that admits anyone on the network; MissingExtra without
    zenoh.
    """
    check_zenoh()
    import zenoh

    if (file := router.file) is not None:
        if not file.is_file():
            raise ConfigError(f"{file}: no such file (a configuration of zenoh, JSON5)")
        try:
            given = zenoh.Config.from_file(str(file))
        except Exception as error:  # zenoh raises both its own and plain exceptions
            raise ConfigError(f"{file}: zenoh cannot use it: {_first_line(error)}") from error
        if not router.insecure:
            _check_secure(given, file)
        return given
    serves = role == "serve"
    settings = {
        "mode": "router" if serves else "client",
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "connect/retry": RETRY,
        "transport/link/tx/queue/size/real_time": QUEUE,
        "listen/endpoints": [LOOPBACK] if serves else [],
        "connect/endpoints": [] if serves else [LOOPBACK],
    }
    if not serves:
        settings["connect/timeout_ms"] = -1  # no limit; `Connection` waits in a thread
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
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
    """A session that is opened in a thread, which waits for as long as the router is unreachable.

    Attributes:
        session: None while no router answers.
        problem: reason why it cannot be opened; None as long as it may still open.

    `begin` is called with the session in that thread, before `session` is set.
    """

    def __init__(self, config: zenoh.Config, begin: Callable[[zenoh.Session], None] = lambda session: None) -> None:
        self._config, self._begin = config, begin
        self.session: zenoh.Session | None = None
        self._changed = threading.Condition()
        self._closed = False
        self.problem: str | None = None
        threading.Thread(target=self._open, name="zenoh", daemon=True).start()

    def wait(self, limit_s: float) -> zenoh.Session | None:
        """Wait for the session; return None if it is not open in time. Raises PortError if it cannot be opened."""
        with self._changed:
            self._changed.wait_for(lambda: self.session is not None or self.problem is not None, limit_s)
        if self.problem is not None:
            raise PortError(self.problem)
        return self.session

    def close(self) -> None:
        """Close the session, at once or when it opens. Idempotent."""
        with self._changed:
            self._closed = True
            session, self.session = self.session, None
        if session is not None:
            close_session(session)

    def _open(self) -> None:
        import zenoh

        try:
            session = zenoh.open(self._config)
            self._begin(session)
        except zenoh.ZError as error:
            with self._changed:
                self.problem = f"zenoh cannot connect: {_first_line(error)}"
                self._changed.notify_all()
            return
        with self._changed:
            if not self._closed:
                self.session = session
            self._changed.notify_all()
        if self._closed:
            close_session(session)


def _first_line(error: BaseException) -> str:
    """Return the first line of a message of zenoh, without the places in its source."""
    return first_line(error).partition(" at /")[0].rstrip(".")


# --- ROS 2 ------------------------------------------------------------------------------------------------------------

MOST_DOMAIN: Final = 232
ROUTER_OF_ROS: Final = "ros2 run rmw_zenoh_cpp rmw_zenohd"
_QOS: Final = "::,10:,:,:,,"  # all defaults: reliable, volatile, the last ten messages


def ros_domain(text: str, flag: str) -> int:
    """Return the domain in `text`, else in ROS_DOMAIN_ID, else 0. Raises ConfigError."""
    given = text or os.environ.get("ROS_DOMAIN_ID", "") or "0"
    domain = port_number(given)
    if domain is None or domain > MOST_DOMAIN:
        raise ConfigError(
            f"{flag}: {'domain' if text else 'ROS_DOMAIN_ID'}: expected 0 to {MOST_DOMAIN}, got {given!r}"
        )
    return domain


def ros_topic(text: str, flag: str) -> str:
    """Return a topic with its leading slash. Raises ConfigError for a text that is not a topic of ROS."""
    topic = "/" + text.removeprefix("/")
    if not re.fullmatch(r"(/\w+)+", topic, re.ASCII):
        raise ConfigError(f"{flag}: expected a topic such as /audio (letters, digits, '_', '/'), got {text!r}")
    return topic


class Ros2Node:
    """A ROS 2 node that speaks the protocol of its middleware rmw_zenoh (docs/design.md of github.com/ros2/rmw_zenoh).

        message    DOMAIN/TOPIC/TYPE/HASH; attached: i64 number, i64 time in ns, u8 16, 16 bytes that name the sender
        presence   @ros2_lv/DOMAIN/SESSION/NODE/ENTITY/NN|MP|MS/ENCLAVE/NAMESPACE/NAME[/TOPIC/TYPE/HASH/QOS]

    TOPIC is written without its first slash in the former, and with % for each slash in the latter. TYPE/HASH is called
    "wire name" here (`signals.ros2_messages`). Only `wait` blocks; zenoh finds a lost router again.

    Args:
        name: name of the node, also used in logs.
        sends, takes: wire name by topic, of published and of subscribed topics.
        received: called in a thread of zenoh with topic, wire name and bytes of each message, of any type. A RobotError
            that it raises is logged, each reason once.
        limit_s: time without a router after which connecting fails for good; None: no limit.

    Attributes:
        counts: numbers of messages sent, received and refused.
    """

    def __init__(
        self,
        name: str,
        domain: int,
        router: Router,
        *,
        sends: Mapping[str, str] | None = None,
        takes: Mapping[str, str] | None = None,
        received: Callable[[str, str, bytes], object] = lambda topic, wire, data: None,
        limit_s: float | None = None,
    ) -> None:
        self.name, self.domain, self.where = name, domain, str(router)
        self._sends, self._takes, self._received = dict(sends or {}), dict(takes or {}), received
        self.counts = {"sent": 0, "received": 0, "refused": 0}
        self._numbers = dict.fromkeys(self._sends, 0)
        self._gid = b"\x10" + secrets.token_bytes(16)
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._seen = set[tuple[str, str]]()  # topic and domain of the publishers that are present
        self._said = Said()
        self._kept: list[Any] = []  # declared tokens and subscribers, kept as long as the node
        config = session_config("call", router)
        config.insert_json5("connect/timeout_ms", "-1" if limit_s is None else str(round(1e3 * limit_s)))
        self._connection = Connection(config, self._declare)

    def wait(self, limit_s: float) -> bool:
        """Wait for a router; return whether the node is connected. Raises PortError if connecting failed for good."""
        self._connection.wait(limit_s)
        return self.connected

    @property
    def connected(self) -> bool:
        """True while the node is linked to a router."""
        session = self._connection.session
        return session is not None and bool(list(session.info.routers_zid()))

    def matched(self, topic: str) -> bool:
        """Return whether a topic of `sends` has a subscriber now."""
        if (publisher := self._publishers.get(topic)) is None:
            return False
        return bool(getattr(publisher.matching_status, "matching", False))  # an object, though declared as bool

    def publish(self, topic: str, data: bytes, time_ns: int) -> None:
        """Send a message on a topic of `sends`; without a router it is dropped."""
        if (publisher := self._publishers.get(topic)) is not None:
            self._numbers[topic] += 1
            self.counts["sent"] += 1
            publisher.put(data, attachment=struct.pack("<qq", self._numbers[topic], time_ns) + self._gid)

    def absence(self, topic: str) -> str:
        """Return, in one line, why a topic of `takes` may have received nothing, and what to do."""
        if not self.connected:
            return f"no router at {self.where} ({ROUTER_OF_ROS}; another by --zenoh FILE)"
        domains = {domain for seen, domain in self._seen.copy() if seen == topic}
        if str(self.domain) in domains:
            return f"{topic} has a publisher in domain {self.domain}, which sends nothing"
        others = f"; one is in domain {', '.join(sorted(domains))} (,domain=N or ROS_DOMAIN_ID)" if domains else ""
        return f"no publisher of {topic} in domain {self.domain}{others}"

    def close(self) -> None:
        """Leave the ROS graph. Idempotent."""
        self._connection.close()

    def _declare(self, session: zenoh.Session) -> None:
        """Declare the node, its publishers and its subscribers."""
        import zenoh

        def token(kind: str, entity: int, *more: str) -> None:
            self._kept.append(live.declare_token("/".join([*begin, str(entity), kind, "%", "%", self.name, *more])))

        live, begin = session.liveliness(), ["@ros2_lv", str(self.domain), str(session.info.zid()), "0"]
        token("NN", 0)
        for entity, (topic, wire) in enumerate(self._sends.items(), 1):
            token("MP", entity, topic.replace("/", "%"), wire, _QOS)
            key = f"{self.domain}{topic}/{wire}"
            drop = zenoh.CongestionControl.DROP
            self._publishers[topic] = session.declare_publisher(key, congestion_control=drop)
        for entity, (topic, wire) in enumerate(self._takes.items(), 1 + len(self._sends)):
            mangled = topic.replace("/", "%")
            token("MS", entity, mangled, wire, _QOS)
            # Any type and hash is subscribed, so that a wrong one is reported.
            self._kept.append(session.declare_subscriber(f"{self.domain}{topic}/*/*", partial(self._take, topic)))
            others, note = f"@ros2_lv/*/*/*/*/MP/*/*/*/{mangled}/**", partial(self._note_publisher, topic)
            self._kept.append(live.declare_subscriber(others, note, history=True))

    def _note_publisher(self, topic: str, sample: zenoh.Sample) -> None:
        import zenoh

        known = topic, str(sample.key_expr).split("/")[1]
        (self._seen.add if sample.kind == zenoh.SampleKind.PUT else self._seen.discard)(known)

    def _take(self, topic: str, sample: zenoh.Sample) -> None:
        try:
            self._received(topic, "/".join(str(sample.key_expr).split("/")[-2:]), sample.payload.to_bytes())
        except RobotError as error:
            self._say(topic, str(error))
            self.counts["refused"] += 1
        self.counts["received"] += 1  # last, so that a counted message was processed or refused

    def _say(self, topic: str, reason: str) -> None:
        if self._said.first(topic + reason):
            log.warning("%s: %s: left out: %s (said once)", self.name, topic, reason)
