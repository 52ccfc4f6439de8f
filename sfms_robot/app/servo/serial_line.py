"""A serial line for the servo tools: any family, any rate, servos identified by their reports.

The tools cannot assume the rate, the id or the model of a servo. So a `Wire` can change its rate, searches for a servo
at every rate of its family, and selects the firmware map by the model number that the servo reports.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from shlex import quote
from typing import Final

from sfms_robot.app.options import SIM
from sfms_robot.config import load_firmware_map, load_head, map_files, variant
from sfms_robot.data import Report
from sfms_robot.emulator.launch import launch
from sfms_robot.errors import BusError, ConfigError, PortError, ServoError
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.chain.link import Answer, Found, RegisterLink, finish, looks_double, verified_write
from sfms_robot.servo.discovery import check_device, list_ports
from sfms_robot.servo.families import BusFamily, family_named, servo_families
from sfms_robot.servo.port import Port, SerialPort
from sfms_robot.servo.registers import Field, Table

Confirm = Callable[[str], bool]
Row = Report  # row of a table, and of --json

PATIENCE_S: Final = 0.05  # an adapter may hold an answer back for 16 ms, an emulator is late on a busy computer
TRIES: Final = 3


@dataclass(frozen=True, kw_only=True)
class FoundServo:
    """A servo that answered.

    Attributes:
        table: Its control table; None for a model without a firmware map.
        twice: True if two servos seem to have its id.
        wire: The wire on which it answered. The methods use the wire at its present rate.
    """

    id: int
    baud: int
    model_number: int | None
    firmware: int | None
    firmware_minor: int | None = None
    table: Table | None
    twice: bool = False
    wire: Wire = field(repr=False, compare=False)

    @property
    def model(self) -> str:
        return self.table.model if self.table else f"unknown ({self.model_number})"

    def registers(self) -> Table:
        """Return its control table. Raises ConfigError for a model without a firmware map."""
        if self.table is None:
            known = [*sorted(file.stem for file in map_files()), "or --model MODEL"]
            raise ConfigError.at(f"servo {self.id}", "model number", self.model_number, "has no firmware map", known)
        return self.table

    def taken_for(self, model: str) -> FoundServo:
        """Return this servo with the map of `model`, unless its model number belongs to another model.

        Some models have no number of their own, or share one.
        """
        number = load_firmware_map(model).model_number
        if number is not None and self.model_number not in (None, number):
            return self
        table = number and table_of(self.wire.family, self.model_number, self.firmware, model)
        return replace(self, table=table or Table.of(load_firmware_map(model)))

    def named(self, name: str) -> Field:
        """Return a register by its name or its role. Raises ConfigError that lists the valid names."""
        table = self.registers()
        found = table.fields.get(name) or table.role(name)
        if found is None:
            raise ConfigError.at(table.model, "register", name, "is unknown", table.fields)
        return found

    def row(self) -> Row:
        """Return the row of a report."""
        return {
            "id": self.id,
            "model": self.model,
            "model_number": self.model_number,
            "firmware": self.firmware,
            "firmware_minor": self.firmware_minor,
            "baud": self.baud,
            "family": self.wire.family,
            "note": "two servos with one id?" if self.twice else "",
        }

    def block(self, address: int, length: int, what: str) -> Answer:
        """Read a block of the control table. Raises ServoError if the servo is silent or refuses."""
        for _ in range(TRIES):
            answer = self.wire.link.read(self.id, address, length)
            if answer is not None:
                if refusal := self.wire.link.refusal(answer):
                    raise ServoError(f"id {self.id}: reading {what} was refused: {refusal}")
                return answer
        raise ServoError(f"id {self.id} does not answer when asked for {what} (status return level 0?)")

    def read(self, register: Field) -> int:
        """Read a register, raw. Raises ServoError if the servo is silent or refuses."""
        return register.from_bytes(self.block(register.address, register.size, register.name).data)

    def put(self, register: Field, raw: int) -> None:
        """Write a register and read it back; open the lock of the EEPROM if there is one. Raises ServoError."""
        lock = self.registers().role("lock")
        finish(verified_write(self.wire.link, self.id, register, raw, lock=lock, tries=TRIES))

    def guard(self, what: str, confirm: Confirm, mute: bool = False) -> None:
        """Check, before EEPROM is written, that torque is off, and ask. A `mute` servo cannot report torque.

        Raises ServoError if torque is on, ConfigError if the user declines.
        """
        torque = None if mute else self.registers().role("torque_enable")
        if torque is not None and self.read(torque):
            raise ServoError(
                f"id {self.id} has torque on, its EEPROM is closed: "
                f"{self.wire.command(f'write {self.id} {torque.name} 0')}"
            )
        ask(f"id {self.id} ({self.model}): {what}", confirm)


def ask(question: str, confirm: Confirm) -> None:
    """Raise ConfigError unless `confirm` returns True."""
    if not confirm(question):
        raise ConfigError(f"nothing was written: {question} (not confirmed)")


class Wire:
    """A port and the servos behind it. The caller opens and closes the port.

    Args:
        family: A name of `servo_families`.
        baud: The port's present rate; with `fixed` no other rate is tried.
        model: The model of every servo, regardless of its model number; None: the number decides.
        place: Options that make a command use this wire; by default those of the port.
    """

    def __init__(
        self,
        port: Port,
        family: str,
        baud: int,
        fixed: bool = False,
        model: str | None = None,
        place: str | None = None,
    ) -> None:
        self.port = port
        self.family = family
        self.kind = _family(family)
        self.model = model
        self._table = None if model is None else Table.of(load_firmware_map(model))
        self.bauds = (baud,) if fixed else (baud, *(each for each in self.kind.bauds if each != baud))
        self.baud = baud
        self.link = self._link(baud)
        which = "" if family == "dynamixel2" else f" --family {family}"
        self._place = place or f"--port {quote(port.name)}{which}"

    def command(self, words: str) -> str:
        """Return a `servo` command for this wire."""
        return f"sfms-robot servo {words} {self._place}"

    def at(self, baud: int) -> RegisterLink:
        """Change to another rate; return the link. Raises PortError when the adapter does not support it."""
        if baud != self.baud:
            self.port.set_baud(baud)
            self.port.discard_input()
            self.baud = baud
            self.link = self._link(baud)
        return self.link

    def ping(self, servo: int, tries: int = TRIES) -> FoundServo | None:
        """Return the servo of an id at the present rate, or None."""
        for _ in range(tries):
            found = self.link.ping(servo)
            if found is not None:
                return self._identified(servo, found)
        return None

    def answering(self, ids: Iterable[int] | None = None) -> Iterator[FoundServo]:
        """Yield the servos of `ids` that answer at the present rate; each is pinged once.

        None pings all servos: with one broadcast if the family has it, else id by id.
        """
        if ids is None and self.kind.broadcast:
            yield from (self._identified(servo, each) for servo, each in sorted(self.link.broadcast_ping().items()))
            return
        for servo in range(self.kind.max_id + 1) if ids is None else ids:
            if (seen := self.ping(servo, tries=1)) is not None:
                yield seen

    def find(self, servo: int) -> FoundServo:
        """Return a servo, at any rate at which it answers; the wire stays at that rate. Raises BusError."""
        self.check_id(servo)
        for _ in self.reachable():
            seen = self.ping(servo, TRIES if len(self.bauds) == 1 else 2)
            if seen is not None:
                return seen
        raise BusError(
            f"{self.port.name}: no answer from id {servo} at {', '.join(map(str, self.bauds))} baud "
            f"(look: {self.command('scan')})"
        )

    def reachable(self) -> Iterator[int]:
        """Yield every rate to try, with the wire set to it. Rates that the adapter does not support are skipped."""
        for baud in self.bauds:
            try:
                self.at(baud)
            except PortError:
                if len(self.bauds) == 1:
                    raise
                continue
            yield baud

    def has_duplicate(self, servo: int) -> bool:
        """Return whether two servos seem to have one id: each of several pings brings more than one clean answer."""
        return all(looks_double(self.port, self.kind.protocol, servo, PATIENCE_S) for _ in range(TRIES))

    def check_id(self, servo: int, what: str = "id") -> None:
        """Raise ConfigError for an id that no servo of the family can have."""
        if not 0 <= servo <= self.kind.max_id:
            raise ConfigError.at("servo", what, servo, "is not a servo id", [f"0..{self.kind.max_id}"])

    def _identified(self, servo: int, found: Found) -> FoundServo:
        table = self._table or table_of(self.family, found.model_number, found.firmware)
        return FoundServo(id=servo, baud=self.baud, **found._asdict(), table=table, wire=self)

    def _link(self, baud: int) -> RegisterLink:
        link: RegisterLink = self.kind.link_class()(self.port, baud, PATIENCE_S)
        return link


@contextmanager
def open_wire(port: str | None, family: str, baud: int | None, head: str, model: str | None = None) -> Iterator[Wire]:
    """Open a wire on a device, or on the emulated servos of `head` for `sim`; None: the only serial port.

    `baud` None: try every rate. Raises PortError, ConfigError.
    """
    kind, clock, place = _family(family), RealClock(), None
    check_baud(family, baud)
    with ExitStack() as stack:
        if port == SIM:
            # Importing the numerics of a head takes longer than most tools run.
            from sfms_robot.app.wiring import EmulatedPort, plugged_in

            described = load_head(head)
            board = family_named(next(iter(described.buses.values())).family)
            if board.board:
                raise ConfigError(f"--head {head}: its servos are on a {board.title}, which has no ids or registers")
            servos = next(iter(plugged_in(described).values()))
            chain, first = stack.enter_context(launch(servos)), servos[0].baud
            line: Port = EmulatedPort(chain.device, chain.control, baud or first, clock)
            place = f"--port {SIM} --head {quote(head)}"
        else:
            device, first = port or only_port(), kind.bauds[0]
            check_device(device)
            line = SerialPort(device, baud or first, clock)
        stack.callback(line.close)
        yield Wire(line, family, baud or first, fixed=baud is not None, model=model, place=place)


def check_baud(family: str, baud: int | None) -> None:
    """Raise ConfigError for a rate outside the range of the family: at 5 baud a request takes minutes."""
    kind = _family(family)
    if baud is not None and kind.bauds and not min(kind.bauds) <= baud <= max(kind.bauds):
        raise ConfigError(
            f"--baud {baud}: not a rate of {kind.title} servos ({', '.join(map(str, sorted(kind.bauds)))})"
        )


def only_port() -> str:
    """Return the only serial port of this computer. Raises ConfigError, with the list, if there is not one."""
    names = [each.by_id or each.path for each in list_ports()]
    if len(names) == 1:
        return names[0]
    there = "several serial ports" if names else "no serial port found"
    raise ConfigError(f"--port: {there}, say which ({', '.join([*names, SIM])})")


def table_of(family: str, number: int | None, firmware: int | None, model: str | None = None) -> Table | None:
    """Return the control table of a model number, or None; `model` is preferred if several share the number."""
    models = _models(family, tuple(map_files())).get(number, ()) if number is not None else ()
    if not models:
        return None
    name = model if model is not None and model in models else models[0]
    try:
        return Table.of(load_firmware_map(name) if firmware is None else variant(name, firmware))
    except ConfigError:
        return Table.of(load_firmware_map(name))  # a firmware newer than the maps: the known layout is the best guess


@cache
def _models(family: str, files: tuple[Path, ...]) -> Mapping[int, Sequence[str]]:
    """Return the models of each number. Searches the files for a few keys only: loading all maps takes a second."""
    wanted, protocol = _family(family).maps
    found: dict[int, list[tuple[bool, str]]] = {}
    for file in files:
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


# --- another protocol -----------------------------------------------------------------------------------------------

_FIRST_IDS: Final = 20
_ID_S: Final = 0.02  # an adapter may hold an answer back for 16 ms
_RATES: Final = 3  # number of rates tried for each family, those that are used most often


def other_wires(wire: Wire) -> Iterator[Wire]:
    """Yield a wire on the same port for each other family whose servos answer, at the rate at which they answer.

    Each family is tried at its usual rates: by a broadcast ping, or for protocol 1, whose frames the families share, by
    the first twenty ids. Takes at most 3 s on a silent wire, and restores its rate.
    """
    before = wire.baud
    try:
        for name, family in servo_families().items():
            for baud in family.bauds[:_RATES] if name != wire.family else ():
                with suppress(PortError):  # the adapter does not support this rate
                    wire.at(baud)
                    other = Wire(wire.port, name, baud, fixed=True)
                    other.link.silence_s = _ID_S
                    ids = None if family.protocol == 2 else range(1, _FIRST_IDS + 1)
                    if any(seen.table is not None for seen in other.answering(ids)):
                        yield other
                        break
    finally:
        wire.at(before)


def protocol_hint(wires: Iterable[Wire]) -> str:
    """Return the `--family` to type for servos that answer to another protocol (`other_wires`); empty for none."""
    return "; ".join(f"servos answer {each.kind.title} at {each.baud} baud: --family {each.family}" for each in wires)
