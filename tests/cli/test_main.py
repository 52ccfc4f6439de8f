"""How every command ends when it cannot do its work: a line on stderr, an exit code, and with --json an object."""

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
from functools import partial

import pytest
import typer
from ended import PROGRAM

from sfms_robot.cli import main
from sfms_robot.errors import BusError, ConfigError, ModelError, PortError

FULL, PIPED = "/dev/full", {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
HEAVY = {"torch", "scipy", "numpy", "matplotlib", "vtkmodules", "ruckig"}
STARTS = """
import sys; from sfms_robot.cli.main import main
try: main(["run", *{words!r}])
except SystemExit as ended: code = ended.code
loaded = {heavy!r} & set(sys.modules)
sys.exit(f"loaded {{loaded}}" if loaded else code)
"""
RUN = ("run", "--fast", "--head", "interbotix_wxxms", "--duration", "0.1")


def completed(*words, program=PROGRAM, **settings):
    """Run a command line in a process of its own; stdout and stderr are read where `settings` do not redirect them."""
    return subprocess.run([*program, *words], text=True, check=False, **(PIPED | settings))


@pytest.fixture
def broken(command_line, monkeypatch):
    """A command line with the command `breaks`, which calls a function."""

    def run(body, *words):
        def breaks(json: bool = typer.Option(False, "--json"), out: str = typer.Option("", "--out")) -> None:
            body()

        app = typer.Typer()
        app.command("breaks")(breaks)
        app.command("other")(breaks)
        monkeypatch.setattr(main, "app", app)
        return command_line("breaks", *words)

    return run


def raises(error):
    def body():
        raise error

    return body


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (ConfigError("a file"), 2, "a file"),
        (PortError("a port"), 3, "a port"),
        (BusError("a bus"), 4, "a bus"),
        (ModelError("weights"), 5, "weights"),
        (FileNotFoundError(2, "No such file", "x.yaml"), 2, "x.yaml: No such file"),
        (OSError(28, "No space left on device"), 1, "No space left on device"),
        (ZeroDivisionError("by zero"), 1, "ZeroDivisionError: by zero"),
        (EOFError(), 1, "no answer to the question: stdin ended"),
    ],
)
def test_a_failure_is_a_line_and_with_json_an_object(broken, error, code, text):
    ended = broken(raises(error), "--json")
    assert ended.code == code and ended.err.splitlines()[-1] == f"sfms-robot: {text}"
    assert ended.told == {"version": 1, "exit": "failed", "error": text, "exit_code": code}
    assert broken(raises(error)).out == ""


@pytest.mark.parametrize(
    ("words", "path", "named"),
    [
        (["--out", "/d"], "/d/x.png", "--out /d"),
        (["--out=/d/x.png"], "/d/x.png", "--out /d/x.png"),
        (["--out", "/d"], "/e/x.png", "/e/x.png"),
        (["--out", "."], "x.png", "x.png"),
    ],
)
def test_a_file_that_fails_is_named_by_the_flag_that_led_to_it(broken, words, path, named):
    ended = broken(raises(PermissionError(13, "Permission denied", path)), "--json", *words)
    assert (ended.code, ended.told["error"]) == (2, f"{named}: Permission denied")
    assert ended.err == f"sfms-robot: {named}: Permission denied\n"


def test_an_interruption_is_130_without_a_line_and_a_command_that_printed_its_end_adds_nothing(broken):
    def amid_a_wait():
        with (lock := threading.Lock()):  # as `threading.Condition.wait` does
            lock.release()
            raise KeyboardInterrupt

    for body in (raises(KeyboardInterrupt()), amid_a_wait):
        ended = broken(body, "--json")
        assert (ended.code, ended.err, ended.told["exit"]) == (130, "", "interrupted")
    assert broken(raises(typer.Exit(4)), "--json") == (4, "", "") and broken(lambda: None, "--json") == (0, "", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_would_kill_is_an_interruption_and_its_handler_is_put_back(broken, number):
    cleaned = []

    def body() -> None:
        try:
            signal.raise_signal(number)
        finally:
            cleaned.append(True)

    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)  # the tests may have been started with another
    try:
        ended = broken(body)
        assert signal.getsignal(number) is usual
    finally:
        signal.signal(number, before)
    assert ended == (130, "", "") and cleaned


@pytest.mark.parametrize("module", ["logging", "typer", "sfms_robot.cli.run_command", "pathlib", "numpy"])
def test_ctrl_c_while_modules_are_imported_is_130_without_a_traceback(module):
    """Python prints each module that it has imported: that is when the signal is sent."""
    command = [sys.executable, "-X", "importtime", "-c", "from sfms_robot.cli import start; start()"]
    words = ["head", "solve", "reachy_mini", "--poses", "/dev/stdin"]  # waits where it is not interrupted before
    with subprocess.Popen([*command, *words], stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stderr:
            if line.split("|")[-1].strip() == module:
                process.send_signal(signal.SIGINT)
                break
        _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert [line for line in error.splitlines() if not line.startswith("import time:")] == []


@pytest.mark.skipif(not os.path.exists(FULL), reason=f"no {FULL}")
def test_a_full_disk_behind_stdout_is_one_line_and_behind_stderr_costs_no_object():
    with open(FULL, "w") as full:
        done = completed("listener", "list", stdout=full)
        assert (done.returncode, done.stderr) == (1, "sfms-robot: No space left on device\n")
        done = completed("head", "check", "nobody", "--json", stderr=full)
        assert (done.returncode, json.loads(done.stdout)["exit_code"]) == (2, 2)


def test_a_reader_that_has_gone_is_no_error():
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        assert completed("speaker", "list", stdout=pipe).stderr == ""


@pytest.mark.parametrize(
    ("files", "more", "code", "error"),
    [
        (7, [], 1, "Too many open files: raise the limit of the shell (ulimit -n)"),
        (256, ["--record", "{file}/run"], 2, "--record {file}/run: Not a directory"),
    ],
    ids=["too few descriptors", "a file as folder"],
)
def test_a_run_that_cannot_start_prints_an_object(tmp_path, files, more, code, error):
    file = tmp_path / "file"
    file.write_text("")
    limit = partial(resource.setrlimit, resource.RLIMIT_NOFILE, (files, files))
    done = completed(*RUN, *(word.format(file=file) for word in more), "--json", preexec_fn=limit)
    expected = {"version": 1, "exit": "failed", "error": error.format(file=file), "exit_code": code}
    assert (done.returncode, json.loads(done.stdout.splitlines()[-1])) == (code, expected)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--port", "/dev/ttyNowhere"], 3),
        (["--head", "nope"], 2),
        (["--listener", "nope"], 2),
        (["--audio", "nope.wav"], 2),
        (["--face", "nope.csv"], 2),
        (["--status", "TAKEN"], 3),
    ],
)
def test_a_typing_error_or_a_port_in_use_is_found_before_anything_is_loaded(words, code):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        words = [word.replace("TAKEN", str(taken.getsockname()[1])) for word in words]
        done = completed(program=[sys.executable, "-c", STARTS.format(words=words, heavy=HEAVY)])
    assert done.returncode == code and words[1] in done.stderr, done.stderr


@pytest.mark.parametrize("words", [["-v", "listener", "list"], ["listener", "list", "--verbose"]])
def test_verbose_stands_before_and_after_the_command(words, command_line):
    ended = command_line(*words, "--json")
    assert ended.code == 0 and ended.told["listeners"]


@pytest.mark.parametrize(
    ("group", "name", "key"),
    [("head", "face28", "heads"), ("listener", "sfms-small", "listeners"), ("speaker", "katie", "speakers")],
)
def test_a_list_has_a_line_for_each(command_line, group, name, key):
    for words in ([group, "list"], [group, "list", "--json"]):
        ended = command_line(*words)
        assert ended.code == 0 and name in ended.out
    assert all(row["description"] for row in ended.told[key])


def test_a_shell_completes_names_of_heads():
    words = {"_SFMS_ROBOT_COMPLETE": "complete_bash", "COMP_WORDS": "sfms-robot run --head rea", "COMP_CWORD": "3"}
    program = [sys.executable, "-c", f"import sys; sys.argv[0] = 'sfms-robot'; {PROGRAM[-1]}"]
    done = completed(program=program, env={**os.environ, **words})
    assert done.stdout.split() == ["reachy_mini"], done.stderr


@pytest.mark.parametrize(
    ("words", "read"),
    [
        ("run --status", "run --status auto"),
        ("run --status 8000", "run --status 8000"),
        ("run --status=8000 --play --json", "run --status=8000 --play default --json"),
        ("run --play --status", "run --play default --status auto"),
        ("run --play USB --fast", "run --play USB --fast"),
        ("", ""),
    ],
)
def test_an_option_that_may_stand_alone_has_its_usual_value_then(words, read):
    assert main._completed(words.split()) == read.split()


def test_a_note_is_a_plain_line_and_a_warning_is_marked():
    program = (
        "import logging\n"
        "from sfms_robot.cli.main import main\n"
        "from sfms_robot.errors import NOTE\n"
        "try: main(['listener', 'list'])\n"
        "except SystemExit: pass\n"
        "for level in (logging.INFO, NOTE, logging.WARNING): logging.log(level, 'level %d', level)\n"
    )
    done = completed(program=[sys.executable, "-c", program])
    assert done.stderr.splitlines() == ["level 25", "WARNING: level 30"]
