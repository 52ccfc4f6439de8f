"""Which serial ports there are, who may and who does use them, and how long their adapters hold bytes back.

Nothing is opened. Which ports there are comes from pyserial's list, which knows macOS and Windows too, and from
/dev; adapters, lasting names and holders come from /dev, /sys and /proc, whose roots are arguments, so that all of it
can be tried on a made-up tree.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Protocol
from urllib.parse import urlsplit

DEV: Final = Path("/dev")
SYS: Final = Path("/sys")
PROC: Final = Path("/proc")
NETWORKED: Final = ("socket", "rfc2217")  # pyserial's URLs behind which servos can be

_PATTERNS: Final = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyTHS*", "ttySC*", "ttyS*", "rfcomm*", "serial[0-9]")
_NO_UART: Final = "0"  # /sys/class/tty/ttyS0/type, PORT_UNKNOWN: the name is there, the hardware is not


@dataclass(frozen=True)
class SerialDevice:
    """One serial port. What the adapter does not tell is None.

    Attributes:
        path: device file, as in /dev/ttyUSB0.
        by_id: its name by maker and serial number, as in /dev/serial/by-id/usb-FTDI_..., if there is one.
        by_path: its name by the socket it is plugged into, as in /dev/serial/by-path/..., if there is one.
        vendor, product: USB numbers, four hex digits each.
        serial: USB serial number.
        driver: kernel driver. Example: ftdi_sio.
        latency_ms: how long the adapter collects bytes before it hands them over.
        latency_file: where that is set.
    """

    path: str
    by_id: str | None = None
    by_path: str | None = None
    vendor: str | None = None
    product: str | None = None
    serial: str | None = None
    description: str | None = None
    driver: str | None = None
    latency_ms: int | None = None
    latency_file: str | None = None


@dataclass(frozen=True)
class Holder:
    """A process that has a port open."""

    pid: int
    command: str


class ListedPort(Protocol):
    """What of pyserial's `ListPortInfo` is used."""

    device: str
    vid: int | None
    pid: int | None
    serial_number: str | None
    description: str | None


def pyserial_ports() -> Iterable[ListedPort]:
    """Ports by pyserial's own list: ttyS and ttyUSB on Linux, cu. on macOS, COM on Windows."""
    from serial.tools.list_ports import comports

    ports: Iterable[ListedPort] = comports()
    return ports


def list_ports(
    dev: Path = DEV, sys: Path = SYS, listed: Callable[[], Iterable[ListedPort]] = pyserial_ports
) -> list[SerialDevice]:
    """Serial ports that servos may hang on, by path. A built-in ttyS is left out where no hardware is behind it."""
    paths = {os.path.realpath(path) for pattern in _PATTERNS for path in dev.glob(pattern)}
    found = {path: describe(path, dev, sys) for path in paths}
    for port in listed():
        is_file = port.device.startswith("/")
        path = os.path.realpath(port.device) if is_file else port.device
        known = found.get(path) or (describe(path, dev, sys) if is_file else SerialDevice(path))
        found[path] = _completed(known, port)
    return [found[path] for path in sorted(found) if not _is_vacant(path, sys)]


def ports_data() -> list[dict[str, Any]]:
    """What `port list` shows: per port its facts, `name` to give to --port, `problem` and `holders`, as plain data."""
    return [
        {
            "name": stable_name(port.path),
            **asdict(port),
            "problem": access_problem(port.path),
            "holders": [asdict(each) for each in holders(port.path)],
        }
        for port in list_ports()
    ]


def describe(path: str, dev: Path = DEV, sys: Path = SYS) -> SerialDevice:
    """What the system tells of a port; `path` may be a link to it. Little is known where there is no /sys."""
    if os.name != "posix":
        return SerialDevice(path)
    real = Path(os.path.realpath(path))
    name = real.name
    usb = _usb_folder(sys / "class" / "tty" / name / "device")
    driver = sys / "class" / "tty" / name / "device" / "driver"
    latency = sys / "bus" / "usb-serial" / "devices" / name / "latency_timer"
    text = _line(latency)
    return SerialDevice(
        path=str(real),
        by_id=_link_to(real, dev / "serial" / "by-id"),
        by_path=_link_to(real, dev / "serial" / "by-path"),
        vendor=_line(usb / "idVendor") if usb else None,
        product=_line(usb / "idProduct") if usb else None,
        serial=_line(usb / "serial") if usb else None,
        description=_line(usb / "product") if usb else None,
        driver=os.path.basename(os.path.realpath(driver)) if driver.exists() else None,
        latency_ms=int(text) if text is not None and text.isdigit() else None,
        latency_file=str(latency) if text is not None else None,
    )


def stable_name(device: str, dev: Path = DEV, sys: Path = SYS) -> str:
    """The name under which the same adapter is found again after it was unplugged, or `device` itself.

    By serial number where the adapter has one of its own. Two CH340 have none, and two CP2102 both have 0001: their
    name by-id is one and the same, and belongs to the one plugged in last. Such adapters go by their USB socket.
    """
    if not device.startswith((str(dev / "tty"), str(dev / "serial" / "by-id"))):
        return device
    port = describe(device, dev, sys)
    unique = port.serial is not None and not _has_double(port, sys)
    return (port.by_id if unique else port.by_path) or (port.path if not unique else device)


def _has_double(port: SerialDevice, sys: Path) -> bool:
    """Is another adapter with the same numbers plugged in? Several ports of one adapter have names of their own."""
    own = _usb_folder(sys / "class" / "tty" / os.path.basename(port.path) / "device")
    for tty in (sys / "class" / "tty").glob("*"):
        usb = _usb_folder(tty / "device")
        if usb is not None and usb != own:
            numbers = tuple(_line(usb / key) for key in ("idVendor", "idProduct", "serial"))
            if numbers == (port.vendor, port.product, port.serial):
                return True
    return False


def _completed(device: SerialDevice, port: ListedPort) -> SerialDevice:
    """With what pyserial knows where /sys does not tell: macOS and Windows have none."""
    said = None if port.description == "n/a" else port.description or None
    return replace(
        device,
        vendor=device.vendor or (None if port.vid is None else f"{port.vid:04x}"),
        product=device.product or (None if port.pid is None else f"{port.pid:04x}"),
        serial=device.serial or port.serial_number or None,
        description=device.description or said,
    )


def _is_vacant(path: str, sys: Path) -> bool:
    return _line(sys / "class" / "tty" / os.path.basename(path) / "type") == _NO_UART


def holders(path: str, proc: Path = PROC) -> list[Holder]:
    """Processes that have the port open, as far as this user may see; this one is left out."""
    real = os.path.realpath(path)
    found = []
    for folder in sorted(proc.glob("[0-9]*"), key=lambda each: int(each.name)):
        if int(folder.name) != os.getpid() and any(target == real for target in _open_files(folder)):
            found.append(Holder(int(folder.name), _command(folder)))
    return found


def is_address(device: str) -> bool:
    """socket://, rfc2217:// and the like; everything else is a path, relative ones too."""
    return "://" in device


def access_problem(path: str) -> str | None:
    """Why this user cannot use `path`, or an address, as a serial port; None when nothing speaks against it."""
    if is_address(path):
        return _address_problem(path)
    if os.name != "posix":
        return None  # COM3 is no file that could be looked at
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return "no such device"
    except OSError as error:
        return f"cannot be looked at: {error.strerror}"
    if stat.S_ISDIR(mode):
        return "is a directory, not a serial port"
    if not stat.S_ISCHR(mode):
        return "is a file, not a serial port"
    if not os.access(path, os.R_OK | os.W_OK):
        return "no permission to open it"
    return None


def _address_problem(url: str) -> str | None:
    """What an address lacks: nobody is asked whether it answers."""
    scheme = url.partition("://")[0]
    if scheme not in NETWORKED:
        choices = ", ".join(f"{each}://HOST:PORT" for each in NETWORKED)
        return f"no servos can be behind {scheme}:// (a device such as /dev/ttyUSB0 or COM3, {choices})"
    try:
        parts = urlsplit(url)
        complete = bool(parts.hostname) and parts.port is not None
    except ValueError:  # a port that is no number, or none that there can be
        complete = False
    return None if complete else f"names no host and port to connect to ({scheme}://HOST:PORT)"


def group_of(path: str) -> str:
    """The group whose members may use the port. Example: dialout."""
    try:
        return Path(path).group()
    except (OSError, KeyError, NotImplementedError):  # Windows knows no groups
        return "dialout"


def _usb_folder(device: Path) -> Path | None:
    """The USB device that a tty belongs to: the first folder upwards that has an idVendor."""
    real = Path(os.path.realpath(device))
    return next((folder for folder in (real, *real.parents) if (folder / "idVendor").is_file()), None)


def _link_to(real: Path, folder: Path) -> str | None:
    return next((str(link) for link in sorted(folder.glob("*")) if os.path.realpath(link) == str(real)), None)


def _open_files(folder: Path) -> Iterator[str]:
    try:
        entries = os.listdir(folder / "fd")
    except OSError:
        return  # the process ended, or belongs to somebody else
    for entry in entries:
        try:
            yield os.readlink(folder / "fd" / entry)
        except OSError:
            continue  # closed meanwhile


def _command(folder: Path) -> str:
    try:
        words = (folder / "cmdline").read_bytes().split(b"\0")
    except OSError:
        words = []
    text = b" ".join(word for word in words if word).decode(errors="replace").strip()
    return text or _line(folder / "comm") or "?"


def _line(file: Path) -> str | None:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return None
