"""Which serial ports there are, who may and who does use them, and how long their adapters hold bytes back.

Everything is read from the file system and nothing is opened. The roots of /dev, /sys and /proc are arguments, so
that all of it can be tried on a made-up tree.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

DEV: Final = Path("/dev")
SYS: Final = Path("/sys")
PROC: Final = Path("/proc")

_PATTERNS: Final = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyTHS*", "ttySC*", "rfcomm*")


@dataclass(frozen=True)
class SerialDevice:
    """One serial port. What the adapter does not tell is None.

    Attributes:
        path: device file, as in /dev/ttyUSB0.
        by_id: its name that survives replugging, as in /dev/serial/by-id/usb-FTDI_..., if there is one.
        vendor, product: USB numbers, four hex digits each.
        serial: USB serial number.
        driver: kernel driver. Example: ftdi_sio.
        latency_ms: how long the adapter collects bytes before it hands them over.
        latency_file: where that is set.
    """

    path: str
    by_id: str | None = None
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


def list_ports(dev: Path = DEV, sys: Path = SYS) -> list[SerialDevice]:
    """Serial ports that servos may hang on, by path."""
    found = sorted(path for pattern in _PATTERNS for path in dev.glob(pattern))
    return [describe(str(path), dev, sys) for path in found]


def describe(path: str, dev: Path = DEV, sys: Path = SYS) -> SerialDevice:
    """What is known of a port; `path` may be a link to it."""
    real = Path(os.path.realpath(path))
    name = real.name
    usb = _usb_folder(sys / "class" / "tty" / name / "device")
    driver = sys / "class" / "tty" / name / "device" / "driver"
    latency = sys / "bus" / "usb-serial" / "devices" / name / "latency_timer"
    text = _line(latency)
    return SerialDevice(
        path=str(real),
        by_id=_by_id(real, dev),
        vendor=_line(usb / "idVendor") if usb else None,
        product=_line(usb / "idProduct") if usb else None,
        serial=_line(usb / "serial") if usb else None,
        description=_line(usb / "product") if usb else None,
        driver=os.path.basename(os.path.realpath(driver)) if driver.exists() else None,
        latency_ms=int(text) if text is not None and text.isdigit() else None,
        latency_file=str(latency) if text is not None else None,
    )


def holders(path: str, proc: Path = PROC) -> list[Holder]:
    """Processes that have the port open, as far as this user may see; this one is left out."""
    real = os.path.realpath(path)
    found = []
    for folder in sorted(proc.glob("[0-9]*"), key=lambda each: int(each.name)):
        if int(folder.name) != os.getpid() and any(target == real for target in _open_files(folder)):
            found.append(Holder(int(folder.name), _command(folder)))
    return found


def access_problem(path: str) -> str | None:
    """Why this user cannot use `path` as a serial port; None when nothing speaks against it."""
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


def group_of(path: str) -> str:
    """The group whose members may use the port. Example: dialout."""
    try:
        return Path(path).group()
    except (OSError, KeyError):
        return "dialout"


def _usb_folder(device: Path) -> Path | None:
    """The USB device that a tty belongs to: the first folder upwards that has an idVendor."""
    real = Path(os.path.realpath(device))
    return next((folder for folder in (real, *real.parents) if (folder / "idVendor").is_file()), None)


def _by_id(real: Path, dev: Path) -> str | None:
    links = sorted((dev / "serial" / "by-id").glob("*"))
    return next((str(link) for link in links if os.path.realpath(link) == str(real)), None)


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
