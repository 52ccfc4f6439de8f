"""Serial ports of this system, the processes that hold them, and the latency of their adapters; and option `--port`.

No port is opened. The list and the USB adapters come from pyserial, which supports macOS and Windows too, and the ports
of built-in UARTs from /dev; names, drivers and holders come from /dev, /sys and /proc. Tests pass their own list and
root.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from sfms_robot.data import Report
from sfms_robot.endpoint import host_and_port
from sfms_robot.errors import ConfigError, PortError

ROOT: Final = Path("/")  # parent of /dev, /sys and /proc
AUTO: Final = "auto"
NETWORKED: Final = ("socket", "rfc2217")  # schemes of pyserial's URLs that can lead to servos

_PATTERNS: Final = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyTHS*", "ttySC*", "ttyS*", "rfcomm*", "serial[0-9]")
_TAKERS: Final = {  # daemons that search every USB port for their own devices
    "ModemManager": "sends modem commands to every port that is plugged in",
    "brltty": "takes adapters with a CH340 or CP210x for a braille display, and their port vanishes",
}
_NO_UART: Final = "0"  # /sys/class/tty/ttyS0/type, PORT_UNKNOWN: a name without hardware
_NAMED: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*=")  # BUS=DEVICE; addresses and paths do not begin like this


@dataclass(frozen=True)
class SerialDevice:
    """A serial port. Values that the adapter does not report are None.

    Attributes:
        path: device file. Example: /dev/ttyUSB0.
        by_id: its name by maker and serial number, such as /dev/serial/by-id/usb-FTDI_..., if there is one.
        by_path: its name by the socket it is plugged into, such as /dev/serial/by-path/..., if there is one.
        vendor, product: USB numbers, four hex digits each.
        serial: USB serial number.
        driver: kernel driver. Example: ftdi_sio.
        latency_ms: time for which the adapter collects bytes before it delivers them.
        latency_file: file in which `latency_ms` is set.
    """

    path: str
    _: KW_ONLY
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


Listing = Callable[[], Iterable[Any]]  # returns pyserial's `ListPortInfo` objects


def _pyserial_ports() -> Iterator[Any]:
    from serial.tools.list_ports import comports

    yield from comports()


def list_ports(root: Path = ROOT, listed: Listing = _pyserial_ports) -> list[SerialDevice]:
    """Return the serial ports that servos may be connected to, by path, without built-in ttyS that have no hardware.

    `listed`: returns pyserial's `ListPortInfo` of each port, the source of the facts of USB adapters.
    """
    found: dict[str, Any] = {_real(str(path)): None for pattern in _PATTERNS for path in (root / "dev").glob(pattern)}
    found |= {_real(port.device): port for port in listed()}
    return [
        _described(path, found[path], root)
        for path in sorted(found)
        if _line(root / "sys" / "class" / "tty" / os.path.basename(path) / "type") != _NO_UART
    ]


def ports_data() -> list[Report]:
    """Return the rows of `port list` as plain data: the facts, the `name` for --port, `problem` and `holders`."""
    return [
        {
            "name": stable_name(port.path),
            **asdict(port),
            "problem": access_problem(port.path),
            "holders": [asdict(each) for each in holders(port.path)],
        }
        for port in list_ports()
    ]


def describe(path: str, root: Path = ROOT, listed: Listing = _pyserial_ports) -> SerialDevice:
    """Return the facts that the system has about a port; `path` may be a link to it."""
    real = _real(path)
    return _described(real, next((port for port in listed() if _real(port.device) == real), None), root)


def _described(path: str, port: Any, root: Path) -> SerialDevice:
    """Return a port with its names and driver, and the facts in `port` (None: pyserial does not list the port)."""
    name, links, sys = os.path.basename(path), root / "dev" / "serial", root / "sys"
    driver = sys / "class" / "tty" / name / "device" / "driver"
    latency = sys / "bus" / "usb-serial" / "devices" / name / "latency_timer"
    text = _line(latency)
    known = SerialDevice(
        path,
        by_id=_link_to(path, links / "by-id"),
        by_path=_link_to(path, links / "by-path"),
        driver=os.path.basename(os.path.realpath(driver)) if driver.exists() else None,
        latency_ms=int(text) if text is not None and text.isdigit() else None,
        latency_file=str(latency) if text is not None else None,
    )
    if port is None:
        return known
    vendor, product = (None if number is None else f"{number:04x}" for number in (port.vid, port.pid))
    said = None if port.description == "n/a" else port.description
    description = port.product or said or None
    return replace(known, vendor=vendor, product=product, serial=port.serial_number or None, description=description)


def stable_name(device: str, root: Path = ROOT, listed: Listing = _pyserial_ports) -> str:
    """Return the name under which an adapter is found again after it was unplugged, or `device` itself.

    It is the name by serial number if the adapter has a unique one. Two CH340 have no serial number, and two CP2102
    both have 0001: their by-id names are equal, and the link points to the adapter that was plugged in last. Such
    adapters are named by their USB socket.
    """
    links = root / "dev" / "serial"
    if not device.startswith((str(root / "dev" / "tty"), str(links / "by-id"))):
        return device
    real = _real(device)
    sockets: dict[tuple[Any, ...], set[str]] = {}  # USB sockets by `numbers`; ports of one adapter share its socket
    own: tuple[Any, ...] = ()
    for port in listed():
        numbers = port.vid, port.pid, port.serial_number
        sockets.setdefault(numbers, set()).add((port.location or "").partition(":")[0])
        own = numbers if _real(port.device) == real else own
    if own and own[2] and len(sockets[own]) == 1:
        return _link_to(real, links / "by-id") or device
    return _link_to(real, links / "by-path") or real


def holders(path: str, root: Path = ROOT) -> list[Holder]:
    """Return the other processes that have the port open, as far as this user is allowed to see them."""
    real, others = os.path.realpath(path), [each for each in _processes(root) if int(each.name) != os.getpid()]
    return [Holder(int(folder.name), _command(folder)) for folder in others if real in _open_files(folder)]


def rivals(path: str, root: Path = ROOT) -> list[tuple[str, str]]:
    """Return programs that use a port, or take it when it is plugged in, each in words with the command to free it."""
    name, found = os.path.basename(os.path.realpath(path)), []
    if name in (_line(root / "sys" / "class" / "tty" / "console" / "active") or "").split():
        fix = (
            "sudo raspi-config nonint do_serial_cons 1, or take console= of it out of the kernel's command line; reboot"
        )
        found.append(("is a login console: the kernel writes its messages to it", fix))
    for folder in _processes(root):
        program, words = _line(folder / "comm"), _command(folder).split()
        if program == "agetty" and name in words:
            fix = f"sudo systemctl disable --now serial-getty@{name}"
            found.append((f"serial-getty waits for a login on it (process {folder.name})", fix))
        elif program in _TAKERS and name.startswith(("ttyUSB", "ttyACM")):
            fix = f"sudo systemctl mask --now {program}"
            found.append((f"{program} {_TAKERS[program]} (process {folder.name})", fix))
    return found


def is_address(device: str) -> bool:
    """Return whether a device is a URL (socket://, rfc2217:// and similar); every other device is a path."""
    return "://" in device


def access_problem(path: str) -> str | None:
    """Return why this user cannot use a path, or an address, as a serial port; None if no reason is visible."""
    if is_address(path):
        return _address_problem(path)
    if os.name != "posix":
        return None  # COM3 is not a file
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return f"no such device{_meant(path)}"
    except OSError as error:
        return f"cannot be looked at: {error.strerror}"
    if stat.S_ISDIR(mode):
        return "is a directory, not a serial port"
    if not stat.S_ISCHR(mode):
        return "is a file, not a serial port"
    if not os.access(path, os.R_OK | os.W_OK):
        return "no permission to open it"
    return None


def _meant(path: str) -> str:
    """Return a hint on how to write the device that was probably meant by a path that does not exist."""
    if ":" in path and host_and_port(path) is not None:
        return f"; the port of a serial server is written socket://{path}"
    if path and (device := ROOT / "dev" / path).exists():
        return f"; it is written {device}"
    return "; COM ports are Windows'" if re.fullmatch(r"(?i)com\d+", path) else ""


def check_device(device: str, flag: str = "") -> None:
    """Raise PortError, with a remedy, if `device` cannot be a serial port; open nothing. `flag`: text prefix."""
    problem = access_problem(device)
    if problem is None:
        return
    if problem.startswith("no permission"):
        problem += f": sudo usermod -aG {group_of(device)} $USER, then log out and in again"
    elif not is_address(device):
        there = ", ".join(each.by_id or each.path for each in list_ports()) or "none"
        problem += f" (serial ports here: {there})"
    raise PortError(f"{flag}{device}: {problem}")


def _address_problem(url: str) -> str | None:
    """Return the problem of an address, None if it is complete; no connection is tried."""
    scheme = url.partition("://")[0]
    if scheme not in NETWORKED:
        choices = ", ".join(f"{each}://HOST:PORT" for each in NETWORKED)
        return f"no servos can be behind {scheme}:// (a device such as /dev/ttyUSB0 or COM3, {choices})"
    try:
        parts = urlsplit(url)
        complete = bool(parts.hostname) and parts.port is not None
    except ValueError:  # the port is not a number, or is out of range
        complete = False
    return None if complete else f"names no host and port to connect to ({scheme}://HOST:PORT)"


def group_of(path: str) -> str:
    """Return the group whose members may use the port. Example: dialout."""
    try:
        return Path(path).group()
    except (OSError, KeyError, NotImplementedError):  # Windows has no groups
        return "dialout"


def _real(device: str) -> str:
    """Return a path without links; on Windows return the device unchanged, since a COM port is not a path."""
    return os.path.realpath(device) if os.name == "posix" else device


def _link_to(real: str, folder: Path) -> str | None:
    return next((str(link) for link in sorted(folder.glob("*")) if os.path.realpath(link) == real), None)


def _processes(root: Path) -> list[Path]:
    """Return the folder of every process, in the order of their ids."""
    return sorted((root / "proc").glob("[0-9]*"), key=lambda each: int(each.name))


def _open_files(folder: Path) -> Iterator[str]:
    try:
        entries = os.listdir(folder / "fd")
    except OSError:
        return  # the process has ended, or belongs to another user
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


# --- values of --port -----------------------------------------------------------------------------------------------


def parse_ports(buses: Collection[str], text: str) -> dict[str, str]:
    """Return the device of each bus. `text` is `DEVICE` for a head of one bus, or `BUS=DEVICE[,BUS=DEVICE]`.

    Raises ConfigError for a bus that is missing, unknown or given twice, and for a device that two buses share.
    """
    if text and len(buses) == 1 and "," not in text and not _NAMED.match(text):
        return dict.fromkeys(buses, text)
    devices: dict[str, str] = {}
    for part in text.split(","):
        name, equals, device = part.partition("=")
        if not equals or not device or name not in buses:
            raise _wrong(text, "one device per bus is needed", buses)
        if name in devices:
            raise _wrong(text, f"bus {name} is given twice", buses)
        if device in devices.values():
            raise _wrong(text, f"{device} is given to two buses", buses)
        devices[name] = device
    if missing := [name for name in buses if name not in devices]:
        raise _wrong(text, f"bus {missing[0]} has no device", buses)
    return devices


def choose_ports(buses: Collection[str], ports: Sequence[SerialDevice]) -> dict[str, str]:
    """Return the device of the bus for `--port auto`: the only USB adapter in `ports`.

    Raises PortError without an adapter, and ConfigError that lists the adapters if there is a choice.
    """
    adapters = [port.path for port in ports if port.vendor is not None]
    if not adapters:
        raise PortError("--port auto: no USB serial adapter is plugged in (sfms-robot port list shows every port)")
    if len(buses) == len(adapters) == 1:
        return dict.fromkeys(buses, adapters[0])
    found = f"{len(adapters)} adapters may be bus {' or '.join(buses)}"
    raise ConfigError(f"--port auto: {found} ({', '.join(adapters)}); name one")


def _wrong(text: str, problem: str, buses: Collection[str]) -> ConfigError:
    wanted = ",".join(f"{name}=DEVICE" for name in buses) if len(buses) > 1 else f"DEVICE, {next(iter(buses))}=DEVICE"
    return ConfigError(f"--port {text!r}: {problem} (sim, {AUTO}, {wanted})")
