"""`sfms-robot serve`: one listener for many heads."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

import typer

from sfms_robot.cli.json_line import print_json
from sfms_robot.data import listener_names


def serve(
    listener: str = typer.Option(
        "sfms-small", autocompletion=listener_names, help="Shipped listener, or a folder with config.yaml and weights."
    ),
    name: str | None = typer.Option(None, help="What robots ask for, zenoh/NAME. Default: the listener's name."),
    zenoh: Path | None = typer.Option(
        None, metavar="FILE", help="zenoh's configuration (JSON5: endpoints, TLS). Default: tcp/127.0.0.1:7447."
    ),
    insecure: bool = typer.Option(
        False, "--insecure", help="Allow endpoints beyond loopback without TLS: anyone on that network may listen in."
    ),
    metrics: str | None = typer.Option(
        None, metavar="[HOST:]PORT", help="Serve figures for Prometheus at /metrics, on loopback (0: any free port)."
    ),
    hop: int | None = typer.Option(None, min=1, help="A plan every so many frames. Default: as a robot would choose."),
    processes: int | None = typer.Option(
        None, min=1, max=256, help="That step, each with the listener in its memory. Default: one for each core."
    ),
    everybody: bool = typer.Option(
        False, "--everybody", help="Admit robots without asking whether they can be answered in time."
    ),
    engine: str = typer.Option("auto", metavar="auto|onnx|torch", help="What computes the listener, as of `run`."),
    json: bool = typer.Option(False, "--json", help="Print the figures as one JSON object when it ends."),
) -> None:
    """Listen for robots elsewhere: `sfms-robot run --listener zenoh/NAME`. Until Ctrl-C."""
    from sfms_robot.app.listen.preflight import engine_named
    from sfms_robot.app.serve.batch_process import Served
    from sfms_robot.app.serve.service import serve as serve_until

    runs_on = engine_named(engine)
    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.set())
    served = Served(
        listener=listener,
        name=name or Path(listener).name,
        server=os.uname().nodename,
        engine=runs_on,
        hop=hop,
        all_heads=everybody,
    )
    figures = serve_until(served, over, _say, router=zenoh, insecure=insecure, metrics=metrics, processes=processes)
    if json:
        print_json(figures)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
