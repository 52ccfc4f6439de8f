"""Emergency stop: one latch that holds a set of causes and opens when all are cleared, and the switches that close it.

    close      from its next tick on the loop brakes every joint as fast as its limits allow, then holds or releases it
    resume     clears the causes that its door may clear; refused while a switch is still on

A door is the place that the request comes from: the device itself, the page or the fleet. A cause can be cleared from
the door that it names, or from the device. The table of causes is in docs/safety.md. If the loop does not answer within
`ANSWER_S`, the thread that waits for the answer switches torque off at once. The lock is held for assignments only,
never while anything is logged, read or sent.

Switches outside the program are a signal, a file that appears, and a line of a GPIO chip. A button of a GPIO line is
wired to ground: the line's own pull-up holds it high, and pressing it closes the latch. With `active-high` a rising
line closes the latch. GPIO works on Linux only: the chip is the character device `/dev/gpiochipN` (kernel 5.10 and
later; structures of <linux/gpio.h>, version 2). A file or line that is on keeps the latch closed. A file or line that
cannot be read counts as on.
"""

from __future__ import annotations

import logging
import os
import re
import select
import signal
import socket
import stat
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final, Literal

from sfms_robot.errors import ConfigError, HaltedError
from sfms_robot.ports import Bus
from sfms_robot.processes import start_thread

Door = Literal["device", "page", "fleet"]

ANSWER_S: Final = 0.1  # ten ticks at 100 Hz
MOST_CAUSES: Final = 16  # causes kept by name; limited because clients of a network choose the names
JOIN_S: Final = 1.0  # longest wait for a thread that is blocked in logging
FILE_PERIOD_S: Final = 0.05

_GET_LINE: Final = 0xC250B407  # _IOWR(0xB4, 0x07, struct gpio_v2_line_request)
_GET_VALUES: Final = 0xC010B40E  # _IOWR(0xB4, 0x0E, struct gpio_v2_line_values)
_ACTIVE_LOW, _INPUT, _EDGES, _PULL_UP = 1 << 1, 1 << 2, 3 << 4, 1 << 8  # edges: rising and falling
# offsets[64], consumer[32], config {flags, num_attrs, padding[5], attrs[10]}, num_lines, buffer size, padding[5], fd
_REQUEST: Final = struct.Struct("=I252x 32s Q260x4x I4x20x i")
_VALUES: Final = struct.Struct("=QQ")  # bits, mask
_EVENT: Final = struct.Struct("=QI36x")  # time stamp, 1: became active, 2: became inactive
_LINE: Final = re.compile(r"(?P<chip>/dev/gpiochip\d+):(?P<line>\d{1,9})(?P<high>,active-high)?")

Ioctl = Callable[[int, int, bytearray], Any]

log = logging.getLogger(__name__)


class HaltLatch:
    """The causes of an emergency stop. Closed and resumed from any thread, read by the loop in every tick.

    Attributes:
        causes: names of the causes, oldest first; empty while the latch is open.
        switches: by name, a function that returns whether the switch is on; called before every resume.
    """

    def __init__(self) -> None:
        self.causes: tuple[str, ...] = ()
        self.switches: dict[str, Callable[[], bool]] = {}
        self._changed = threading.Condition()
        self._closed: dict[tuple[str, Door], int] = {}  # (cause, door) -> number of its newest closing
        self._closings = 0
        self._answered = self._late = self._over = False

    @property
    def by(self) -> str | None:
        """All causes in one text; None while the latch is open."""
        return ", ".join(self.causes) or None

    def close(self, cause: str, cleared_by: Door = "device") -> None:
        """Close the latch. A cause that is present already is renewed: a resume in progress does not clear it."""
        key = cause, cleared_by
        with self._changed:
            if key not in self._closed:
                self._answered = False
                if len(self._closed) >= MOST_CAUSES:
                    key = "others", cleared_by
            self._closings += 1
            self._closed[key] = self._closings
            self._note()

    def resume(self, door: Door) -> None:
        """Clear the causes that `door` may clear (the device: all); the halt ends when no cause is left.

        Raises HaltedError, in one line that names the causes. While a switch is still on, or torque is being taken off,
        nothing is cleared. Otherwise the error names the remaining causes.
        """
        with self._changed:
            before = dict(self._closed)
            dead = self._late and not self._answered
        if dead:
            raise HaltedError(f"still halted by {self.by}: the loop does not answer, torque is off; end the run")
        active = [name for name, is_on in list(self.switches.items()) if is_on()]
        for name in active:
            self.close(name)
        if active:
            raise HaltedError(f"still halted: {', '.join(active)}: still on; release it, then resume")
        with self._changed:
            for cause, closing in before.items():
                if door in ("device", cause[1]) and self._closed.get(cause) == closing:
                    del self._closed[cause]
            left = list(self._closed)
            self._late = self._late and bool(left)
            self._note()
        if left:
            causes = ", ".join(f"{cause} (cleared at the {cleared_by})" for cause, cleared_by in left)
            raise HaltedError(f"still halted: {causes}")

    def answer(self) -> bool:
        """Record the answer of the loop; return whether torque was taken off before it."""
        with self._changed:
            self._answered = True
            self._changed.notify_all()
            return self._late

    @contextmanager
    def watched(self, bus: Bus) -> Iterator[None]:
        """Switch torque off if the loop does not answer in time, while the context is active."""
        thread = start_thread(self._watch, "halt", bus)
        try:
            yield
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()
            thread.join(JOIN_S)

    def _note(self) -> None:
        """Publish a change of the causes. The caller holds the lock."""
        self.causes = tuple(dict.fromkeys(cause for cause, _ in self._closed))
        self._changed.notify_all()

    def _unanswered(self) -> bool:
        return bool(self._closed) and not self._answered and not self._late

    def _watch(self, bus: Bus) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._over or self._unanswered())
                if self._over:
                    return
                if self._changed.wait_for(lambda: self._over or not self._unanswered(), ANSWER_S):
                    continue
                self._late = True
            bus.torque_off("release")
            log.critical("halted, and the loop does not answer: torque off")


@contextmanager
def halt_signals(latch: HaltLatch) -> Iterator[None]:
    """Close the latch on SIGUSR1 and resume on SIGUSR2, while the context is active.

    Main thread only; does nothing on Windows. Each handler only wakes a thread, so that neither a lock nor blocked
    logging stops the main thread.
    """
    if not hasattr(signal, "SIGUSR1"):
        yield
        return
    with (
        _on_signal(signal.SIGUSR1, lambda: latch.close("signal")),
        _on_signal(signal.SIGUSR2, partial(resume_here, latch)),
    ):
        yield


def resume_here(latch: HaltLatch) -> None:
    """Resume from the device, and log a refusal."""
    try:
        latch.resume("device")
    except HaltedError as refusal:
        log.warning("%s", refusal)


@contextmanager
def _on_signal(number: int, act: Callable[[], None]) -> Iterator[None]:
    """Call `act` in a thread for every signal, while the context is active."""
    came = SimpleQueue[bool]()  # reentrant: a handler may interrupt any code

    def work() -> None:
        while came.get():
            act()

    start_thread(work, "halt signal")
    before = signal.signal(number, lambda *_: came.put(True))
    try:
        yield
    finally:
        signal.signal(number, before)
        came.put(False)


@contextmanager
def halt_switch(where: str, latch: HaltLatch) -> Iterator[None]:
    """Watch the switch of `--halt-on FILE` or `--halt-on /dev/gpiochipN:LINE[,active-high]`.

    While the context is active, a thread waits for the switch, which closes the latch. Raises ConfigError for a file or
    line that cannot be watched, and for a switch that is on already.
    """
    if (line := _LINE.fullmatch(where)) is not None:
        with watching_line(open_line(line["chip"], int(line["line"]), line["high"] is None), where, latch):
            yield
    else:
        path = Path(where)
        if not path.parent.is_dir():
            raise ConfigError(f"--halt-on {where}: no such folder (FILE, or /dev/gpiochipN:LINE[,active-high])")
        is_there = partial(_is_there, path)
        if is_there():
            raise ConfigError(
                f"--halt-on {where}: exists already, or its folder cannot be read, so the head would halt at once"
            )
        with _watching(where, latch, is_there, is_there):
            yield


def _is_there(path: Path) -> bool:
    """Return whether the file exists; True also if its folder cannot be read."""
    try:
        path.stat()
    except FileNotFoundError:
        return not path.parent.is_dir()
    except OSError:
        pass
    return True


@contextmanager
def watching_line(line: GpioLine, name: str, latch: HaltLatch) -> Iterator[None]:
    """Close the latch when `line` becomes active, while the context is active; release the line at the end."""
    try:
        with _watching(name, latch, line.active, line.pressed, line.fd):
            yield
    finally:
        os.close(line.fd)


@contextmanager
def _watching(
    name: str, latch: HaltLatch, active: Callable[[], bool], pressed: Callable[[], bool], fd: int | None = None
) -> Iterator[None]:
    """Close the latch from a thread each time `pressed` returns true: when `fd` has an event, or periodically.

    `active` is called before every resume. A switch that cannot be read closes the latch, which then stays closed.
    """
    ours, theirs = socket.socketpair()  # `ours` is readable at the end; on Windows `select` accepts no pipe
    watched: list[Any] = [ours] if fd is None else [ours, fd]
    period_s = FILE_PERIOD_S if fd is None else None

    def work() -> None:
        try:
            while ours not in select.select(watched, [], [], period_s)[0]:
                if pressed():
                    latch.close(name)
        except OSError as error:
            latch.switches[name] = lambda: True
            latch.close(name)
            log.error("--halt-on %s: cannot be read: %s; end the run and look at the switch", name, error)

    latch.switches[name] = active
    thread = start_thread(work, "halt switch")
    try:
        yield
    finally:
        theirs.close()
        thread.join(JOIN_S)
        ours.close()
        del latch.switches[name]


@dataclass(frozen=True)
class GpioLine:
    """A line of a GPIO chip as input; its file descriptor has an event to read at each edge."""

    fd: int
    ioctl: Ioctl

    def active(self) -> bool:
        """Return whether the line is active; True if it cannot be read."""
        values = bytearray(_VALUES.pack(0, 1))
        try:
            self.ioctl(self.fd, _GET_VALUES, values)
        except OSError:
            return True
        return bool(_VALUES.unpack(values)[0] & 1)

    def pressed(self) -> bool:
        """Read one edge; return whether the line became active, however shortly, or is active. Raises OSError."""
        event = os.read(self.fd, _EVENT.size)
        if len(event) != _EVENT.size:
            raise OSError("the line has no events any more")
        return _EVENT.unpack(event)[1] == 1 or self.active()


def open_line(chip: str, line: int, active_low: bool = True, ioctl: Ioctl | None = None) -> GpioLine:
    """Open a line of a chip as input, with its pull-up if `active_low`.

    Raises ConfigError for a chip or line that cannot be used, and for a line that is active already.
    """
    if ioctl is None:
        import fcntl  # Linux only

        ioctl = fcntl.ioctl
    name = f"--halt-on {chip}:{line}"
    flags = _INPUT | _EDGES | (_ACTIVE_LOW | _PULL_UP if active_low else 0)
    request = bytearray(_REQUEST.pack(line, b"sfms-robot halt", flags, 1, 0))
    try:
        with open(chip, "rb", buffering=0) as file:
            if not stat.S_ISCHR(os.fstat(file.fileno()).st_mode):
                raise ConfigError(f"{name}: {chip} expected a character device (/dev/gpiochipN), got another file")
            ioctl(file.fileno(), _GET_LINE, request)
    except OSError as error:
        raise ConfigError(f"{name}: {error.strerror or error}") from error
    opened = GpioLine(int(_REQUEST.unpack(request)[-1]), ioctl)
    if opened.active():
        os.close(opened.fd)
        raise ConfigError(f"{name}: is active already, or cannot be read: the head would be halted at once")
    return opened
