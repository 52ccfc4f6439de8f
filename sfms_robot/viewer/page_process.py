"""The page's server in a child process, so that visitors never cost the servo loop a tick.

    run -> page     the `Address`; then bytes: a packed picture, or (visitor, JSON): a document, with visitor 0 for all
    page -> run     (visitor, dict): a document; (visitor, bytes): the voice or face of a visitor; a sign of life every
                    `BEAT_S`

The run's side sends numbers and small documents. The child makes JSON of pictures, serves visitors, and sends back
their commands.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import orjson

from sfms_robot.data import Report
from sfms_robot.endpoint import LOOPBACK, host_and_port
from sfms_robot.errors import ConfigError, PortError, RobotError
from sfms_robot.processes import LIMITS, Child, Ended, Supervised

START_LIMIT_S: Final = 30.0  # importing on a small board with a cold disk
REPLAY_S: Final = 5.0  # time after the end of a run in which visitors may fetch /runs/last
CLOSE_LIMIT_S: Final = REPLAY_S + 3.0
BEAT_S: Final = 0.5
CHILD: Final = "sfms_robot.viewer.page_child:main"
PORT: Final = 8780
THREAD: Final = "page"  # names of the threads that a page has in the run's process


@dataclass(frozen=True)
class Address:
    """The address of the page: `--view [HOST:]PORT`, and the files of `--view-cert` and `--view-key` for https.

    Attributes:
        port: 0 for any free port; in place of a port that is taken, the next free one is used.
    """

    host: str = LOOPBACK
    port: int = PORT
    certificate: Path | None = None
    key: Path | None = None

    @classmethod
    def parsed(cls, wanted: str, certificate: Path | None = None, key: Path | None = None) -> Address:
        """Parse `wanted`: "auto", PORT or HOST:PORT. Raises ConfigError for another form, or missing files."""
        if (certificate is None) != (key is None):
            raise ConfigError("--view-cert and --view-key: https needs both (docs/guide/page.md says how to make them)")
        for flag, file in (("--view-cert", certificate), ("--view-key", key)):
            if file is not None and not file.is_file():
                raise ConfigError(f"{flag} {file}: no such file")
        place = (LOOPBACK, PORT) if wanted == "auto" else host_and_port(wanted)
        if place is None:
            raise ConfigError(f"--view {wanted}: not a TCP port (valid: PORT, HOST:PORT, 0 for a free one, none)")
        return cls(*place, certificate, key)


class Asked(Protocol):
    """The receiver of visitors' commands. Called in a thread of the page's; a RobotError is sent to the visitor."""

    def command(self, visitor: int, name: str, values: Report) -> None:
        """Carry out a command of the visitor with the controls."""

    def person(self, visitor: int, message: bytes) -> None:
        """Receive a piece of voice, or a face, of the visitor with the controls, as in docs/reference/protocol.md."""

    def left(self, visitor: int) -> None:
        """Record that a visitor has lost the controls."""


class PageProcess:
    """The run's side of the page. All methods from any thread; only `wait` and `close` block.

    Args:
        address: address to serve at; the child starts at once, and `wait` raises its errors.
        child: function that runs in the child, "module:function".

    Attributes:
        url: address of the page, with its token if it needs one.
        taken: port that was requested and is used by another program; None if it was free.
        visitors: number of visitors now.
        visited: set once the number of visitors has changed.
    """

    def __init__(self, address: Address, child: str = CHILD) -> None:
        self.url = ""
        self.taken: int | None = None
        self.visitors = 0
        self.visited = threading.Event()
        self._asked: Asked | None = None
        self._problem: RobotError | None = None
        self._bound = threading.Event()
        self._closing = False
        self._tasks = ThreadPoolExecutor(1, THREAD)
        self._supervised = Supervised(
            "page", LIMITS["page"], lambda: Child(child, address, name=THREAD, take=self._take)
        )

    @property
    def process_id(self) -> int:
        """Return the id of the server's process."""
        return self._supervised.child.process.pid

    def __str__(self) -> str:
        """Return the page's address, and the port that is taken, for people."""
        return self.url + ("" if self.taken is None else f" ({self.taken} is taken)")

    def wait(self) -> None:
        """Block until the page answers at its address. Raises PortError, ConfigError if it cannot."""
        if not self._bound.wait(START_LIMIT_S):
            self.close()
            raise PortError(f"--view: the page's process did not start within {START_LIMIT_S:g} s")
        if self._problem is not None:
            self.close()
            raise self._problem

    def answered_by(self, asked: Asked | None) -> None:
        """Pass commands of visitors on to `asked` from now on; None: refuse them."""
        self._asked = asked

    def watch(self, now_s: float) -> None:
        """Report once that the server hangs, and once that it is back. The run's loop calls it a few times a second."""
        self._supervised.check(now_s, self._supervised.child.gave_sign())

    def statistics(self) -> Report:
        """Return, for status and report, whether the server hangs now, and how often it has."""
        return {"hung": self._supervised.hung, "hangs": self._supervised.hangs}

    def show(self, record: bytes) -> None:
        """Send a packed picture; an older one that was not sent yet is left out."""
        self._supervised.child.offer(record)

    def keep(self, record: bytes) -> None:
        """Send a packed picture of a run that is over: all of them arrive, in order."""
        self._supervised.child.send(record)

    def say(self, do: str, visitor: int = 0, **values: Any) -> None:
        """Send one of `page_child`'s documents, in order."""
        self._supervised.child.send((visitor, orjson.dumps({"do": do, **values}, default=str)))

    def later(self, task: Callable[[], None]) -> None:
        """Run a task in a thread, because it is too long for a tick, such as making a document."""
        self._tasks.submit(task).add_done_callback(lambda done: done.result())  # an error goes to the log

    def close(self) -> None:
        """End the server; blocks for twice `CLOSE_LIMIT_S` at most. Idempotent."""
        self._closing = True
        self._tasks.shutdown()
        self._supervised.child.close(CLOSE_LIMIT_S)

    def _take(self, message: Any) -> None:
        if isinstance(message, Ended):
            self.visitors = 0
            if not self._closing:
                self._problem = self._problem or PortError("--view: the page's process died")
                if self._bound.is_set():
                    self._supervised.fail(f"its process died (exit code {message.code})")
            self._bound.set()
            return
        visitor, content = message
        if isinstance(content, bytes):
            self._pass_on(visitor, lambda asked: asked.person(visitor, content))
        elif "bound" in content:
            self.url, self.taken = content["bound"], content["taken"]
            self._supervised.enter("running")
            self._bound.set()
        elif "problem" in content:
            self._problem = (ConfigError if content["of"] == "ConfigError" else PortError)(content["problem"])
        elif "watched" in content:
            self.visitors = content["watched"]
            self.visited.set()
        elif "left" in content:
            self._pass_on(visitor, lambda asked: asked.left(visitor))
        else:
            self._pass_on(visitor, lambda asked: asked.command(visitor, content["command"], content["values"]))

    def _pass_on(self, visitor: int, do: Callable[[Asked], None]) -> None:
        asked = self._asked
        try:
            if asked is None:
                raise RobotError("no run is on")
            do(asked)
        except RobotError as error:
            self.say("error", visitor, error=str(error))
