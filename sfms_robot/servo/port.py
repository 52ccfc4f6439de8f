"""Serial ports, which buses read from and write to.

`SerialPort` is a real port: a read blocks until bytes come or a deadline passes. It belongs to one program. Two
programs on one wire take each other's answers, so a port that another process holds is refused, for root too. Every
baud rate that the adapter supports is allowed. If the driver supports it, bytes are delivered without the usual wait of
16 ms.

The code that depends on the operating system (waiting, exclusive use, rates, RS-485 direction of an open device) is at
the end of this file. `fcntl` and `termios` are imported if the system has them, so that the package can be imported on
every system.

`VirtualTimePort` is the same port for emulated servos in virtual time. Bytes pass over the same device, but before a
read the port sends the number of bytes written so far and the time to the emulator, on a control socket. The emulator
reads exactly those bytes, moves its servos to that time, sends the length of its reply and writes the reply. So the
result does not depend on scheduling, and a silence takes no real time.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import socket
import sys
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

from sfms_robot.endpoint import connect
from sfms_robot.errors import BusError, PortError
from sfms_robot.ports import Clock
from sfms_robot.servo.discovery import Holder, access_problem, holders, is_address

if TYPE_CHECKING:
    import serial

log = logging.getLogger(__name__)

Rs485 = Literal["rts", "kernel"]

WRITE_TIMEOUT_S: Final = 0.5  # a device that accepts no bytes for so long counts as gone; a stop must not wait longer
_REPLY_TIMEOUT_S: Final = 30.0  # real seconds, for a stopped emulator or one that waits for a busy processor
_TERMINALS: Final = "/dev/pts/"
_BAUD_TOLERANCE: Final = 0.03  # an asynchronous receiver samples the middle of the tenth bit
_POLL_S: Final = 0.0005
_TCGETS2: Final = 0x802C542A  # Linux, asm-generic; with another number the ioctl fails and the rate is not checked
_OUTPUT_SPEED: Final = 10  # c_ospeed of struct termios2, in words


def _optional(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:  # Windows has neither fcntl nor termios
        return None


_fcntl: Final = _optional("fcntl")
_termios: Final = _optional("termios")
DEVICE_ERRORS: Final[tuple[type[Exception], ...]] = (OSError,) if _termios is None else (OSError, _termios.error)


class Port(Protocol):
    """A byte stream to servos, with a clock."""

    @property
    def name(self) -> str: ...

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises BusError if the device is gone; reading does too."""

    def read(self, n: int, deadline_s: float) -> bytes:
        """Return 1 to `n` bytes as soon as there are any; empty if none came by `deadline_s` of `now_s`."""

    def discard_input(self) -> None:
        """Drop bytes that have arrived and were not read."""

    def now_s(self) -> float:
        """Return the time of the port's clock."""

    def wait_until(self, time_s: float) -> None:
        """Wait until `now_s` is `time_s`."""

    def set_baud(self, baud: int) -> None:
        """Change the rate. Raises PortError if the adapter does not support it."""

    def close(self) -> None:
        """Close the device. Idempotent."""


OpenPort = Callable[[], Port]  # raises PortError


@dataclass
class WrappedPort:
    """A port that forwards every call to `inner`; subclasses change some of them."""

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

    Args:
        rs485: method to switch the direction of a half-duplex RS-485 driver: "rts": this program, by the RTS line;
            "kernel": the kernel; None: the adapter.

    The constructor opens the device. If it raises PortError (one line), the device is closed again.
    """

    def __init__(self, device: str, baud: int, clock: Clock, rs485: Rs485 | None = None) -> None:
        self.name = device
        self._clock = clock
        self._serial = _open(device, baud)
        try:
            self._io = serial_io(self._serial, device, rs485)
            try:
                self._serial.set_low_latency_mode(True)
            except (AttributeError, NotImplementedError, OSError, ValueError) as error:
                log.debug("%s: no low latency mode: %s", device, error)
            self.discard_input()
        except BaseException:
            _shut(self._serial)
            raise

    def write(self, data: bytes) -> None:
        try:
            self._io.write(data)
        except DEVICE_ERRORS as error:
            raise BusError(f"{self.name}: cannot be written any more: {error}") from error

    def read(self, n: int, deadline_s: float) -> bytes:
        try:
            return self._io.read(n, max(0.0, deadline_s - self.now_s()))
        except DEVICE_ERRORS as error:
            raise BusError(f"{self.name}: cannot be read any more: {error}") from error

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
        if _is_socket(self.name) and baud != self._serial.baudrate:
            raise PortError(f"{self.name}: cannot change to {baud} baud: a socket:// port has the rate of its server")
        try:
            self._serial.baudrate = baud
        except (OSError, OverflowError, ValueError) as error:
            raise PortError(f"{self.name}: does not take {baud} baud: {error}") from error
        if not is_address(self.name):
            _check_baud(self._serial, self.name)

    def close(self) -> None:
        _shut(self._serial)


def emulator_control(control: str) -> socket.socket:
    """Return a connection to the control socket of an emulator, by its address. Raises PortError."""
    try:
        return connect(control)
    except OSError as error:
        raise PortError(f"{control}: no emulator answers there: {error}") from error


class VirtualTimePort:
    """The device of an emulated chain, in virtual time; `control`: address of its control socket."""

    _WINDOW = 2048  # most bytes in transit; more bytes than the buffer of a terminal holds would block for ever

    def __init__(self, device: str, control: str, baud: int, clock: Clock) -> None:
        self.name = device
        self.now_s, self.wait_until = clock.now_s, clock.wait_until
        self._written = 0
        self._announced = 0  # bytes that the emulator has read, of those written
        self._wanted_from = 0
        self._written_at_s = 0.0
        self._inbox = bytearray()
        self._control = emulator_control(control)
        self._control.settimeout(_REPLY_TIMEOUT_S)
        try:
            self._serial = _open(device, baud)
        except BaseException:
            self._control.close()
            raise
        self._io = serial_io(self._serial, device)
        self._serial.write_timeout = _REPLY_TIMEOUT_S  # real time, which here does not show a lost device

    def write(self, data: bytes) -> None:
        now_s = self.now_s()
        if self._written_at_s < now_s:
            self._announce()
        for start in range(0, len(data), self._WINDOW):
            chunk = data[start : start + self._WINDOW]
            if self._written + len(chunk) - self._announced > self._WINDOW:
                self._exchange(now_s)
            try:
                self._serial.write(chunk)
            except OSError as error:
                raise BusError(f"{self.name}: cannot be written any more: {error}") from error
            self._written += len(chunk)
        self._written_at_s = now_s

    def read(self, n: int, deadline_s: float) -> bytes:
        if not self._inbox:
            self._exchange(self.now_s(), deadline_s)
        data = bytes(self._inbox[:n])
        del self._inbox[:n]
        return data

    def discard_input(self) -> None:
        self._inbox.clear()
        self._wanted_from = self._written  # the emulator need not send answers to earlier bytes

    def set_baud(self, baud: int) -> None:
        self._announce()
        self._serial.baudrate = baud

    def close(self) -> None:
        if self._serial.is_open:
            try:
                self._announce()
            except BusError:
                self._inbox.clear()  # the emulator is gone
        _shut(self._serial)
        self._control.close()

    def _announce(self) -> None:
        """Let the emulator read the bytes that it has not read yet, at the time of the last write."""
        if self._announced < self._written:
            self._exchange(self._written_at_s)

    def _exchange(self, now_s: float, until_s: float | None = None) -> None:
        """Let the emulator read the bytes written, at `now_s`, and read all bytes that it sends by `until_s`."""
        until_s = now_s if until_s is None else until_s
        try:
            self._control.sendall(b"sync %d %d %r %r\n" % (self._written, self._wanted_from, now_s, until_s))
            line = b""
            while not line.endswith(b"\n"):
                part = self._control.recv(64)
                if not part:
                    raise OSError("it closed its control socket")
                line += part
            missing = int(line.removeprefix(b"ack "))
            while missing > 0:
                data = self._io.read(missing, _REPLY_TIMEOUT_S)
                if not data:
                    raise OSError("the reply it announced does not come")
                self._inbox += data
                missing -= len(data)
        except (OSError, ValueError) as error:
            raise BusError(f"{self.name}: the emulator is gone: {error}") from error
        self._announced = self._written


# --- opening --------------------------------------------------------------------------------------------------------


def _open(device: str, baud: int) -> serial.Serial:
    """Open a device. Raises PortError (one line) if it is missing, forbidden, held by another program or not serial."""
    if is_address(device) and (problem := access_problem(device)):
        raise PortError(f"{device}: {problem}")
    import serial

    try:
        port = serial.serial_for_url(device, baudrate=baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
    except (OSError, OverflowError, ValueError) as error:
        raise PortError(f"{device}: {_reason(device, error)}") from error
    try:
        if _is_socket(device):  # With Nagle's algorithm the goals of a tick wait 40 ms for the last acknowledgement.
            with socket.fromfd(port.fileno(), socket.AF_INET, socket.SOCK_STREAM) as connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        elif not is_address(device):
            _claim(port, device)
            _check_baud(port, device)
    except BaseException:
        _shut(port)
        raise
    return port


def _is_socket(device: str) -> bool:
    """Return whether a device is plain TCP, which transfers bytes and no settings."""
    return device.startswith("socket://")


def _shut(port: serial.Serial) -> None:
    """Close a device. pyserial leaves a connection open if the other end has closed it first."""
    connection = getattr(port, "_socket", None)
    port.close()
    if connection is not None:
        connection.close()


def _claim(port: serial.Serial, device: str) -> None:
    """Refuse a device that another process has open, and keep others from opening it; pyserial's lock is only advisory.

    Pseudo terminals are not checked: an emulator holds the near end open, and with it the lock of a dead host. Windows
    lets only one process open a device; on other systems root can still open it.
    """
    if os.path.realpath(device).startswith(_TERMINALS):
        return
    if _fcntl is not None:
        _fcntl.ioctl(port.fileno(), _termios.TIOCEXCL)
    if others := holders(device):
        raise PortError(f"{device}: {_held(others)}")


def _check_baud(port: serial.Serial, device: str) -> None:
    """Raise PortError if the driver set another rate: drivers use the nearest, and only Linux reports it."""
    if _fcntl is None or sys.platform != "linux":
        return
    settings = array("I", [0] * 64)
    try:
        _fcntl.ioctl(port.fileno(), _TCGETS2, settings, True)
    except OSError:
        return
    actual = settings[_OUTPUT_SPEED] or port.baudrate
    if abs(actual - port.baudrate) > _BAUD_TOLERANCE * port.baudrate:
        raise PortError(f"{device}: the adapter cannot do {port.baudrate} baud (the nearest it has is {actual})")


def _reason(device: str, error: Exception) -> str:
    if getattr(error, "errno", None) in (errno.EAGAIN, errno.EBUSY):
        return _held(holders(device))
    problem = access_problem(device) or f"cannot be opened as a serial port: {error}"
    fix = " (on Debian and Ubuntu: sudo usermod -aG dialout $USER, then log in again)"
    return problem + fix * problem.startswith("no permission")


def _held(others: Sequence[Holder]) -> str:
    named = ", ".join(f"pid {each.pid}: {each.command}" for each in others)
    return "is held by another program" + (f" ({named})" if named else "") + "; stop that first"


# --- input and output of an open device -----------------------------------------------------------------------------


class DescriptorIO:
    """Input and output by file descriptor (Linux, macOS). It wakes at the first byte; pyserial's calls wait in a loop.

    Like the two classes below it raises one of `DEVICE_ERRORS` if the device is gone.

    Args:
        connection: socket of a network port; on Windows it is waited for and read in the same way.
    """

    def __init__(self, port: serial.Serial, connection: socket.socket | None) -> None:
        self._fd = port.fileno()
        self._take = partial(os.read, self._fd) if connection is None else connection.recv
        self._give = partial(os.write, self._fd) if connection is None else connection.send

    def write(self, data: bytes) -> None:
        """Send all of `data`; block at most `WRITE_TIMEOUT_S` for a device that accepts no bytes."""
        rest = memoryview(data)
        while rest:
            try:
                rest = rest[self._give(rest) :]
            except BlockingIOError:
                if not select.select([], [self._fd], [], WRITE_TIMEOUT_S)[1]:
                    raise OSError("it takes no more bytes") from None

    def read(self, n: int, timeout_s: float) -> bytes:
        """Return 1 to `n` bytes as soon as there are any; empty if none came in `timeout_s`."""
        ready, _, _ = select.select([self._fd], [], [], timeout_s)
        data = self._take(n) if ready else b""
        if ready and not data:
            raise OSError("the device is gone")
        return data


class PolledIO:
    """Input and output by pyserial's calls, twice a millisecond, for devices without descriptor (Windows, rfc2217://).

    `port` must have been opened with timeout 0 and write timeout `WRITE_TIMEOUT_S`.
    """

    def __init__(self, port: serial.Serial) -> None:
        self._port = port

    def write(self, data: bytes) -> None:
        self._port.write(data)

    def read(self, n: int, timeout_s: float) -> bytes:
        until_s = time.monotonic() + timeout_s
        while not (waiting := self._port.in_waiting):
            if (left_s := until_s - time.monotonic()) <= 0:
                return b""
            time.sleep(min(_POLL_S, left_s))
        return bytes(self._port.read(min(n, waiting)))


class RtsDirection:
    """A half-duplex RS-485 driver that transmits while RTS is on: on before the first bit, off after the last.

    `flush` returns when the bytes have left (tcdrain). It returns too early with an adapter that has its own buffer:
    most such adapters switch the direction themselves and need no `rs485`.
    """

    def __init__(self, inner: DescriptorIO | PolledIO, port: serial.Serial, name: str) -> None:
        self._port = port
        self._write = inner.write
        self.read = inner.read
        try:
            port.rts = False
        except DEVICE_ERRORS as error:
            raise PortError(f"{name}: rs485 = 'rts': this device has no RTS line: {error}") from error

    def write(self, data: bytes) -> None:
        self._port.rts = True
        try:
            self._write(data)
            self._port.flush()
        finally:
            self._port.rts = False


def serial_io(port: serial.Serial, name: str, rs485: Rs485 | None = None) -> DescriptorIO | PolledIO | RtsDirection:
    """Return the I/O for this system and device. Raises PortError if it cannot switch the direction as in `rs485`."""
    if rs485 == "kernel":  # TIOCSRS485: the driver switches the direction between the last bit and the first answer
        from serial.rs485 import RS485Settings

        try:
            port.rs485_mode = RS485Settings()
        except (OSError, ValueError, NotImplementedError, AttributeError) as error:
            problem = "the driver of this device does not switch the direction (rts: this program does, by RTS)"
            raise PortError(f"{name}: rs485 = 'kernel': {problem}") from error
    connection = port._socket if _is_socket(name) else None
    try:
        has_descriptor = connection is not None or (_termios is not None and port.fileno() >= 0)
    except OSError:  # io.UnsupportedOperation
        has_descriptor = False
    io = DescriptorIO(port, connection) if has_descriptor else PolledIO(port)
    return RtsDirection(io, port, name) if rs485 == "rts" else io
