"""The command line: one file per command group. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import errno
import logging
import sys

import typer

from sfms_robot import __version__
from sfms_robot.cli import bench, data, doctor, emulate, evaluate, head, replay, run, servo, train
from sfms_robot.errors import ConfigError, RobotError

app = typer.Typer(
    name="sfms-robot",
    help="A robot head that listens: while a person talks, it nods, blinks, smiles and looks.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("run")(run.run)
app.command("replay")(replay.replay)
app.command("emulate")(emulate.emulate)
app.command("doctor")(doctor.doctor)
app.command("bench")(bench.bench)
app.add_typer(head.app, name="head")
app.add_typer(servo.app, name="servo")
app.add_typer(data.app, name="data")
app.add_typer(train.app, name="train")
app.add_typer(evaluate.app, name="evaluate")


def _version(wanted: bool) -> None:
    if wanted:
        print(f"sfms-robot {__version__}")
        raise typer.Exit()


@app.callback()
def _common(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
    verbose: bool = typer.Option(False, "--verbose", "-v", help="Log more, to stderr."),
) -> None:
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, stream=sys.stderr, format="%(levelname)s: %(message)s"
    )


def main(arguments: list[str] | None = None) -> None:
    """Entry point: a RobotError is one line on stderr and its own exit code; so is a file that cannot be used."""
    try:
        app(arguments)
    except RobotError as error:
        print(f"sfms-robot: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except OSError as error:
        if error.filename is None and error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise  # not about a file that somebody named: ours to repair
        print(f"sfms-robot: {error.filename or 'a file of this command'}: {error.strerror}", file=sys.stderr)
        sys.exit(ConfigError.exit_code)
