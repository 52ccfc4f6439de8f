"""What differs between operating systems about an open serial device: waiting, exclusive use, rates, RS-485 direction.

On Linux and macOS a device has a file descriptor: `DescriptorIO` waits on it, and wakes with the first byte. Where
there is none (Windows, rfc2217://), `PolledIO` asks pyserial twice a millisecond. `fcntl` and `termios` are imported
where the system has them, so that the package can be imported everywhere.
"""

from __future__ import annotations

import os
import select
import sys
import time
from array import array
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

from sfms_robot.errors import BusError, PortError

if TYPE_CHECKING:
    import serial

Rs485 = Literal["rts", "kernel"]

WRITE_TIMEOUT_S: Final = 0.5  # a device that takes nothing for so long is as good as gone, and stopping must not wait
_POLL_S: Final = 0.0005
_TCGETS2: Final = 0x802C542A  # Linux, asm-generic; where it is another number the ioctl fails and nothing is checked
_OUTPUT_SPEED: Final = 10  # c_ospeed of struct termios2, in words


def _optional(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:  # Windows has neither fcntl nor termios
        return None


_fcntl: Final = _optional("fcntl")
_termios: Final = _optional("termios")
DEVICE_ERRORS: Final[tuple[type[Exception], ...]] = (OSError,) if _termios is None else (OSError, _termios.error)


class SerialIO(Protocol):
    """Bytes in and out of one open device. Raises BusError when the device is gone."""

    def write(self, data: bytes) -> None:
        """Send all of `data`; blocks at most `WRITE_TIMEOUT_S` for a device that takes nothing."""

    def read(self, n: int, timeout_s: float) -> bytes:
        """1 to `n` bytes as soon as there are any; empty when none came in `timeout_s`."""


class DescriptorIO:
    """By the device's file descriptor, past pyserial, whose own reads and writes wait in a loop."""

    def __init__(self, port: serial.Serial, name: str) -> None:
        self._fd = port.fileno()
        self._name = name

    def write(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                if not select.select([], [self._fd], [], WRITE_TIMEOUT_S)[1]:
                    raise BusError(f"{self._name}: takes no more bytes") from None
            except OSError as error:
                raise BusError(f"{self._name}: cannot be written any more: {error}") from error

    def read(self, n: int, timeout_s: float) -> bytes:
        try:
            ready, _, _ = select.select([self._fd], [], [], timeout_s)
            data = os.read(self._fd, n) if ready else b""
        except OSError as error:
            raise BusError(f"{self._name}: cannot be read any more: {error}") from error
        if ready and not data:
            raise BusError(f"{self._name}: the device is gone")
        return data


class PolledIO:
    """By pyserial's own calls. pyserial is opened with timeout 0 and `WRITE_TIMEOUT_S`."""

    def __init__(self, port: serial.Serial, name: str) -> None:
        self._port = port
        self._name = name

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except OSError as error:
            raise BusError(f"{self._name}: cannot be written any more: {error}") from error

    def read(self, n: int, timeout_s: float) -> bytes:
        until_s = time.monotonic() + timeout_s
        try:
            while not (waiting := self._port.in_waiting):
                if (left_s := until_s - time.monotonic()) <= 0:
                    return b""
                time.sleep(min(_POLL_S, left_s))
            return bytes(self._port.read(min(n, waiting)))
        except OSError as error:
            raise BusError(f"{self._name}: cannot be read any more: {error}") from error


class RtsDirection:
    """A half-duplex RS-485 driver that transmits while RTS is on: on before the first bit, off after the last.

    `flush` returns when the bytes have left (tcdrain). An adapter that buffers behind its driver says so too early:
    most of them switch the direction themselves and need no `rs485`.
    """

    def __init__(self, inner: SerialIO, port: serial.Serial, name: str) -> None:
        self._inner = inner
        self._port = port
        self._name = name
        try:
            port.rts = False
        except DEVICE_ERRORS as error:
            raise PortError(f"{name}: rs485 = 'rts': this device has no RTS line: {error}") from error

    def write(self, data: bytes) -> None:
        try:
            self._port.rts = True
            try:
                self._inner.write(data)
                self._port.flush()
            finally:
                self._port.rts = False
        except DEVICE_ERRORS as error:
            raise BusError(f"{self._name}: cannot be written any more: {error}") from error

    def read(self, n: int, timeout_s: float) -> bytes:
        return self._inner.read(n, timeout_s)


def serial_io(port: serial.Serial, name: str, rs485: Rs485 | None = None) -> SerialIO:
    """The way of this system and device. Raises PortError where it cannot switch the direction as `rs485` asks."""
    if rs485 == "kernel":
        _driver_switches(port, name)
    io = DescriptorIO(port, name) if _termios is not None and _has_descriptor(port) else PolledIO(port, name)
    return RtsDirection(io, port, name) if rs485 == "rts" else io


def _has_descriptor(port: serial.Serial) -> bool:
    try:
        return bool(port.fileno() >= 0)
    except OSError:  # io.UnsupportedOperation
        return False


def _driver_switches(port: serial.Serial, name: str) -> None:
    """TIOCSRS485: the kernel's driver switches the direction between the last bit and the first answer."""
    from serial.rs485 import RS485Settings

    try:
        port.rs485_mode = RS485Settings()
    except (OSError, ValueError, NotImplementedError, AttributeError) as error:
        problem = "the driver of this device does not switch the direction (rts: this program does, by the RTS line)"
        raise PortError(f"{name}: rs485 = 'kernel': {problem}") from error


def make_exclusive(port: serial.Serial) -> None:
    """Nobody else may open the device from now on, root excepted. Windows does so by itself."""
    if _fcntl is not None:
        _fcntl.ioctl(port.fileno(), _termios.TIOCEXCL)


def actual_baud(port: serial.Serial) -> int | None:
    """The rate that the driver really set; None where it does not tell (only Linux does)."""
    if _fcntl is None or sys.platform != "linux":
        return None
    settings = array("I", [0] * 64)
    try:
        _fcntl.ioctl(port.fileno(), _TCGETS2, settings, True)
    except OSError:
        return None
    return settings[_OUTPUT_SPEED] or None
