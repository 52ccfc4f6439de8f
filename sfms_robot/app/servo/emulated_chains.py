"""`sfms-robot emulate`: servos to plug software into, without servos.

Changes to the servos before the host comes are given for ids of a wire: `stored` 3,5-7:min_position_limit=1900 (raw
values of registers), `starts` 3=4150 (the position it reads, ticks; beyond a limit or one turn, too).
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
_CHANGE: Final = re.compile(r"(?P<ids>[0-9,-]+)(:(?P<register>\w+))?=(?P<value>-?\d+)")
_FORMS: Final = {
    "stored": "IDS:REGISTER=VALUE, as in 3:min_position_limit=1900",
    "start": "IDS=TICKS, as in 3=4150",
}


@dataclass(frozen=True, kw_only=True)
class EmulateOptions:
    """The servos to plug in (a head or a list), and how they behave. Each as in `cli.emulate_command`."""

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
    """Start the chains, one per bus; a list of servos is the bus "servos". Raises ConfigError, BusError."""
    wires = _servos(options)
    faults = _faults(options.faults)
    with ExitStack() as stack:
        chains = {}
        for bus, servos in wires.items():
            chain = launch(
                servos,
                options.virtual,
                timing=options.timing,
                behind_silent=options.behind_silent,
                faults=faults,
                seed=options.seed,
                link=options.link if options.link is None or len(wires) == 1 else f"{options.link}-{bus}",
            )
            chains[bus] = stack.enter_context(chain)
        yield chains


def described(chains: Mapping[str, Chain], head: str | None) -> dict[str, Any]:
    """Return the devices and their servos as plain data for `--json`."""
    joints = {} if head is None else {(j.bus, j.id): name for name, j in load_head(head).joints.items()}
    buses = {}
    for bus, chain in chains.items():
        servos = [
            {"id": s.id, "model": s.model, "baud": s.baud, "joint": joints.get((bus, s.id))} for s in chain.servos
        ]
        buses[bus] = {"device": chain.device, "control": chain.control, "servos": servos}
    return {"head": head, "buses": buses}


def until_stopped(chains: Mapping[str, Chain]) -> None:
    """Block until SIGTERM or SIGINT, which end the program with code 0. Raises BusError when a chain dies before."""

    def leave(number: int, frame: FrameType | None) -> None:
        sys.exit(0)  # unwinds, so that chains and links are removed

    for each in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(each, leave)
    raise BusError(f"the emulated chain {wait(list(chains.values())).device} has ended")


def _servos(options: EmulateOptions) -> dict[str, list[EmulatedServo]]:
    if (options.head is None) == (options.servo is None):
        raise ConfigError("emulate needs either --head NAME or --servo MODEL:IDS[,MODEL:IDS...]")
    if options.head is not None:
        from sfms_robot.app.wiring import plugged_in  # brings numpy and all that drives a head: a list needs none

        wires = plugged_in(options.head, load_head(options.head))
    else:
        wires = {"servos": parse_servos(options.servo or "")}
    settings: dict[str, Any] = {} if options.baud is None else {"baud": options.baud}
    settings |= {} if options.voltage is None else {"supply_v": options.voltage}
    out = {bus: [replace(servo, **settings) for servo in servos] for bus, servos in wires.items()}
    for option, text in [*(("stored", text) for text in options.stored), *(("start", text) for text in options.starts)]:
        ids, register, value = _change(option, text, out)
        for servos in out.values():
            servos[:] = [_changed(servo, register, value) if servo.id in ids else servo for servo in servos]
    return out


def _changed(servo: EmulatedServo, register: str | None, value: int) -> EmulatedServo:
    if register is None:
        return replace(servo, start_ticks=value)
    return replace(servo, registers={**servo.registers, register: value})


def _change(
    option: str, text: str, wires: Mapping[str, Sequence[EmulatedServo]]
) -> tuple[frozenset[int], str | None, int]:
    """Return (ids, register, value) of an option. Raises ConfigError for a bad one, and for ids of no servo."""
    found = _CHANGE.fullmatch(text.strip())
    if found is None or (found["register"] is None) != (option == "start"):
        raise ConfigError.at("emulate", option, text, f"cannot be read: {_FORMS[option]}")
    there = {servo.id for servos in wires.values() for servo in servos}
    ids = _ids(option, text, found["ids"])
    if missing := sorted(ids - there):
        raise ConfigError.at("emulate", option, text, f"names {missing[0]}, which no servo has", sorted(there))
    return ids, found["register"], whole_number(found["value"])


def _ids(option: str, text: str, ids: str) -> frozenset[int]:
    try:
        return parse_ids(ids)
    except ValueError:
        raise ConfigError.at("emulate", option, text, f"holds bad ids: {ids!r}", ["0..252"]) from None


def parse_servos(text: str) -> list[EmulatedServo]:
    """Read `xl330-m288:1-9,12,ax-12a:20`; return servos in the middle of their range. Raises ConfigError."""
    out: list[EmulatedServo] = []
    model = ""
    for part in text.split(","):
        ids = part.strip()
        if not _MORE_IDS.fullmatch(ids) or not model:
            model, colon, ids = ids.rpartition(":")
            if not colon or not model:
                form = "MODEL:IDS, as in xl330-m288:1-9"
                raise ConfigError.at("emulate", "servo", text, f"has no id for {part.strip()!r}: {form}")
        table = load_firmware_map(model)
        numbers = sorted(_ids("servo", text, ids))
        out += [EmulatedServo(i, model, _baud(table), table.center_ticks) for i in numbers]
    return out


def _baud(table: FirmwareMap) -> int:
    rates = table.baud_codes.values()
    if not rates:
        return _BOARD_BAUDS.get(table.family, USUAL_BAUD)
    return USUAL_BAUD if USUAL_BAUD in rates else max(rates)


def _faults(texts: tuple[str, ...]) -> list[str]:
    """Return specs unchanged, and those of a file: one in a line, `#` starts a comment."""
    out: list[str] = []
    for text in texts:
        file = Path(text)
        lines = file.read_text().splitlines() if file.is_file() else None
        out += [text] if lines is None else [spec for line in lines if (spec := line.partition("#")[0].strip())]
    return out
