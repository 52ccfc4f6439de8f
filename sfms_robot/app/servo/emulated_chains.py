"""`sfms-robot emulate`: emulated servos that other software can use without hardware.

Servos can be changed by their ids before the host connects: `stored` 3,5-7:min_position_limit=1900 sets raw values of
registers, `starts` 3=4150 sets the position that a servo reports (ticks; it may be beyond a limit or one turn).
"""

from __future__ import annotations

import re
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

from sfms_robot.config import load_firmware_map, load_head
from sfms_robot.data import Report
from sfms_robot.emulator.faults import parse_ids
from sfms_robot.emulator.launch import BehindSilent, Chain, EmulatedServo, Timing, launch
from sfms_robot.endpoint import whole_number
from sfms_robot.errors import BusError, ConfigError

_POLL_S: Final = 0.2
USUAL_BAUD: Final = 1_000_000
_BOARD_BAUDS: Final = {"maestro": 115_200, "ssc32": 9_600}
_MORE_IDS: Final = re.compile(r"\d+(-\d+)?")
_CHANGE: Final = re.compile(r"(?P<ids>[0-9,-]+)(:(?P<register>\w+))?=(?P<value>-?\d+)")
_FORMS: Final = {"stored": "IDS:REGISTER=VALUE, as in 3:min_position_limit=1900", "start": "IDS=TICKS, as in 3=4150"}


@contextmanager
def emulators(
    *,
    head: str | None = None,
    servo: str | None = None,
    link: str | None = None,
    timing: Timing = "wire",
    baud: int | None = None,
    voltage: float | None = None,
    faults: Sequence[str] = (),
    virtual: bool = False,
    behind_silent: BehindSilent = "chain_break",
    seed: int = 0,
    stored: Sequence[str] = (),
    starts: Sequence[str] = (),
) -> Iterator[dict[str, Chain]]:
    """Start the chains of a head or of a list of servos, one per bus; a list is the bus "servos".

    The arguments are the options of `cli.emulate_command`. Raises ConfigError, BusError.
    """
    given: Report = {"baud": baud, "supply_v": voltage}
    settings = {key: value for key, value in given.items() if value is not None}
    if (head is None) == (servo is None):
        raise ConfigError("emulate needs either --head NAME or --servo MODEL:IDS[,MODEL:IDS...]")
    if head is not None:
        from sfms_robot.app.wiring import plugged_in  # imports numpy and more, which a list does not need

        wires = plugged_in(load_head(head))
    else:
        wires = {"servos": parse_servos(servo or "")}
    for servos in wires.values():
        servos[:] = [replace(each, **settings) for each in servos]
    for option, texts in (("stored", stored), ("start", starts)):
        for text in texts:
            _change(option, text, wires.values())
    with ExitStack() as stack:
        chains = {}
        for bus, servos in wires.items():
            chain = launch(
                servos,
                virtual,
                timing=timing,
                behind_silent=behind_silent,
                faults=_faults(faults),
                seed=seed,
                link=link if link is None or len(wires) == 1 else f"{link}-{bus}",
            )
            chains[bus] = stack.enter_context(chain)
        yield chains


def described(chains: Mapping[str, Chain], head: str | None) -> Report:
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
    """Block until Ctrl-C, SIGTERM or SIGHUP raises KeyboardInterrupt. Raises BusError when a chain dies before."""
    while True:
        for chain in chains.values():
            if chain.child.process.poll() is not None:
                raise BusError(f"the emulated chain {chain.device} has ended")
        time.sleep(_POLL_S)  # not a lock: an exception inside `threading.Condition.wait` breaks it


def _change(option: str, text: str, wires: Collection[list[EmulatedServo]]) -> None:
    """Apply an option to the servos. Raises ConfigError for an invalid option, and for ids that no servo has."""
    found = _CHANGE.fullmatch(text.strip())
    if found is None or (found["register"] is None) != (option == "start"):
        raise ConfigError.at("emulate", option, text, f"cannot be read: {_FORMS[option]}")
    there = {servo.id for servos in wires for servo in servos}
    ids, value = _ids(option, text, found["ids"]), whole_number(found["value"])
    if missing := sorted(ids - there):
        raise ConfigError.at("emulate", option, text, f"names {missing[0]}, which no servo has", sorted(there))
    for servos in wires:
        for place, each in enumerate(servos):
            if each.id in ids and found["register"] is None:
                servos[place] = replace(each, start_ticks=value)
            elif each.id in ids:
                servos[place] = replace(each, registers={**each.registers, found["register"]: value})


def _ids(option: str, text: str, ids: str) -> set[int]:
    try:
        return set(parse_ids(ids))
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
        rates = table.baud_codes.values() or {_BOARD_BAUDS.get(table.family, USUAL_BAUD)}
        baud = USUAL_BAUD if USUAL_BAUD in rates else max(rates)
        out += [EmulatedServo(i, model, baud, table.center_ticks) for i in sorted(_ids("servo", text, ids))]
    return out


def _faults(texts: Sequence[str]) -> list[str]:
    """Return specs unchanged, and the specs in files: one per line, `#` starts a comment."""
    out: list[str] = []
    for text in texts:
        lines = Path(text).read_text().splitlines() if Path(text).is_file() else [text]
        out += [spec for line in lines if (spec := line.partition("#")[0].strip())]
    return out
