"""The page's server in a process of its own: visitors cost the servo loop no tick.

Both directions are messages behind a header, over the child's stdin and stdout:

    uint32    length of what follows the header
    uint8     kind: P packed picture, J JSON, V a visitor's voice or face (from the child)
    uint32    number of a visitor, 0 for none

The run's side hands over numbers and small documents (`PipeWriter`). The child makes JSON of pictures, talks to
visitors, and sends back what they ask for, and a sign of life every `BEAT_S`. It ends with its pipe.
"""

from __future__ import annotations

import logging
import os
import select
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any, Final, Protocol

import orjson

from sfms_robot.child_process import end_child, start_child
from sfms_robot.endpoint import LOOPBACK, host_and_port
from sfms_robot.errors import ConfigError, PortError, RobotError

HEADER: Final = struct.Struct("<IBI")
PICTURE, DOCUMENT, PERSON = b"PJV"
START_LIMIT_S: Final = 30.0  # importing on a small board with a cold disk
CLOSE_LIMIT_S: Final = 1.0
BEAT_S: Final = 0.5
HUNG_S: Final = 2.5  # without a sign of life
_STEP_S: Final = 0.2  # a longer pause between two looks was the run's own
CHILD: Final = "sfms_robot.viewer.page_child:main"
PORT: Final = 8780
THREAD: Final = "page"  # names of the threads that a page has in the run's process
_LOOK_S: Final = 0.5  # at a pipe that is full, whether it is to be closed
_AT_ONCE: Final = os.name == "posix"  # elsewhere a pipe cannot be asked not to block

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Address:
    """Where the page is to be: `--view [HOST:]PORT`, and the files of `--view-cert` and `--view-key` for https.

    Attributes:
        port: 0 for any that is free; one that is taken makes room for the next that is free.
    """

    host: str = LOOPBACK
    port: int = PORT
    certificate: str | None = None
    key: str | None = None

    @classmethod
    def parsed(cls, wanted: str, certificate: Path | None = None, key: Path | None = None) -> Address:
        """`wanted`: "auto", PORT or HOST:PORT. Raises ConfigError for another form, or missing files."""
        if (certificate is None) != (key is None):
            raise ConfigError("--view-cert and --view-key: https needs both (docs/page.md says how to make them)")
        for flag, file in (("--view-cert", certificate), ("--view-key", key)):
            if file is not None and not file.is_file():
                raise ConfigError(f"{flag} {file}: no such file")
        files = (None if certificate is None else str(certificate), None if key is None else str(key))
        if wanted == "auto":
            return cls(LOOPBACK, PORT, *files)
        place = host_and_port(wanted)
        if place is None:
            raise ConfigError(f"--view {wanted}: is no TCP port (PORT, HOST:PORT; 0 for a free one, or none)")
        return cls(*place, *files)


class Asked(Protocol):
    """Who does what visitors ask for. Called in a thread of the page's; may raise RobotError, told to the visitor."""

    def command(self, visitor: int, name: str, values: Mapping[str, Any]) -> None: ...

    def person(self, visitor: int, message: bytes) -> None:
        """Take a piece of the voice, or a face, of the visitor with the controls: a message of docs/protocol.md."""

    def left(self, visitor: int) -> None:
        """Note that the visitor with the controls has them no more."""


class PageProcess:
    """The run's side. All methods from any thread; only the constructor's `wait` and `close` block.

    Attributes:
        url: where the page is, with its token where it needs one.
        visitors: how many look at it now.
        token: None on loopback.
        hung: it has shown no sign of life for `HUNG_S`; see `watch`.
    """

    def __init__(self, address: Address, child: str = CHILD) -> None:
        """Starts at once; `wait` says what came of it. `child`: what runs there, a "module:function"."""
        self.url = ""
        self.taken: int | None = None
        self.token: str | None = None
        self.visitors = 0
        self.visited = threading.Event()
        self.hung = self._alive = False  # `_alive`: set by the thread that reads
        self._hangs, self._silent_s, self._looked_s = 0, 0.0, 0.0
        self._asked: Asked | None = None
        self._problem: RobotError | None = None
        self._bound = threading.Event()
        self._process = start_child(child)
        self._closing = False
        assert self._process.stdin is not None
        self._writer = PipeWriter(self._process.stdin)
        self._writer.send(packed_message(DOCUMENT, 0, orjson.dumps(asdict(address))))
        self._reading = threading.Thread(target=self._read, name=THREAD, daemon=True)
        self._reading.start()

    @property
    def process_id(self) -> int:
        """Of the server."""
        return self._process.pid

    def __str__(self) -> str:
        """Where it is, for people."""
        return self.url + ("" if self.taken is None else f" ({self.taken} is taken)")

    def wait(self) -> None:
        """Block until it answers there. Raises PortError, ConfigError where it cannot."""
        if not self._bound.wait(START_LIMIT_S):
            self.close()
            raise PortError(f"--view: the page's process did not start within {START_LIMIT_S:g} s")
        if self._problem is not None:
            self.close()
            raise self._problem

    def answered_by(self, asked: Asked | None) -> None:
        """Who does from now on what visitors ask for; None: nobody, they are told so."""
        self._asked = asked

    def watch(self, now_s: float) -> None:
        """Name a server that hangs, once, and once when it is back. The run's loop calls it a few times a second."""
        step_s, self._looked_s = min(max(now_s - self._looked_s, 0.0), _STEP_S), now_s
        silent_s = 0.0 if self._alive or not self._reading.is_alive() else self._silent_s + step_s
        self._silent_s, self._alive = silent_s, False
        if (silent_s > HUNG_S) == self.hung:
            return
        self.hung = not self.hung
        if self.hung:
            self._hangs += 1
            log.warning("the page has not answered for %.1f s; the run continues", silent_s)
        else:
            log.info("the page answers again")

    def statistics(self) -> dict[str, Any]:
        """Return for status and report: whether it hangs now, and how often it has."""
        return {"hung": self.hung, "hangs": self._hangs}

    def show(self, record: bytes) -> None:
        """A packed picture; an older one that has not left yet is left out."""
        self._writer.send_newest(packed_message(PICTURE, 0, record))

    def keep(self, record: bytes) -> None:
        """A packed picture of a run that is over: all of them arrive, in order."""
        self._writer.send(packed_message(PICTURE, 0, record))

    def say(self, do: str, visitor: int = 0, **values: Any) -> None:
        """One of `page_child`'s documents, in order."""
        self._writer.send(packed_message(DOCUMENT, visitor, orjson.dumps({"do": do, **values}, default=str)))

    def later(self, task: Callable[[], None]) -> None:
        """Have the thread that sends do what takes longer than a tick has, such as putting a document together."""
        self._writer.later(task)

    def close(self) -> None:
        """End the server; blocks for twice `CLOSE_LIMIT_S` at most. Idempotent."""
        self._closing = True
        self._writer.close()
        end_child(self._process, CLOSE_LIMIT_S)

    def _read(self) -> None:
        pipe = self._process.stdout
        assert pipe is not None
        with pipe:
            while (message := read_message(pipe)) is not None:
                self._alive = True
                self._take(*message)
        self.visitors = 0
        if not self._closing:
            self._problem = self._problem or PortError("--view: the page's process died")
            if self._bound.is_set():
                log.warning("the page is away: its process died (exit code %s); the run goes on", self._process.wait())
        self._bound.set()

    def _take(self, kind: int, visitor: int, data: bytes) -> None:
        if kind == PERSON:
            self._heed(visitor, lambda asked: asked.person(visitor, data))
            return
        told = orjson.loads(data)
        if "bound" in told:
            self.url, self.token, self.taken = told["bound"], told["token"], told["taken"]
            self._bound.set()
        elif "problem" in told:
            self._problem = (ConfigError if told["of"] == "ConfigError" else PortError)(told["problem"])
        elif "watched" in told:
            self.visitors = told["watched"]
            self.visited.set()
        elif "alive" in told:
            pass  # counted already
        elif "left" in told:
            self._heed(visitor, lambda asked: asked.left(visitor))
        else:
            self._heed(visitor, lambda asked: asked.command(visitor, told["command"], told["values"]))

    def _heed(self, visitor: int, do: Callable[[Asked], None]) -> None:
        asked = self._asked
        try:
            if asked is None:
                raise RobotError("no run is on")
            do(asked)
        except RobotError as error:
            self.say("error", visitor, error=str(error))


def packed_message(kind: int, visitor: int, data: bytes) -> bytes:
    """With its header."""
    return HEADER.pack(len(data), kind, visitor) + data


def read_message(pipe: IO[bytes]) -> tuple[int, int, bytes] | None:
    """(kind, visitor, data); None at the end of the pipe. Blocks until it is whole."""
    header = pipe.read(HEADER.size)
    if len(header) < HEADER.size:
        return None
    length, kind, visitor = HEADER.unpack(header)
    data = pipe.read(length)
    return None if len(data) < length else (kind, visitor, data)


class PipeWriter:
    """A pipe to another process, for a loop that may wait for nothing.

    A picture is written at once, by the thread that hands it over: some microseconds, and no other thread that would
    have to get the interpreter in the middle of a tick. Where the pipe is full or something waits already, a thread
    sends it, of pictures the newest. Everything else waits in order for that thread. All methods may be called from any
    thread; none blocks. Messages that cannot be sent since the other process died are dropped.

    Args:
        pipe: its writing end; closed by the thread in the end.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._waiting: deque[bytes] = deque()
        self._tasks: deque[Callable[[], None]] = deque()
        self._picture: bytes | None = None
        self._unsent = b""  # of a message that the pipe has taken the beginning of
        self._changed = threading.Condition()
        self._closing = self._broken = False
        if _AT_ONCE:
            os.set_blocking(pipe.fileno(), False)
        threading.Thread(target=self._work, name=THREAD, daemon=True).start()

    def send(self, message: bytes) -> None:
        """In order, whole."""
        with self._changed:
            self._waiting.append(message)
            self._changed.notify()

    def send_newest(self, picture: bytes) -> None:
        """Instead of an older one that has not left yet."""
        if not self._changed.acquire(blocking=False):
            self._picture = picture  # the thread is at it, and finds it now or beside the next one
            return
        try:
            if _AT_ONCE and not (self._unsent or self._waiting or self._picture is not None):
                self._unsent = self._taken(picture)
                waits = bool(self._unsent)
            else:
                self._picture, waits = picture, True
            if waits:
                self._changed.notify()
        finally:
            self._changed.release()

    def later(self, task: Callable[[], None]) -> None:
        """Have the thread do something that takes longer than a tick has."""
        with self._changed:
            self._tasks.append(task)
            self._changed.notify()

    def close(self) -> None:
        """Once everything has been sent that waits now."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    def _work(self) -> None:
        with self._pipe:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._closing or self._something())
                    if self._broken or (self._closing and not self._something()):
                        return
                    tasks = [*self._tasks]
                    self._tasks.clear()
                for task in tasks:
                    task()
                with self._changed:
                    self._unsent = self._taken(self._unsent or self._next())
                    full = bool(self._unsent)
                if full:
                    select.select([], [self._pipe], [], _LOOK_S)

    def _something(self) -> bool:
        return bool(self._unsent or self._waiting or self._tasks or self._picture is not None)

    def _next(self) -> bytes:
        """All that waits, the newest picture behind it."""
        messages = [*self._waiting, *([] if self._picture is None else [self._picture])]
        self._waiting.clear()
        self._picture = None
        return b"".join(messages)

    def _taken(self, message: bytes) -> bytes:
        """What the pipe has not taken of it."""
        try:
            return message[os.write(self._pipe.fileno(), message) :] if message and not self._broken else b""
        except BlockingIOError:
            return message
        except (OSError, ValueError):
            self._broken = True  # its reader died: who reads from it sees that too, and says so
            return b""
