"""Where the servos of a command are: the options that all of `sfms-robot servo` shares, said once."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sfms_robot.errors import ConfigError

if TYPE_CHECKING:
    from sfms_robot.app.servo.serial_line import Wire


class Family(StrEnum):
    dynamixel2 = "dynamixel2"
    dynamixel1 = "dynamixel1"
    feetech = "feetech"


@dataclass(frozen=True)
class Wiring:
    """A field is an option of every command."""

    port: Annotated[
        str | None, typer.Option("--port", help="Serial device, or 'sim'. Default: the only one there is.")
    ] = None
    baud: Annotated[int | None, typer.Option("--baud", min=1, help="Look at this rate only. Default: at all.")] = None
    family: Annotated[Family, typer.Option("--family", help="How the servos speak.")] = Family.dynamixel2
    head: Annotated[str, typer.Option("--head", help="Which head's servos --port sim emulates.")] = "face28"
    model: Annotated[
        str | None, typer.Option("--model", help="Take the servos for this model. Default: by their model number.")
    ] = None
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object, last line of stdout.")] = False

    @contextmanager
    def open(self) -> Iterator[Wire]:
        from sfms_robot.app.servo.serial_line import open_wire, real_clock

        with open_wire(self.port, self.family.value, self.baud, self.head, real_clock(), self.model) as wire:
            yield wire


def on_wire(command: Callable[..., None]) -> Callable[..., None]:
    """`command(wiring, ...)` as typer is to see it: with the options of `Wiring` behind its own."""
    own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
    shared = list(inspect.signature(Wiring, eval_str=True).parameters.values())

    @wraps(command)
    def run(**given: Any) -> None:
        wiring = Wiring(**{field.name: given.pop(field.name) for field in fields(Wiring)})
        command(wiring, **given)

    seen = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*own, *shared)]
    run.__dict__.pop("__wrapped__")  # or its signature would be looked at instead
    run.__signature__ = inspect.Signature(seen)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in seen}
    return run


def confirmation(yes: bool, ids: str = "") -> Callable[[str], bool]:
    """Asks, unless `yes`. With several `ids` one yes holds for the same change to all of them; else each is asked."""
    alike = f" and the same for all of {ids}" if len(ids) > 1 and not ids.isdigit() else ""
    said: list[bool] = [True] if yes else []

    def ask(question: str) -> bool:
        if said:
            return said[0]
        if not sys.stdin.isatty():
            raise ConfigError(f"{question}: nobody is there to ask, say --yes")
        answer = typer.confirm(f"{question}{alike}. Do it?", err=True)
        if alike:
            said.append(answer)
        return answer

    return ask
