"""One serial line as the servo tools see it: any family, any rate, servos known by what they say of themselves.

The tools meet servos of which nothing is certain, neither rate nor id nor model. So a `Wire` can change its rate,
looks for a servo at every rate its family has, and picks the firmware map by the model number it reads.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from sfms_robot.config import load_firmware_map, load_head, map_files, variant
from sfms_robot.emulator.launch import launch
from sfms_robot.errors import BusError, ConfigError, PortError
from sfms_robot.ports import Clock
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.chain.link import Found, RegisterLink
from sfms_robot.servo.discovery import access_problem, is_address, list_ports
from sfms_robot.servo.families import BusFamily, family_named, servo_families
from sfms_robot.servo.port import Port, SerialPort
from sfms_robot.servo.registers import Table

SIM: Final = "sim"
PATIENCE_S: Final = 0.05  # an adapter may hold an answer back for 16 ms, an emulator is late on a busy computer
TRIES: Final = 3


@dataclass(frozen=True)
class FoundServo:
    """A servo that answered. `table` is None for a model without a firmware map; `twice`: there seem to be two."""

    id: int
    baud: int
    model_number: int | None
    firmware: int | None
    table: Table | None
    twice: bool = False

    @property
    def model(self) -> str:
        return self.table.model if self.table else f"unknown ({self.model_number})"

    def registers(self) -> Table:
        """Its control table. Raises ConfigError for a model without a firmware map."""
        if self.table is None:
            known = sorted(file.stem for file in map_files())
            raise ConfigError.at(
                f"servo {self.id}",
                "model number",
                self.model_number,
                "has no firmware map",
                [*known, "or --model MODEL"],
            )
        return self.table

    def row(self) -> dict[str, Any]:
        return {
            "id": self.id,
            "model": self.model,
            "model_number": self.model_number,
            "firmware": self.firmware,
            "baud": self.baud,
            "note": "two servos with one id?" if self.twice else "",
        }


class Wire:
    """A port and whoever hangs on it.

    Args:
        port: owned by whoever made it.
        family: a name of `servo_families`.
        baud: the port's rate now; with `fixed` no other rate is looked at.
        model: what every servo is taken for, whatever its number; None goes by the number.
    """

    def __init__(
        self, port: Port, family: str, clock: Clock, baud: int, fixed: bool = False, model: str | None = None
    ) -> None:
        self.port = port
        self.family = family
        self.kind = _family(family)
        self.clock = clock
        self._taken_for = None if model is None else Table.of(load_firmware_map(model))
        self.bauds = (baud,) if fixed else (baud, *(each for each in self.kind.bauds if each != baud))
        self.baud = baud
        self.link = self._link(baud)

    def at(self, baud: int) -> RegisterLink:
        """The link at another rate. Raises PortError when the adapter cannot do it."""
        if baud != self.baud:
            self.port.set_baud(baud)
            self.port.discard_input()
            self.baud = baud
            self.link = self._link(baud)
        return self.link

    def ping(self, servo: int, tries: int = TRIES) -> FoundServo | None:
        """The servo at the rate of now, or None."""
        for _ in range(tries):
            found = self.link.ping(servo)
            if found is not None:
                return self.identified(servo, found)
        return None

    def find(self, servo: int) -> FoundServo:
        """The servo, at whatever rate it answers; the wire stays at that rate. Raises BusError."""
        self.check_id(servo)
        for _ in self.reachable():
            seen = self.ping(servo, TRIES if len(self.bauds) == 1 else 2)
            if seen is not None:
                return seen
        rates = ", ".join(str(baud) for baud in self.bauds)
        raise BusError(f"{self.port.name}: no answer from id {servo} at {rates} baud (look: sfms-robot servo scan)")

    def reachable(self) -> Iterator[int]:
        """Every rate to look at, the wire set to it; rates that the adapter cannot do are passed over."""
        for baud in self.bauds:
            try:
                self.at(baud)
            except PortError:
                if len(self.bauds) == 1:
                    raise
                continue
            yield baud

    def identified(self, servo: int, found: Found) -> FoundServo:
        """What answered, with its firmware map."""
        table = self._taken_for or table_of(self.family, found.model_number, found.firmware)
        return FoundServo(servo, self.baud, found.model_number, found.firmware, table)

    def check_id(self, servo: int, what: str = "id") -> None:
        if not 0 <= servo <= self.kind.max_id:
            raise ConfigError.at("servo", what, servo, "is not a servo id", [f"0..{self.kind.max_id}"])

    def _link(self, baud: int) -> RegisterLink:
        link: RegisterLink = self.kind.link_class()(self.port, baud, PATIENCE_S)
        return link


@contextmanager
def open_wire(
    port: str | None, family: str, baud: int | None, head: str, clock: Clock, model: str | None = None
) -> Iterator[Wire]:
    """A wire on a device, or on emulated servos for `sim`; the only serial port there is when `port` is None.

    `baud` None means: look at every rate. Raises PortError, ConfigError.
    """
    kind = _family(family)
    check_baud(family, baud)
    with ExitStack() as stack:
        if port == SIM:
            from sfms_robot.app.wiring import plugged_in  # its numerics take longer to load than most tools to run

            described = load_head(head)
            hangs_on = family_named(next(iter(described.buses.values())).family)
            if hangs_on.board:
                raise ConfigError(
                    f"--head {head}: its servos hang on a {hangs_on.title}: no ids or registers to look at"
                )
            servos = next(iter(plugged_in(head, described).values()))
            device, first = stack.enter_context(launch(servos)).device, servos[0].baud
        else:
            device, first = port or only_port(), kind.bauds[0]
            check_device(device)
        line = SerialPort(device, baud or first, clock)
        stack.callback(line.close)
        yield Wire(line, family, clock, baud or first, baud is not None, model)


def check_baud(family: str, baud: int | None) -> None:
    """Raises ConfigError for a rate beyond those of the family: at 5 baud a question takes minutes."""
    kind = _family(family)
    if baud is not None and kind.bauds and not min(kind.bauds) <= baud <= max(kind.bauds):
        rates = ", ".join(str(each) for each in sorted(kind.bauds))
        raise ConfigError(f"--baud {baud}: no rate of {kind.title} servos ({rates})")


def real_clock() -> Clock:
    """Time as it passes."""
    return RealClock()


def only_port() -> str:
    """The serial port of a computer that has one. Raises ConfigError naming those it has."""
    ports = list_ports()
    if len(ports) == 1:
        return ports[0].by_id or ports[0].path
    names = [each.by_id or each.path for each in ports]
    there = "several serial ports" if names else "no serial port here"
    raise ConfigError(f"--port: {there}, say which ({', '.join([*names, SIM])})")


def check_device(device: str) -> None:
    """Raises PortError for a path that cannot be a serial port, before anything is opened."""
    problem = access_problem(device)
    if problem is not None and is_address(device):
        raise PortError(f"{device}: {problem}")
    if problem is not None and "permission" not in problem:  # opening says what to do about permissions
        there = ", ".join(each.by_id or each.path for each in list_ports()) or "none"
        raise PortError(f"{device}: {problem} (serial ports here: {there})")


def table_of(family: str, number: int | None, firmware: int | None, model: str | None = None) -> Table | None:
    """Control table of a model number; `model` is preferred where several share it. None when no map has it."""
    models = _models(family).get(number, ()) if number is not None else ()
    if not models:
        return None
    name = model if model is not None and model in models else models[0]
    try:
        return Table.of(load_firmware_map(name) if firmware is None else variant(name, firmware))
    except ConfigError:
        return Table.of(load_firmware_map(name))  # a firmware newer than the maps: the layout known is the best guess


@cache
def _models(family: str) -> Mapping[int, Sequence[str]]:
    """Model number -> models. Reads only the heads of the files: loading all of them takes a second."""
    wanted, protocol = _family(family).maps
    found: dict[int, list[tuple[bool, str]]] = {}
    for file in map_files():
        text = file.read_text(encoding="utf-8")
        keys = dict(re.findall(r"^(model_number|family|protocol|variant_of|same_number_as): *([^\s#]+)", text, re.M))
        if keys.get("family") == wanted and keys.get("protocol") == str(protocol) and "variant_of" not in keys:
            if keys.get("model_number", "").isdigit():
                found.setdefault(int(keys["model_number"]), []).append(("same_number_as" in keys, file.stem))
    return {number: [name for _, name in sorted(rows)] for number, rows in found.items()}


def _family(name: str) -> BusFamily:
    if name not in servo_families():
        raise ConfigError.at("servo tools", "family", name, "is unknown", servo_families())
    return servo_families()[name]
