"""The command line: one file per command group. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise, takewhile
from pathlib import Path

import typer

from sfms_robot import __version__
from sfms_robot.cli import (
    bench_command,
    data_command,
    demo_command,
    emulate_command,
    evaluate_command,
    export_command,
    fleet_command,
    head_command,
    list_commands,
    replay_command,
    run_command,
    serve_command,
    servo_command,
    train_command,
)
from sfms_robot.cli.json_line import print_json
from sfms_robot.errors import ConfigError, RobotError, optional

NAME = "sfms-robot"
INTERRUPTED = 130
UNEXPECTED = 1
_COMPLETION = "_SFMS_ROBOT_COMPLETE"  # set by a shell that asks what could come next

app = typer.Typer(
    name=NAME,
    help="A robot head that listens: while a person talks, it nods, blinks, smiles and looks.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("demo")(demo_command.demo)
app.command("run")(run_command.run)
app.command("serve")(serve_command.serve)
app.command("export")(export_command.export)
app.command("replay")(replay_command.replay)
app.command("emulate")(emulate_command.emulate)
app.command("doctor")(servo_command.doctor)
app.command("bench", epilog=bench_command.EPILOG)(bench_command.bench)
app.add_typer(fleet_command.app, name="fleet")
app.add_typer(head_command.app, name="head")
app.add_typer(list_commands.listener, name="listener")
app.add_typer(list_commands.speaker, name="speaker")
app.add_typer(list_commands.port, name="port")
app.add_typer(servo_command.app, name="servo")
app.add_typer(data_command.app, name="data")
app.add_typer(train_command.app, name="train")
app.add_typer(evaluate_command.app, name="evaluate")


def _version(wanted: bool) -> None:
    if wanted:
        print(f"{NAME} {__version__}")
        raise typer.Exit()


@app.callback()
def _common(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
    verbose: bool = typer.Option(False, "--verbose", "-v", help="Log more, to stderr. Also after a command."),
) -> None:
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, stream=sys.stderr, format="%(levelname)s: %(message)s"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; leaves by SystemExit.

    What goes wrong is one line on stderr and an exit code of its own (see `errors`); with --json one object on stdout
    too, as its last line. A command that already said how it ended leaves by typer.Exit and is not spoken for.
    """
    if _COMPLETION in os.environ:
        app()
    words = list(sys.argv[1:] if arguments is None else arguments)
    verbose = [word for word in words if word in ("-v", "--verbose")]
    with _endings_as_interrupts():
        code, problem = _outcome(verbose + _completed([word for word in words if word not in verbose]))
        if arguments is None:
            _ignore_interrupts()
    try:
        if problem is not None and "--json" in words:
            ended = "interrupted" if code == INTERRUPTED else "failed"
            print_json({"version": 1, "exit": ended, "error": problem, "exit_code": code})
        sys.stdout.flush()
    except OSError:  # a pipe or disk that takes no more would fail again when the process ends
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


def _ignore_interrupts() -> None:
    """The command is over and its exit code stands: one more Ctrl-C would only make it that of a signal."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _endings_as_interrupts() -> Iterator[None]:
    """SIGTERM and SIGHUP raise KeyboardInterrupt as Ctrl-C does, so that what a command has open is put right.

    Not where they are ignored (nohup) or handled, and only in the main thread: Python gives signals to no other.
    SIGINT does so also where it is ignored, as a script's shell has it for whatever it starts with `&`: it has to stop
    who moves a head in every phase.
    """
    main_thread = threading.current_thread() is threading.main_thread()
    replaced = {"SIGINT": signal.SIG_IGN, "SIGTERM": signal.SIG_DFL, "SIGHUP": signal.SIG_DFL}
    known = {
        getattr(signal, name): before for name, before in replaced.items() if main_thread and hasattr(signal, name)
    }
    heeded = {number: before for number, before in known.items() if signal.getsignal(number) is before}
    for number in heeded:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, before in heeded.items():
            signal.signal(number, before)


def _outcome(words: list[str]) -> tuple[int, str | None]:
    """Run the command: its exit code, and what went wrong, said on stderr already; None where it told that itself."""
    try:
        command = typer.main.get_command(app)
        with command.make_context(NAME, words) as context, optional(_typed(words)):
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as ended:
        return ended.exit_code, None
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 0, None
    except KeyboardInterrupt:
        return INTERRUPTED, "interrupted"
    except (EOFError, typer.Abort):
        return _said(UNEXPECTED, "there is nobody to answer (stdin ended)")
    except RobotError as error:
        return _said(error.exit_code, str(error))
    except BrokenPipeError as error:
        return UNEXPECTED, str(error)
    except OSError as error:  # a file that a flag names, or a full disk behind stdout
        logging.getLogger(__name__).info("what led to it", exc_info=True)
        problem = error.strerror or str(error)
        if error.errno == errno.EMFILE:
            return _said(UNEXPECTED, f"{problem}: raise the limit of the shell (ulimit -n)")
        if error.filename is None:
            return _said(UNEXPECTED, problem)
        return _said(ConfigError.exit_code, f"{_flagged(str(error.filename), words)}: {problem}")
    except Exception as error:
        usage = getattr(error, "show", None)  # of a flag or argument that is none
        if usage is None:
            logging.getLogger(__name__).error("an error that nobody expected", exc_info=True)
            return _said(UNEXPECTED, f"{type(error).__name__}: {error}")
        usage()
        return ConfigError.exit_code, str(error.format_message())  # type: ignore[attr-defined]
    return 0, None


def _completed(words: Sequence[str]) -> list[str]:
    """The words, with the value that it stands for behind every option that may stand alone and does."""
    completed = []
    for word, following in zip(words, [*words[1:], "-"], strict=False):
        completed.append(word)
        if word in run_command.OPTIONAL and following.startswith("-"):
            completed.append(run_command.OPTIONAL[word])
    return completed


def _typed(words: Sequence[str]) -> str:
    """Return the command that `words` begin with, as it is typed."""
    return " ".join([NAME, *takewhile(lambda word: not word.startswith("-"), words[:2])])


def _flagged(path: str, words: Sequence[str]) -> str:
    """Return the flag and its value where `path` is that value or lies in it, else `path`."""
    pairs = pairwise(part for word in words for part in word.split("=", 1))
    flags = [(flag, value) for flag, value in pairs if flag.startswith("--") and Path(value).parts]
    return next((f"{flag} {value}" for flag, value in flags if Path(path).is_relative_to(value)), path)


def _said(code: int, problem: str) -> tuple[int, str]:
    with suppress(OSError):
        print(f"{NAME}: {problem}", file=sys.stderr)
    return code, problem
