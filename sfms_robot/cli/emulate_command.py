"""`sfms-robot emulate`: serve emulated servos behind a pseudo terminal."""

from __future__ import annotations

import sys
from enum import StrEnum
from typing import Any, cast

import typer

from sfms_robot.cli.show import print_json


class Timing(StrEnum):
    wire = "wire"
    instant = "instant"


class BehindSilent(StrEnum):
    chain_break = "chain_break"
    skip = "skip"


def emulate(
    head: str | None = typer.Option(None, help="All servos of a shipped head, or of a folder with a head.yaml."),
    servo: str | None = typer.Option(None, help="MODEL:IDS[,MODEL:IDS...], as in xl330-m288:1-9,ax-12a:20."),
    link: str | None = typer.Option(None, help="Symbolic link to make; of a head with several buses, PATH-BUS each."),
    timing: Timing = typer.Option(
        Timing.wire, help="Replies in the time that bytes and return delays take, or at once."
    ),
    baud: int | None = typer.Option(None, min=1, help="What the servos are set to; default: the head's, or 1 Mbit/s."),
    voltage: float | None = typer.Option(None, min=0.0, help="Supply; default: one the servos are content with."),
    fault: list[str] = typer.Option(
        [], help="KIND[:IDS][@START[-END]][=VALUE], as in drop:3@2-4=0.5, or a FILE of such lines. Repeatable."
    ),
    stored: list[str] = typer.Option(
        [], help="IDS:REGISTER=VALUE stored in servos before, as in 3:min_position_limit=1900. Repeatable."
    ),
    start: list[str] = typer.Option(
        [], help="IDS=TICKS: where servos are found, outside their limits or beyond one turn, too. Repeatable."
    ),
    behind_silent: BehindSilent = typer.Option(
        BehindSilent.chain_break, help="Whether the ids behind a silent one in a sync read are silent too."
    ),
    virtual: bool = typer.Option(False, help="Virtual time: answers only through the control socket."),
    seed: int = typer.Option(0, min=0, help="Of the faults that are left to chance."),
    json: bool = typer.Option(False, "--json", help="Print devices and servos as one JSON object when all is up."),
) -> None:
    """Serve emulated servos until SIGTERM or Ctrl-C; prints the device to open, one line per bus."""
    from sfms_robot.app.servo.emulated_chains import EmulateOptions, described, emulators, until_stopped

    options = EmulateOptions(
        head,
        servo,
        link,
        cast(Any, timing.value),
        baud,
        voltage,
        tuple(fault),
        virtual,
        cast(Any, behind_silent.value),
        seed,
        tuple(stored),
        tuple(start),
    )
    with emulators(options) as chains:
        if json:
            print_json(described(chains, head))
        else:
            for bus, chain in chains.items():
                print(chain.device if len(chains) == 1 else f"{bus}={chain.device}", flush=True)
                print(f"control socket of {bus}: {chain.control}", file=sys.stderr)
        until_stopped(chains)
