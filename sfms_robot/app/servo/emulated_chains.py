"""`sfms-robot emulate`: servos to plug software into, without servos.

What somebody did to the servos before the host comes is told for ids of a wire: `stored` 3,5-7:min_position_limit=1900
(raw values of registers), `starts` 3=4150 (what its position reads, ticks; beyond a limit or one turn, too).
"""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, Final, Literal

from sfms_robot.config import FirmwareMap, load_firmware_map, load_head
from sfms_robot.emulator.faults import parse_ids
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch, wait
from sfms_robot.endpoint import whole_number
from sfms_robot.errors import BusError, ConfigError

USUAL_BAUD: Final = 1_000_000
_BOARD_BAUDS: Final = {"maestro": 115_200, "ssc32": 9_600}
_MORE_IDS: Final = re.compile(r"\d+(-\d+)?")
_STORED: Final = re.compile(r"(?P<ids>[0-9,-]+):(?P<register>\w+)=(?P<value>-?\d+)")
_START: Final = re.compile(r"(?P<ids>[0-9,-]+)=(?P<value>-?\d+)")


@dataclass(frozen=True)
class EmulateOptions:
    """What to plug in (a head or a list of servos), and how it behaves. Each as in `cli.emulate_command`."""

    head: str | None = None
    servo: str | None = None
    link: str | None = None
    timing: Literal["wire", "instant"] = "wire"
    baud: int | None = None
    voltage: float | None = None
    faults: tuple[str, ...] = ()
    virtual: bool = False
    behind_silent: Literal["chain_break", "skip"] = "chain_break"
    seed: int = 0
    stored: tuple[str, ...] = ()
    starts: tuple[str, ...] = ()


@contextmanager
def emulators(options: EmulateOptions) -> Iterator[dict[str, Chain]]:
    """The running chains, one per bus; a list of servos is the bus "servos". Raises ConfigError, BusError."""
    wires = _servos(options)
    faults = _faults(options.faults)
    with ExitStack() as stack:
        chains = {}
        for bus, servos in wires.items():
            link = options.link if options.link is None or len(wires) == 1 else f"{options.link}-{bus}"
            chains[bus] = stack.enter_context(
                launch(
                    servos,
                    options.virtual,
                    timing=options.timing,
                    behind_silent=options.behind_silent,
                    faults=faults,
                    seed=options.seed,
                    link=link,
                )
            )
        yield chains


def described(chains: Mapping[str, Chain], head: str | None) -> dict[str, Any]:
    """What is plugged in where, as plain data for `--json`."""
    joints = {} if head is None else {(j.bus, j.id): name for name, j in load_head(head).joints.items()}
    return {
        "head": head,
        "buses": {
            bus: {
                "device": chain.device,
                "control": chain.control,
                "servos": [
                    {"id": s.id, "model": s.model, "baud": s.baud, "joint": joints.get((bus, s.id))}
                    for s in chain.servos
                ],
            }
            for bus, chain in chains.items()
        },
    }


def until_stopped(chains: Mapping[str, Chain]) -> None:
    """Block until SIGTERM or SIGINT, which end the program with code 0. Raises BusError when a chain ends by itself."""

    def leave(number: int, frame: FrameType | None) -> None:
        sys.exit(0)  # unwinds, so that chains and links are removed

    for each in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(each, leave)
    raise BusError(f"the emulated chain {wait(list(chains.values())).device} ended by itself")


def _servos(options: EmulateOptions) -> dict[str, list[EmulatedServo]]:
    if (options.head is None) == (options.servo is None):
        raise ConfigError("emulate needs either --head NAME or --servo MODEL:IDS[,MODEL:IDS...]")
    if options.head is not None:
        from sfms_robot.app.wiring import plugged_in  # brings numpy and all that drives a head: a list needs none

        wires = plugged_in(options.head, load_head(options.head))
    else:
        wires = {"servos": parse_servos(options.servo or "")}
    settings: dict[str, Any] = {}
    if options.baud is not None:
        settings["baud"] = options.baud
    if options.voltage is not None:
        settings["supply_v"] = options.voltage
    out = {bus: [replace(servo, **settings) for servo in servos] for bus, servos in wires.items()}
    for text in options.stored:
        ids, found = _of_ids("stored", text, _STORED, "IDS:REGISTER=VALUE, as in 3:min_position_limit=1900", out)
        for servos in out.values():
            for i, servo in enumerate(servos):
                if servo.id in ids:
                    registers = {**servo.registers, found["register"]: whole_number(found["value"])}
                    servos[i] = replace(servo, registers=registers)
    for text in options.starts:
        ids, found = _of_ids("start", text, _START, "IDS=TICKS, as in 3=4150", out)
        for servos in out.values():
            servos[:] = [replace(s, start_ticks=whole_number(found["value"])) if s.id in ids else s for s in servos]
    return out


def _of_ids(
    option: str, text: str, form: re.Pattern[str], wanted: str, wires: Mapping[str, Sequence[EmulatedServo]]
) -> tuple[frozenset[int], re.Match[str]]:
    """Ids named by an option, and the rest of it. Raises ConfigError for what cannot be read, and for ids of nobody."""
    found = form.fullmatch(text.strip())
    if found is None:
        raise ConfigError.at("emulate", option, text, f"cannot be read: {wanted}")
    there = {servo.id for servos in wires.values() for servo in servos}
    try:
        ids = parse_ids(found["ids"])
    except ValueError:
        raise ConfigError.at("emulate", option, text, "holds ids that are none", ["0..252"]) from None
    if missing := sorted(ids - there):
        raise ConfigError.at("emulate", option, text, f"names {missing[0]}, which nobody has", sorted(there))
    return ids, found


def parse_servos(text: str) -> list[EmulatedServo]:
    """`xl330-m288:1-9,12,ax-12a:20` -> servos in the middle of their range. Raises ConfigError."""
    out: list[EmulatedServo] = []
    model = ""
    for part in text.split(","):
        ids = part.strip()
        if not _MORE_IDS.fullmatch(ids) or not model:
            model, colon, ids = ids.rpartition(":")
            if not colon or not model:
                raise ConfigError.at(
                    "emulate", "servo", text, f"has no id for {part.strip()!r}: MODEL:IDS, as in xl330-m288:1-9"
                )
        table = load_firmware_map(model)
        try:
            numbers = sorted(parse_ids(ids))
        except ValueError:
            raise ConfigError.at("emulate", "servo", text, f"holds ids that are none: {ids!r}", ["0..252"]) from None
        out += [EmulatedServo(i, model, _baud(table), table.center_ticks) for i in numbers]
    return out


def _baud(table: FirmwareMap) -> int:
    rates = table.baud_codes.values()
    if not rates:
        return _BOARD_BAUDS.get(table.family, USUAL_BAUD)
    return USUAL_BAUD if USUAL_BAUD in rates else max(rates)


def _faults(texts: tuple[str, ...]) -> list[str]:
    """Specs as they are; a file holds one in a line, `#` starts a comment."""
    out: list[str] = []
    for text in texts:
        file = Path(text)
        if not file.is_file():
            out.append(text)
            continue
        lines = (line.partition("#")[0].strip() for line in file.read_text().splitlines())
        out += [line for line in lines if line]
    return out
