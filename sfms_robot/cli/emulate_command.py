"""`sfms-robot emulate`: serve emulated servos behind a pseudo terminal, or a TCP port where there is none."""

from __future__ import annotations

from contextlib import suppress
from typing import Literal

from typer import Option

from sfms_robot.cli.show import aside, print_json


def emulate(
    head: str | None = Option(None, help="All servos of a shipped head, or of a folder with a head.yaml."),
    servo: str | None = Option(None, help="MODEL:IDS[,MODEL:IDS...], as in xl330-m288:1-9,ax-12a:20."),
    link: str | None = Option(None, help="Symbolic link to create; PATH-BUS for each bus of a head with several."),
    timing: Literal["wire", "instant"] = Option(
        "wire", help="Send replies after the time of bytes and return delays, or at once."
    ),
    baud: int | None = Option(None, min=1, help="Rate of the servos; default: the head's, or 1 Mbit/s."),
    voltage: float | None = Option(None, min=0.0, help="Supply voltage. Default: one within the servos' range."),
    fault: list[str] = Option(
        [], help="KIND[:IDS][@START[-END]][=VALUE], as in drop:3@2-4=0.5, or a FILE of such lines. Repeatable."
    ),
    stored: list[str] = Option(
        [], help="IDS:REGISTER=VALUE stored in servos at the start, as in 3:min_position_limit=1900. Repeatable."
    ),
    start: list[str] = Option(
        [], help="IDS=TICKS: start positions, also outside limits or beyond one turn. Repeatable."
    ),
    behind_silent: Literal["chain_break", "skip"] = Option(
        "chain_break", help="In a sync read, ids after a silent one are silent too, or answer."
    ),
    virtual: bool = Option(False, help="Use virtual time; time advances only through the control socket."),
    seed: int = Option(0, min=0, help="Seed of random faults."),
    json: bool = Option(False, "--json", help="Print devices and servos as one JSON object when all are ready."),
) -> None:
    """Serve emulated servos until SIGTERM or Ctrl-C; prints the device to open, one line per bus."""
    from sfms_robot.app.servo.emulated_chains import described, emulators, until_stopped

    chains = emulators(
        head=head,
        servo=servo,
        link=link,
        timing=timing,
        baud=baud,
        voltage=voltage,
        faults=fault,
        virtual=virtual,
        behind_silent=behind_silent,
        seed=seed,
        stored=stored,
        starts=start,
    )
    with chains as running, suppress(KeyboardInterrupt):
        if json:
            print_json(described(running, head))
        else:
            for bus, chain in running.items():
                print(chain.device if len(running) == 1 else f"{bus}={chain.device}", flush=True)
                aside(f"control socket of {bus}: {chain.control}")
        until_stopped(running)
