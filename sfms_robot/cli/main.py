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
    emulate_command,
    evaluate_command,
    head_command,
    remote_command,
    run_command,
    servo_command,
    train_command,
)
from sfms_robot.cli.show import aside, print_json
from sfms_robot.errors import INTERRUPTED, NOTE, ConfigError, RobotError, optional

NAME = "sfms-robot"
UNEXPECTED = 1
_COMPLETION = "_SFMS_ROBOT_COMPLETE"  # set by a shell that completes a command

app = typer.Typer(
    name=NAME,
    help="A robot head that listens: while a person talks, it nods, blinks, smiles and looks.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _name, _command in (
    ("demo", run_command.demo),
    ("run", run_command.run),
    ("serve", remote_command.serve),
    ("mcp", remote_command.mcp),
    ("export", train_command.export),
    ("replay", run_command.replay),
    ("emulate", emulate_command.emulate),
    ("doctor", servo_command.doctor),
):
    app.command(_name)(_command)
app.command("bench", epilog=bench_command.EPILOG)(bench_command.bench)
for _name, _group in (
    ("fleet", remote_command.app),
    ("head", head_command.app),
    ("listener", head_command.listener),
    ("speaker", head_command.speaker),
    ("port", head_command.port),
    ("output", head_command.output),
    ("servo", servo_command.app),
    ("data", train_command.data_app),
    ("train", train_command.app),
    ("evaluate", evaluate_command.app),
):
    app.add_typer(_group, name=_name)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"{NAME} {__version__}")
        raise typer.Exit()


@app.callback()
def _common(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
    verbose: bool = typer.Option(False, "--verbose", "-v", help="Log more, to stderr. Also after a command."),
) -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Lines())
    logging.basicConfig(level=logging.INFO if verbose else NOTE, handlers=[handler])


class _Lines(logging.Formatter):
    """Log lines with their level in front; a note is a plain line."""

    def format(self, record: logging.LogRecord) -> str:
        line = super().format(record)
        return line if record.levelno == NOTE else f"{record.levelname}: {line}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command, and end with SystemExit.

    An error is a line on stderr and an exit code (see `errors`); with --json also one object, the last line of stdout.
    A command that has printed its own end raises typer.Exit, and nothing is added.
    """
    if _COMPLETION in os.environ:
        app()
    words = list(sys.argv[1:] if arguments is None else arguments)
    verbose = [word for word in words if word in ("-v", "--verbose")]
    with _endings_as_interrupts():
        code, problem = _outcome(verbose + _completed([word for word in words if word not in verbose]))
        # After a command, Ctrl-C would replace its exit code by that of a signal.
        if arguments is None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        if problem is not None and "--json" in words:
            ended = "interrupted" if code == INTERRUPTED else "failed"
            print_json({"version": 1, "exit": ended, "error": problem, "exit_code": code})
        sys.stdout.flush()
    except OSError:  # a closed pipe or a full disk would fail again when the process ends
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


@contextmanager
def _endings_as_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt for SIGTERM and SIGHUP as for Ctrl-C, so that a command closes everything it has opened.

    Signals that are ignored (nohup) or handled stay so. Main thread only: Python delivers signals to no other thread.
    SIGINT is an interrupt even if it is ignored, as for commands that a script starts with `&`, because it has to stop
    a moving head in every phase.
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
    """Run the command; return its exit code, and the error that was printed on stderr, or None."""
    try:
        command = typer.main.get_command(app)
        typed = takewhile(lambda word: not word.startswith("-"), words[:2])
        with command.make_context(NAME, words) as context, optional(" ".join([NAME, *typed])):
            command.invoke(context)
        sys.stdout.flush()
    except typer.Exit as ended:
        return ended.exit_code, None
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 0, None
    except KeyboardInterrupt:
        return INTERRUPTED, "interrupted"
    except (EOFError, typer.Abort):
        return _said(UNEXPECTED, "no answer to the question: stdin ended")
    except RobotError as error:
        return _said(error.exit_code, str(error))
    except BrokenPipeError as error:
        return UNEXPECTED, str(error)
    except OSError as error:  # for a file that a flag names, or for stdout on a full disk
        logging.getLogger(__name__).info("traceback", exc_info=True)
        problem = error.strerror or str(error)
        if error.errno == errno.EMFILE:
            return _said(UNEXPECTED, f"{problem}: raise the limit of the shell (ulimit -n)")
        if error.filename is None:
            return _said(UNEXPECTED, problem)
        return _said(ConfigError.exit_code, f"{_flagged(str(error.filename), words)}: {problem}")
    except Exception as error:
        if str(error) == "release unlocked lock" and isinstance(error.__context__, KeyboardInterrupt):
            return INTERRUPTED, "interrupted"  # it came inside `threading.Condition.wait`, as in `Thread.start`
        usage = getattr(error, "show", None)  # typer's error for an unknown flag or argument
        if usage is None:
            logging.getLogger(__name__).error("internal error, please report it", exc_info=True)
            return _said(UNEXPECTED, f"{type(error).__name__}: {error}")
        usage()
        return ConfigError.exit_code, str(error.format_message())  # type: ignore[attr-defined]
    return 0, None


def _completed(words: Sequence[str]) -> list[str]:
    """Return the words, with the default value after each option that is given without its optional value."""
    completed = []
    for word, following in zip(words, [*words[1:], "-"], strict=False):
        completed.append(word)
        if word in run_command.OPTIONAL and following.startswith("-"):
            completed.append(run_command.OPTIONAL[word])
    return completed


def _flagged(path: str, words: Sequence[str]) -> str:
    """Return the flag and its value if `path` is that value or lies in it, else `path`."""
    pairs = pairwise(part for word in words for part in word.split("=", 1))
    flags = [(flag, value) for flag, value in pairs if flag.startswith("--") and Path(value).parts]
    return next((f"{flag} {value}" for flag, value in flags if Path(path).is_relative_to(value)), path)


def _said(code: int, problem: str) -> tuple[int, str]:
    with suppress(OSError):
        aside(f"{NAME}: {problem}")
    return code, problem
