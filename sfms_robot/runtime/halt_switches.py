"""What closes the halt latch from outside the program: a signal, a file that appears, or a line of a GPIO chip.

A button of a GPIO line is wired to ground: the line's own pull-up holds it high, and pressing it closes the latch. With
`active-high` a line that rises does. Linux only: the chip is `/dev/gpiochipN`, by its character device (kernel 5.10 and
later; structures of <linux/gpio.h>, version 2).
"""

from __future__ import annotations

import os
import re
import select
import signal
import stat
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

from sfms_robot.errors import ConfigError
from sfms_robot.runtime.halt import HaltLatch

FILE_PERIOD_S: Final = 0.05

_GET_LINE: Final = 0xC250B407  # _IOWR(0xB4, 0x07, struct gpio_v2_line_request)
_GET_VALUES: Final = 0xC010B40E  # _IOWR(0xB4, 0x0E, struct gpio_v2_line_values)
_ACTIVE_LOW, _INPUT, _RISING, _PULL_UP = 1 << 1, 1 << 2, 1 << 4, 1 << 8
# offsets[64], consumer[32], config {flags, num_attrs, padding[5], attrs[10]}, num_lines, buffer size, padding[5], fd
_REQUEST: Final = struct.Struct("=I252x 32s Q260x4x I4x20x i")
_VALUES: Final = struct.Struct("=QQ")  # bits, mask
_EVENT_BYTES: Final = 48  # struct gpio_v2_line_event
_LINE: Final = re.compile(r"(?P<chip>/dev/gpiochip\d+):(?P<line>\d{1,9})(?P<high>,active-high)?")

Ioctl = Callable[[int, int, bytearray], Any]


@contextmanager
def halt_signals(latch: HaltLatch) -> Iterator[None]:
    """SIGUSR1 closes the latch while inside, SIGUSR2 opens it. Main thread only; nothing where there are no such."""
    if not hasattr(signal, "SIGUSR1"):
        yield
        return
    before = [
        (number, signal.signal(number, handler))
        for number, handler in (
            (signal.SIGUSR1, lambda *_: latch.close("signal")),
            (signal.SIGUSR2, lambda *_: latch.open()),
        )
    ]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)


@contextmanager
def halt_switch(where: str, latch: HaltLatch) -> Iterator[None]:
    """`--halt-on FILE` or `--halt-on /dev/gpiochipN:LINE[,active-high]`: closes the latch while inside.

    A thread waits for it. Raises ConfigError for what cannot be watched, and for a switch that is on already.
    """
    if (line := _LINE.fullmatch(where)) is not None:
        with watching_line(open_line(line["chip"], int(line["line"]), line["high"] is None), where, latch):
            yield
    else:
        path = Path(where)
        if not path.parent.is_dir():
            raise ConfigError(f"--halt-on {where}: no such folder (FILE, or /dev/gpiochipN:LINE[,active-high])")
        if path.exists():
            raise ConfigError(f"--halt-on {where}: is there already: the head would be halted at once (remove it)")
        with _watching(partial(_wait_for_file, path), where, latch):
            yield


@contextmanager
def watching_line(line: int, name: str, latch: HaltLatch) -> Iterator[None]:
    """A line that `open_line` gave closes the latch while inside, and is closed itself at the end."""
    try:
        with _watching(partial(_wait_for_line, line), name, latch):
            yield
    finally:
        os.close(line)


@contextmanager
def _watching(wait: Callable[[int], bool], name: str, latch: HaltLatch) -> Iterator[None]:
    """`wait(over)` in a thread, again and again; each time it says True the latch closes."""
    ours, theirs = os.pipe()  # readable once it is over

    def work() -> None:
        while wait(ours):
            latch.close(name)

    thread = threading.Thread(target=work, name="halt switch", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.close(theirs)
        thread.join()
        os.close(ours)


def _wait_for_file(path: Path, over: int) -> bool:
    """Until the file appears (True), or it is over. One that stays counts again and again, which a latch ignores."""
    while not select.select([over], [], [], FILE_PERIOD_S)[0]:
        if path.exists():
            return True
    return False


def _wait_for_line(line: int, over: int) -> bool:
    """Until the line becomes active (True), or it is over."""
    ready, _, _ = select.select([line, over], [], [])
    return over not in ready and len(os.read(line, _EVENT_BYTES)) == _EVENT_BYTES


def open_line(chip: str, line: int, active_low: bool = True, ioctl: Ioctl | None = None) -> int:
    """A line of a chip as input with its pull-up, whose file descriptor tells each time it becomes active.

    Raises ConfigError for a chip or line that cannot be used, and for a line that is active already.
    """
    if ioctl is None:
        import fcntl  # Linux only

        ioctl = fcntl.ioctl
    name = f"--halt-on {chip}:{line}"
    flags = _INPUT | _RISING | (_ACTIVE_LOW | _PULL_UP if active_low else 0)
    request = bytearray(_REQUEST.pack(line, b"sfms-robot halt", flags, 1, 0))
    values = bytearray(_VALUES.pack(0, 1))
    try:
        with open(chip, "rb", buffering=0) as file:
            if not stat.S_ISCHR(os.fstat(file.fileno()).st_mode):
                raise ConfigError(f"{name}: {chip} is no character device (/dev/gpiochipN)")
            ioctl(file.fileno(), _GET_LINE, request)
        fd = int(_REQUEST.unpack(request)[-1])
        ioctl(fd, _GET_VALUES, values)
    except OSError as error:
        raise ConfigError(f"{name}: {error.strerror or error}") from error
    if _VALUES.unpack(values)[0] & 1:
        os.close(fd)
        raise ConfigError(f"{name}: is active already: the head would be halted at once")
    return fd
