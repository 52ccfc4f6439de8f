"""From what `--port` says to one device per named bus of a head."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from typing import Final

from sfms_robot.errors import ConfigError, PortError
from sfms_robot.servo.discovery import SerialDevice

AUTO: Final = "auto"
_NAMED: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*=")  # a bus and its device; addresses and paths do not begin so

Probe = Callable[[str, str], bool]  # bus, device -> do servos of that bus answer there?


def parse_ports(buses: Collection[str], text: str) -> dict[str, str]:
    """`DEVICE` for a head of one bus, or `BUS=DEVICE[,BUS=DEVICE]` -> device per bus.

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


def choose_ports(buses: Collection[str], ports: Sequence[SerialDevice], probe: Probe | None = None) -> dict[str, str]:
    """`--port auto`: the one device per bus that it can only be, among the USB adapters of `ports`.

    One adapter and one bus need no question. Otherwise `probe` asks each adapter for the servos of each bus; it blocks
    for as long as its question takes. Raises PortError without an adapter, and ConfigError naming the adapters where
    there is a choice.
    """
    adapters = [port.path for port in ports if port.vendor is not None]
    if not adapters:
        raise PortError("--port auto: no USB serial adapter is plugged in (sfms-robot port list shows every port)")
    if len(buses) == len(adapters) == 1:
        return dict.fromkeys(buses, adapters[0])
    chosen: dict[str, str] = {}
    for bus in buses:
        answering = [device for device in adapters if probe is None or probe(bus, device)]
        if len(answering) != 1 or answering[0] in chosen.values():
            found = f"{len(answering)} adapters may be" if answering else "no adapter has the servos of"
            raise ConfigError(f"--port auto: {found} bus {bus} ({', '.join(answering or adapters)}); name one")
        chosen[bus] = answering[0]
    return chosen


def _wrong(text: str, problem: str, buses: Collection[str]) -> ConfigError:
    wanted = ",".join(f"{name}=DEVICE" for name in buses) if len(buses) > 1 else f"DEVICE, {next(iter(buses))}=DEVICE"
    return ConfigError(f"--port {text!r}: {problem} (sim, {AUTO}, {wanted})")
