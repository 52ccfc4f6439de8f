"""The table of bus families: the class that drives each, and its name in the tools. Classes are imported on use.

Another package adds a family by an entry point of the group `sfms_robot.buses` (`plugins`). The name of the entry point
is the name of the family, and its value loads a `BusFamily`.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cache
from importlib.metadata import EntryPoint
from typing import Any, Final

from sfms_robot.config.joint import BUS_GROUP
from sfms_robot.errors import ConfigError
from sfms_robot.plugins import plug_in, plugin_error, plugins

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BusFamily:
    """Servos, or boards of servos, that are driven by one class.

    Attributes:
        title: name shown to users.
        bus: "module:class" of its `ports.Bus`, called with (name, servos, conversion, open_port, baud, read_deadline_s)
            and `config`; for servos also with `faults`, for a board with `confirmed` and `rest_rad` (see `PulseBus`).
        maps: (family, protocol) of its firmware maps; the protocol is None for a board.
        link: "module:class" of the `RegisterLink` that the tools use, called with (port, baud, silence_s); None for a
            board, whose servos have no registers, and for servos that the tools do not support.
        bauds: bits per second that its servos may be set to, the most frequent first.
        max_id: highest id of a servo.
        broadcast: whether one ping reaches all servos.
    """

    title: str
    bus: str
    maps: tuple[str, int | None]
    _: KW_ONLY
    link: str | None = None
    bauds: tuple[int, ...] = ()
    max_id: int = 253
    broadcast: bool = False

    @property
    def board(self) -> bool:
        """Return whether its servos report nothing, not even their position."""
        return self.maps[1] is None

    @property
    def protocol(self) -> int:
        """Return the servo protocol, 1 or 2. Raises ConfigError for a board."""
        if self.maps[1] is None:
            raise ConfigError(f"{self.title}: a board speaks no servo protocol")
        return self.maps[1]

    def build(self, *arguments: Any, **more: Any) -> Any:
        """Return its bus, constructed with the arguments; without any, its class. Raises ConfigError (`plug_in`)."""
        return plug_in(EntryPoint(self.title, self.bus, BUS_GROUP), *arguments, **more)

    def link_class(self) -> Any:
        """Return the class of its links. Raises ConfigError for a board, and for a family without tools."""
        if self.link is None:
            why = "a board has no registers to read or write" if self.board else "the servo tools do not speak to it"
            raise ConfigError(f"{self.title}: {why}")
        return plug_in(EntryPoint(self.title, self.link, BUS_GROUP))


_CHAIN: Final = "sfms_robot.servo.chain"
_BOARDS: Final = "sfms_robot.servo.pulse_bus:PulseBus"
_OWN: Final = {
    "dynamixel2": BusFamily(
        "Dynamixel 2.0",
        f"{_CHAIN}.protocol2:Dynamixel2Bus",
        ("dynamixel", 2),
        link=f"{_CHAIN}.protocol2:Dynamixel2Link",
        bauds=(1_000_000, 57_600, 4_000_000, 2_000_000, 3_000_000, 115_200, 9_600, 4_500_000),
        max_id=252,
        broadcast=True,
    ),
    "dynamixel1": BusFamily(
        "Dynamixel 1.0",
        f"{_CHAIN}.protocol1:Dynamixel1Bus",
        ("dynamixel", 1),
        link=f"{_CHAIN}.protocol1:Dynamixel1Link",
        bauds=(1_000_000, 57_600, 115_200, 500_000, 200_000, 250_000, 400_000, 19_200, 9_600),
    ),
    "feetech": BusFamily(
        "Feetech",
        f"{_CHAIN}.protocol1:FeetechBus",
        ("feetech", 1),
        link=f"{_CHAIN}.protocol1:FeetechLink",
        bauds=(1_000_000, 115_200, 500_000, 57_600, 38_400, 250_000, 128_000, 76_800),
        broadcast=True,
    ),
    "maestro": BusFamily("Pololu Maestro", _BOARDS, ("maestro", None)),
    "ssc32": BusFamily("Lynxmotion SSC-32", _BOARDS, ("ssc32", None)),
}


@cache
def families() -> Mapping[str, BusFamily]:
    """Return all families by name: our own, then those of other packages. A failed plug-in is logged and left out."""
    found = dict(_OWN)
    for name, entry in plugins(BUS_GROUP).items():
        try:
            found[name] = _family_of(entry)
        except ConfigError as error:
            log.warning("%s; it is left out", error)
    return found


def _family_of(entry: EntryPoint) -> BusFamily:
    """Return the family of a plug-in. Raises ConfigError."""
    if entry.name in _OWN:
        raise plugin_error(entry, "expected a name that no family of sfms-robot has")
    family = plug_in(entry)
    if not isinstance(family, BusFamily):
        raise plugin_error(entry, f"expected a BusFamily, got {type(family).__name__}")
    return family


def servo_families() -> Mapping[str, BusFamily]:
    """Return the families that the servo tools support (those with a link), by name."""
    return {name: family for name, family in families().items() if family.link is not None}


def family_named(name: str) -> BusFamily:
    """Return a family by its name.

    Raises ConfigError with the valid names, or with the error of the plug-in that defines it.
    """
    known = families()
    if name not in known:
        if entry := plugins(BUS_GROUP).get(name):
            return _family_of(entry)
        raise ConfigError.at("buses", "family", name, "is unknown", known)
    return known[name]
