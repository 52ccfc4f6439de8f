"""Serial ports: what a bus reads from and writes to.

`SerialPort` is a real port: reads block until bytes come or a deadline passes. It is ours alone: two programs on one
wire take each other's answers, so a port that somebody holds is refused, to root as well. Any baud rate the adapter can
do will do, and where the driver offers it, bytes are handed over without the usual 16 ms wait. What differs between
operating systems is in `serial_io`.

`VirtualTimePort` is the same port when the servos are emulated and time is virtual. Bytes go over the same pseudo
terminal, but before a read the port tells the emulator, on a control socket, how many bytes it has written so far
and what time it is. The emulator takes exactly those bytes, moves its servos on to that time, says how long its
reply is and writes it. So nothing depends on scheduling, and a silence costs no time at all.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from sfms_robot.errors import BusError, PortError
from sfms_robot.ports import Clock
from sfms_robot.servo.discovery import Holder, access_problem, holders, is_address
from sfms_robot.servo.serial_io import (
    DEVICE_ERRORS,
    WRITE_TIMEOUT_S,
    Rs485,
    actual_baud,
    make_exclusive,
    serial_io,
)

if TYPE_CHECKING:
    import serial

log = logging.getLogger(__name__)

_REPLY_TIMEOUT_S = 30.0  # real seconds: a stopped emulator, or one that waits for its turn on a busy machine
_TERMINALS: Final = "/dev/pts/"
_BAUD_TOLERANCE: Final = 0.03  # an asynchronous receiver samples the middle of the tenth bit


class Port(Protocol):
    """What a bus needs of a port."""

    @property
    def name(self) -> str: ...

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises BusError when the device is gone; reading does too."""

    def read(self, n: int, deadline_s: float) -> bytes:
        """1 to `n` bytes as soon as there are any; empty when none came by `deadline_s` of `now_s`."""

    def discard_input(self) -> None:
        """Forget what came and was not read."""

    def now_s(self) -> float: ...

    def wait_until(self, time_s: float) -> None:
        """Let time go by until `time_s` of `now_s`."""

    def set_baud(self, baud: int) -> None: ...

    def close(self) -> None:
        """Idempotent."""


@dataclass
class WrappedPort:
    """A port that hands everything on to `inner`; subclasses change what they are about."""

    inner: Port

    @property
    def name(self) -> str:
        return self.inner.name

    def write(self, data: bytes) -> None:
        self.inner.write(data)

    def read(self, n: int, deadline_s: float) -> bytes:
        return self.inner.read(n, deadline_s)

    def discard_input(self) -> None:
        self.inner.discard_input()

    def now_s(self) -> float:
        return self.inner.now_s()

    def wait_until(self, time_s: float) -> None:
        self.inner.wait_until(time_s)

    def set_baud(self, baud: int) -> None:
        self.inner.set_baud(baud)

    def close(self) -> None:
        self.inner.close()


class SerialPort:
    """A serial device: a path, a name such as COM3, socket://HOST:PORT or rfc2217://HOST:PORT.

    `rs485` says who switches the direction of a half-duplex RS-485 driver; None: nobody has to.
    """

    def __init__(self, device: str, baud: int, clock: Clock, rs485: Rs485 | None = None) -> None:
        """Opens it. Raises PortError of one line; nothing stays open then."""
        self.name = device
        self._clock = clock
        self._serial = _open(device, baud)
        try:
            self._io = serial_io(self._serial, device, rs485)
            _low_latency(self._serial)
            self.discard_input()
        except BaseException:
            self._serial.close()
            raise

    def write(self, data: bytes) -> None:
        self._io.write(data)

    def read(self, n: int, deadline_s: float) -> bytes:
        return self._io.read(n, max(0.0, deadline_s - self._clock.now_s()))

    def discard_input(self) -> None:
        try:
            self._serial.reset_input_buffer()
        except DEVICE_ERRORS as error:
            raise BusError(f"{self.name}: cannot be read any more: {error}") from error

    def now_s(self) -> float:
        return self._clock.now_s()

    def wait_until(self, time_s: float) -> None:
        self._clock.wait_until(time_s)

    def set_baud(self, baud: int) -> None:
        try:
            self._serial.baudrate = baud
        except (OSError, OverflowError, ValueError) as error:
            raise PortError(f"{self.name}: does not take {baud} baud: {error}") from error
        if not is_address(self.name):
            _check_baud(self._serial, self.name)

    def close(self) -> None:
        self._serial.close()


class VirtualTimePort:
    """The pseudo terminal of an emulated chain, in virtual time."""

    _WINDOW = 2048  # bytes on their way at most: more than the terminal holds would block for good

    def __init__(self, device: str, control_path: str, baud: int, clock: Clock) -> None:
        self.name = device
        self._clock = clock
        self._written = 0
        self._told = 0
        self._wanted_from = 0
        self._written_at_s = 0.0
        self._inbox = bytearray()
        self._control = socket.socket(socket.AF_UNIX)
        self._control.settimeout(_REPLY_TIMEOUT_S)
        try:
            self._control.connect(control_path)
        except OSError as error:
            self._control.close()
            raise PortError(f"{control_path}: no emulator answers there: {error}") from error
        try:
            self._serial = _open(device, baud)
        except BaseException:
            self._control.close()
            raise
        self._serial.write_timeout = _REPLY_TIMEOUT_S  # real time, which says nothing here about the device

    def write(self, data: bytes) -> None:
        now_s = self._clock.now_s()
        if self._told < self._written and self._written_at_s < now_s:
            self._exchange(self._written_at_s)
        for start in range(0, len(data), self._WINDOW):
            chunk = data[start : start + self._WINDOW]
            if self._written + len(chunk) - self._told > self._WINDOW:
                self._exchange(now_s)
            try:
                self._serial.write(chunk)
            except OSError as error:
                raise BusError(f"{self.name}: cannot be written any more: {error}") from error
            self._written += len(chunk)
        self._written_at_s = now_s

    def read(self, n: int, deadline_s: float) -> bytes:
        if not self._inbox:
            self._exchange(self._clock.now_s(), deadline_s)
        data = bytes(self._inbox[:n])
        del self._inbox[:n]
        return data

    def discard_input(self) -> None:
        self._inbox.clear()
        self._wanted_from = self._written  # answers to what was written before need not even be sent

    def now_s(self) -> float:
        return self._clock.now_s()

    def wait_until(self, time_s: float) -> None:
        self._clock.wait_until(time_s)

    def set_baud(self, baud: int) -> None:
        if self._told < self._written:
            self._exchange(self._written_at_s)
        self._serial.baudrate = baud

    def close(self) -> None:
        if self._serial.is_open and self._told < self._written:
            try:
                self._exchange(self._written_at_s)
            except BusError:
                self._inbox.clear()  # the emulator is gone: nobody is left to tell
        self._serial.close()
        self._control.close()

    def _exchange(self, now_s: float, until_s: float | None = None) -> None:
        """Let the emulator take what was written, at `now_s`, and fetch the whole of what it sends by `until_s`."""
        until_s = now_s if until_s is None else until_s
        try:
            self._control.sendall(b"sync %d %d %r %r\n" % (self._written, self._wanted_from, now_s, until_s))
            answer = self._line()
            missing = int(answer.removeprefix(b"ack "))
            fd = self._serial.fileno()
            while missing > 0:
                if not select.select([fd], [], [], _REPLY_TIMEOUT_S)[0]:
                    raise OSError("the reply it announced does not come")
                data = os.read(fd, missing)
                if not data:
                    raise OSError("end of file")
                self._inbox += data
                missing -= len(data)
        except (OSError, ValueError) as error:
            raise BusError(f"{self.name}: the emulator is gone: {error}") from error
        self._told = self._written

    def _line(self) -> bytes:
        line = b""
        while not line.endswith(b"\n"):
            part = self._control.recv(64)
            if not part:
                raise OSError("it closed its control socket")
            line += part
        return line


def _open(device: str, baud: int) -> serial.Serial:
    """Raises PortError of one line: missing, not permitted, held by somebody else, not a serial device."""
    scheme = device.partition("://")[0] if is_address(device) else ""
    if scheme and (problem := access_problem(device)):
        raise PortError(f"{device}: {problem}")
    import serial

    try:
        port = serial.serial_for_url(device, baudrate=baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
    except (OSError, OverflowError, ValueError) as error:
        raise PortError(f"{device}: {_reason(device, error)}") from error
    try:
        if scheme == "socket":
            _without_delay(port)
        elif not scheme:
            _claim(port, device)
            _check_baud(port, device)
    except BaseException:
        port.close()
        raise
    return port


def _without_delay(port: serial.Serial) -> None:
    """TCP_NODELAY. With Nagle's algorithm the goals of a tick wait until the last answer is acknowledged: 40 ms."""
    with socket.fromfd(port.fileno(), socket.AF_INET, socket.SOCK_STREAM) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _claim(port: serial.Serial, device: str) -> None:
    """Nobody else may open it from now on; nobody else may have it open already. pyserial's lock is only advice."""
    if os.path.realpath(device).startswith(_TERMINALS):
        return  # an emulator holds the near end of its pseudo terminal open, and with it the lock of a dead host
    make_exclusive(port)
    others = holders(device)
    if others:
        raise PortError(f"{device}: {_held(others)}")


def _check_baud(port: serial.Serial, device: str) -> None:
    """Drivers take the nearest rate they can do, and say which one only when asked."""
    actual = actual_baud(port)
    if actual is not None and abs(actual - port.baudrate) > _BAUD_TOLERANCE * port.baudrate:
        raise PortError(f"{device}: the adapter cannot do {port.baudrate} baud (the nearest it has is {actual})")


def _low_latency(port: serial.Serial) -> None:
    try:
        port.set_low_latency_mode(True)
    except (AttributeError, NotImplementedError, OSError, ValueError) as error:
        log.debug("%s: no low latency mode: %s", port.name, error)


def _reason(device: str, error: Exception) -> str:
    if not is_address(device) and os.name == "posix":
        if not os.path.exists(device):
            return "no such device"
        if os.path.isdir(device):
            return "is a directory, not a serial port"
        if getattr(error, "errno", None) in (errno.EAGAIN, errno.EBUSY):
            return _held(holders(device))
        if not os.access(device, os.R_OK | os.W_OK):
            return "no permission to open it (on Debian and Ubuntu: sudo usermod -aG dialout $USER, then log in again)"
    return f"cannot be opened as a serial port: {error}"


def _held(others: Sequence[Holder]) -> str:
    named = ", ".join(f"pid {each.pid}: {each.command}" for each in others)
    return "is held by another program" + (f" ({named})" if named else "") + "; stop that first"
