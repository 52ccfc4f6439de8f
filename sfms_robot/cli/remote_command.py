"""`sfms-robot serve` and `fleet`: one listener for many heads, and heads that were started with `run --fleet NAME`."""

from __future__ import annotations

import getpass
import os
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Literal

from typer import Argument, Context, Exit, Option, Typer

from sfms_robot.cli.show import JSON, Result, aside, print_json, show
from sfms_robot.data import listener_names
from sfms_robot.errors import ConfigError

app = Typer(help="Heads that run with --fleet: list, halt, resume, a page.", no_args_is_help=False)

_ZENOH = Option(None, "--zenoh", metavar="FILE", help="zenoh's configuration. Default: tcp/127.0.0.1:7447.")
_INSECURE = Option(False, "--insecure", help="Allow endpoints of --zenoh beyond loopback without TLS.")
_KEY = Option(None, "--fleet-key", metavar="FILE", help="Key of the fleet. Default: fleet.key of this user.")
_HEADS = Argument(None, metavar="[NAME]...", help="Heads; default: all.")


@app.callback(invoke_without_command=True)
def fleet(context: Context, zenoh: Path | None = _ZENOH, insecure: bool = _INSECURE, json: bool = JSON) -> None:
    """List the heads of the fleet, and their states."""
    if context.invoked_subcommand is not None:
        if zenoh is not None or json or insecure:
            flag = "--zenoh" if zenoh is not None else "--json" if json else "--insecure"
            raise ConfigError(f"fleet {flag}: stands behind the command: fleet {context.invoked_subcommand} {flag} ...")
        return
    from sfms_robot.app.fleet import open_fleet, tile

    with open_fleet(zenoh, insecure) as found:
        tiles = [tile(str(each.get("name")), each) for each in found.states()]
    show({"heads": tiles, "malformed": found.malformed}, json)
    if not tiles:
        aside("no head answers (start one with: sfms-robot run --fleet NAME)")


@app.command()
def halt(heads: list[str] = _HEADS, zenoh: Path | None = _ZENOH, insecure: bool = _INSECURE, json: bool = JSON) -> None:
    """Halt heads, by default all of them. They stay halted until they are resumed."""
    from sfms_robot.app.fleet import open_fleet

    with open_fleet(zenoh, insecure) as found:
        _show_answers(found.halt(heads or [], f"{getpass.getuser()} by fleet"), heads or [], json)


@app.command()
def resume(
    heads: list[str] = _HEADS,
    zenoh: Path | None = _ZENOH,
    insecure: bool = _INSECURE,
    key: Path | None = _KEY,
    json: bool = JSON,
) -> None:
    """Let halted heads continue: be sure that no hand is inside one."""
    from sfms_robot.app.fleet import open_fleet

    with open_fleet(zenoh, insecure, key) as found:
        _show_answers(found.resume(heads or []), heads or [], json)


@app.command()
def page(
    port: int = Option(8776, min=0, max=65535, help="TCP port on loopback; 0: any free one."),
    zenoh: Path | None = _ZENOH,
    insecure: bool = _INSECURE,
    key: Path | None = _KEY,
    json: bool = JSON,
) -> None:
    """Serve a page with a tile per head and a button that halts all, until Ctrl-C or SIGTERM."""
    from sfms_robot.app.fleet import fleet_page, open_fleet

    with (
        open_fleet(zenoh, insecure, key) as found,
        closing(fleet_page(found, port)) as served,
        suppress(KeyboardInterrupt),
    ):
        if json:
            print_json({"version": 1, "url": served.url})
        else:
            aside(f"fleet: {served.url}")
        while True:
            time.sleep(60.0)


def _show_answers(answers: Sequence[Result], asked: Sequence[str], json: bool) -> None:
    """Print the answers of heads; exit code 1 if a named head did not answer, or no head did."""
    silent = [name for name in asked if name not in {each.get("name") for each in answers}]

    def printed(_: Result) -> None:
        for each in answers:
            print(f"{each.get('name')}: {each.get('error') or each.get('done')}")
        for name in silent:
            print(f"{name}: does not answer")

    show({"answers": list(answers), "silent": silent}, json, printed)
    if silent or not answers:
        if not answers and not silent:
            aside("no head answers")
        raise Exit(1)


# --- serve ------------------------------------------------------------------------------------------------------------


def serve(
    listener: str = Option(
        "sfms-small", autocompletion=listener_names, help="Shipped listener, or a folder with config.yaml and weights."
    ),
    name: str | None = Option(None, help="The name for robots, zenoh/NAME. Default: the listener's name."),
    zenoh: Path | None = Option(
        None, metavar="FILE", help="zenoh's configuration (JSON5: endpoints, TLS). Default: tcp/127.0.0.1:7447."
    ),
    insecure: bool = Option(
        False, "--insecure", help="Allow endpoints beyond loopback without TLS: anyone on that network may listen in."
    ),
    metrics: str | None = Option(
        None, metavar="[HOST:]PORT", help="Serve figures for Prometheus at /metrics, on loopback (0: any free port)."
    ),
    hop: int | None = Option(None, min=1, help="Frames between plans. Default: chosen as on a robot."),
    processes: int | None = Option(
        None, min=1, max=256, help="Processes, each with its own copy of the listener. Default: one for each core."
    ),
    everybody: bool = Option(False, "--everybody", help="Admit robots even if answers may be late."),
    engine: str = Option("auto", metavar="auto|onnx|torch", help="Engine of the listener, as in `run`."),
    device: Literal["cpu", "cuda"] = Option("cpu", help="cuda: all heads of a process in one batch on the GPU."),
    json: bool = JSON,
) -> None:
    """Serve a listener to robots on other machines (`sfms-robot run --listener zenoh/NAME`) until Ctrl-C."""
    from sfms_robot.app.options import engine_named
    from sfms_robot.app.serve.batch_process import Served
    from sfms_robot.app.serve.service import serve as serve_until

    served = Served(
        listener=listener,
        name=name or Path(listener).name,
        server=os.uname().nodename,
        engine=engine_named(engine),
        device=device,
        hop=hop,
        all_heads=everybody,
    )
    figures = serve_until(
        served,
        aside,
        router=zenoh,
        insecure=insecure,
        metrics=metrics,
        processes=processes,
    )
    if json:
        print_json(figures)


# --- mcp --------------------------------------------------------------------------------------------------------------


def mcp(
    url: str = Option("ws://127.0.0.1:8780", metavar="ws://HOST:PORT", help="The page of a run with --view."),
    token: str = Option("", help="Token that the run prints if its page is bound beyond loopback."),
) -> None:
    """Serve a running head to an assistant as MCP tools, on stdin and stdout: show, look_at, halt, status, ..."""
    from sfms_robot.agents.mcp import serve as serve_tools

    serve_tools(url, token)
