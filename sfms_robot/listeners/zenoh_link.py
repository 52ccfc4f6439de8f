"""How a robot reaches a served listener: keys of zenoh (`remote.Link`).

    sfms/listen/NAME/join           asked (a query) with Join, answered with Welcome or Refusal
    sfms/listen/NAME/STREAM/up      frames, and notices, from the robot
    sfms/listen/NAME/STREAM/down    plans, and notices, to it

Frames and plans are never waited for: what the network does not take at once is dropped, since a newer one follows.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.network import LOCAL, Connection, Router, session_config

if TYPE_CHECKING:
    import zenoh

ROOT: Final = "sfms/listen"
ANSWER_S: Final = 2.0  # that an asking may take
MOST_RECEIVED: Final = 1000  # messages that nobody has taken yet; the oldest are dropped


def join_key(name: str) -> str:
    return f"{ROOT}/{name}/join"


def up_key(name: str, stream: str) -> str:
    return f"{ROOT}/{name}/{stream}/up"


def down_key(name: str, stream: str) -> str:
    return f"{ROOT}/{name}/{stream}/down"


class ZenohLink:
    """`remote.Link` to the listener that is served as `name`."""

    def __init__(self, name: str, router: Router = LOCAL) -> None:
        self._name = name
        self._where = str(router)
        self._connection = Connection(session_config("call", router))
        self._received: deque[tuple[float, bytes]] = deque(maxlen=MOST_RECEIVED)
        self._lock = threading.Lock()
        self._publisher: zenoh.Publisher | None = None
        self._subscriber: Any = None

    @property
    def where(self) -> str:
        return self._where

    @property
    def problem(self) -> str | None:
        return self._connection.problem

    def ask(self, message: bytes) -> None:
        session = self._connection.session
        if session is not None:
            session.get(join_key(self._name), self._on_reply, payload=message, timeout=ANSWER_S)

    def follow(self, stream: str) -> None:
        import zenoh

        session = self._connection.session
        if session is None:
            return
        self._unfollow()
        self._subscriber = session.declare_subscriber(down_key(self._name, stream), self._on_sample)
        self._publisher = session.declare_publisher(
            up_key(self._name, stream),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,  # not gathered into larger packets: that would take time
        )

    def send(self, message: bytes) -> None:
        if self._publisher is not None:
            self._publisher.put(message)

    def received(self) -> Sequence[tuple[float, bytes]]:
        now_s = time.monotonic()
        with self._lock:
            taken = [(now_s - came_s, message) for came_s, message in self._received]
            self._received.clear()
        return taken

    def close(self) -> None:
        """Idempotent."""
        self._unfollow()
        self._connection.close()

    def _unfollow(self) -> None:
        for declared in (self._publisher, self._subscriber):
            if declared is not None:
                declared.undeclare()
        self._publisher = self._subscriber = None

    def _on_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._on_sample(reply.ok)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self._received.append((time.monotonic(), sample.payload.to_bytes()))
