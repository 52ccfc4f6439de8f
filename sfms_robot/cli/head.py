"""`sfms-robot head`: the heads at hand."""

from __future__ import annotations

import json as json_module

import typer

app = typer.Typer(help="Heads: list what is shipped.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Keeps `list` a subcommand while it is the only one."""


@app.command("list")
def list_heads(json: bool = typer.Option(False, "--json", help="Print as one JSON object.")) -> None:
    """Shipped heads, with joints and buses."""
    from sfms_robot.app.heads import shipped_heads

    heads = shipped_heads()
    if json:
        print(json_module.dumps({"heads": heads}))
    else:
        for head in heads:
            print(f"{head['name']}: {head['joints']} joints, {', '.join(head['buses'])} - {head['description']}")
