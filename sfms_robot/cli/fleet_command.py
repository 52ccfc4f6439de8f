"""`sfms-robot fleet`: heads that were started with `run --fleet NAME`."""

from __future__ import annotations

import getpass
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import typer

from sfms_robot.cli.json_line import print_json
from sfms_robot.errors import ConfigError

app = typer.Typer(help="Heads that run with --fleet: who is there, halt, resume, a page.", no_args_is_help=False)

_ZENOH = typer.Option(None, "--zenoh", metavar="FILE", help="zenoh's configuration. Default: tcp/127.0.0.1:7447.")
_INSECURE = typer.Option(False, "--insecure", help="Allow endpoints of --zenoh beyond loopback without TLS.")
_KEY = typer.Option(None, "--fleet-key", metavar="FILE", help="Key of the fleet. Default: fleet.key of this user.")
_JSON = typer.Option(False, "--json", help="Print one JSON object.")
_HEADS = typer.Argument(None, metavar="[NAME]...", help="Heads; default: all.")


@app.callback(invoke_without_command=True)
def fleet(context: typer.Context, zenoh: Path | None = _ZENOH, insecure: bool = _INSECURE, json: bool = _JSON) -> None:
    """Show who is there, and how."""
    if context.invoked_subcommand is not None:
        if zenoh is not None or json or insecure:
            flag = "--zenoh" if zenoh is not None else "--json" if json else "--insecure"
            raise ConfigError(f"fleet {flag}: stands behind the command: fleet {context.invoked_subcommand} {flag} ...")
        return
    from sfms_robot.app.fleet import Fleet, tile

    with Fleet(zenoh, insecure) as found:
        tiles = [tile(str(each.get("name")), each) for each in found.states()]
    if json:
        print_json({"heads": tiles, "malformed": found.malformed})
    elif tiles:
        from sfms_robot.cli.show import print_rows

        shown = ("name", "head", "listener", "state", "why", "faults")
        print_rows([{key: _words(each[key]) for key in shown} for each in tiles])
    else:
        print("no head answers (start one with: sfms-robot run --fleet NAME)")


@app.command()
def halt(
    heads: list[str] = _HEADS, zenoh: Path | None = _ZENOH, insecure: bool = _INSECURE, json: bool = _JSON
) -> None:
    """Halt heads, by default all of them. They stay halted until they are resumed."""
    from sfms_robot.app.fleet import Fleet

    with Fleet(zenoh, insecure) as found:
        _told(found.halt(heads or [], f"{getpass.getuser()} by fleet"), heads or [], json)


@app.command()
def resume(
    heads: list[str] = _HEADS,
    zenoh: Path | None = _ZENOH,
    insecure: bool = _INSECURE,
    key: Path | None = _KEY,
    json: bool = _JSON,
) -> None:
    """Let halted heads continue: be sure that no hand is inside one."""
    from sfms_robot.app.fleet import Fleet

    with Fleet(zenoh, insecure, key) as found:
        _told(found.resume(heads or []), heads or [], json)


@app.command()
def page(
    port: int = typer.Option(8776, min=0, max=65535, help="TCP port on loopback; 0: any free one."),
    zenoh: Path | None = _ZENOH,
    insecure: bool = _INSECURE,
    key: Path | None = _KEY,
    json: bool = typer.Option(False, "--json", help="Print its address as one JSON object when it is served."),
) -> None:
    """Serve a page with a tile per head and a button that halts all, until Ctrl-C or SIGTERM."""
    from sfms_robot.app.fleet import Fleet, fleet_page

    with Fleet(zenoh, insecure, key) as found, closing(fleet_page(found, port)) as served, suppress(KeyboardInterrupt):
        if json:
            print_json({"version": 1, "url": served.url})
        else:
            print(f"fleet: {served.url}", file=sys.stderr, flush=True)
        threading.Event().wait()


def _told(answers: Sequence[Mapping[str, Any]], asked: Sequence[str], json: bool) -> None:
    """What heads said; exit code 1 when one that was named did not answer, or nobody did."""
    silent = [name for name in asked if name not in {each.get("name") for each in answers}]
    if json:
        print_json({"answers": list(answers), "silent": silent})
    else:
        for each in answers:
            print(f"{each.get('name')}: {each.get('error') or each.get('done')}")
        for name in silent:
            print(f"{name}: does not answer")
    if silent or not answers:
        if not answers and not silent:
            print("no head answers", file=sys.stderr)
        raise typer.Exit(1)


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {each}" for key, each in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
