"""What a service manager wants to know: ready, still alive, stopping (sd_notify(3), sd_watchdog_enabled(3)).

Datagrams of lines to the unix socket that NOTIFY_SOCKET names ("@" begins an abstract name). Where it names none,
nothing is said. WATCHDOG_USEC is how long silence may last; half of it is what systemd advises.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress
from typing import Final

from sfms_robot.ports import Observer, Tick

IDLE_S: Final = 1.0  # from one look at the time to the next, where no watchdog asks for more
_MOVING: Final = ("idle", "listening", "speaking", "degraded")


class ServiceManager:
    """Never raises: a run does not end because nobody takes its word.

    Attributes:
        wanted: whether anybody listens.
        every_s: how often `alive` is to be called.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        microseconds = environment.get("WATCHDOG_USEC", "")
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.wanted = bool(self._address)
        self._watched = bool(self._address) and microseconds.isdigit() and int(microseconds) > 0 and mine
        self.every_s = int(microseconds) / 2e6 if self._watched else IDLE_S

    def ready(self, status: str) -> None:
        """It does what it was started for."""
        self._say(f"READY=1\nSTATUS={status}")

    def alive(self) -> None:
        """To be called every `every_s`, by what must not hang."""
        if self._watched:
            self._say("WATCHDOG=1")

    def status(self, status: str) -> None:
        """One line, for `systemctl status`."""
        self._say(f"STATUS={status}")

    def stopping(self) -> None:
        """It ends on purpose."""
        self._say("STOPPING=1")

    def _say(self, lines: str) -> None:
        if not self._address:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.setblocking(False)
            sender.sendto(lines.encode(), address)


class NotifyingObserver(Observer):
    """`ports.Observer`: a run is ready when its joints are led into the face, and alive as long as it ticks.

    So a loop that hangs is started anew by the service manager, whatever else still runs.
    """

    def __init__(self, manager: ServiceManager) -> None:
        self._manager = manager
        self._next_s = 0.0
        self._ready = False
        self._said: tuple[str, tuple[str, ...]] | None = None

    def tick(self, seen: Tick) -> None:
        """At most one datagram in most ticks; it is never waited for."""
        if (seen.state, seen.why) != self._said:
            self._said = seen.state, seen.why
            words = ": ".join([seen.state, *([", ".join(seen.why)] if seen.why else [])])
            if not self._ready and seen.state in _MOVING:
                self._ready = True
                self._manager.ready(words)
            elif seen.state == "stopping":
                self._manager.stopping()
            else:
                self._manager.status(words)
        if seen.time_s >= self._next_s:
            self._next_s = seen.time_s + self._manager.every_s
            self._manager.alive()
