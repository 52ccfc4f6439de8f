"""How every command ends when it cannot do its work: a line on stderr, an exit code, and with --json an object."""

import json
import os
import resource
import signal
import subprocess
import sys
from functools import partial

import pytest
import typer

from sfms_robot.cli import main as command_line
from sfms_robot.errors import BusError, ConfigError, ModelError, PortError

START = [sys.executable, "-c", "from sfms_robot.cli.main import main; main()"]
HEAVY = {"torch", "scipy", "numpy", "matplotlib", "vtkmodules", "ruckig"}


@pytest.fixture
def command(capsys, monkeypatch):
    """A command line whose `listener list` raises what it is given; (code, stdout, stderr)."""

    def run(raised: BaseException | None, *words: str) -> tuple[object, str, str]:
        def body(json: bool = typer.Option(False, "--json"), out: str = typer.Option("", "--out")) -> None:
            if raised is not None:
                raise raised

        app = typer.Typer()
        app.command("breaks")(body)
        app.command("other")(body)
        monkeypatch.setattr(command_line, "app", app)
        with pytest.raises(SystemExit) as ended:
            command_line.main(list(words))
        out, err = capsys.readouterr()
        return ended.value.code, out, err

    return run


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
def test_a_failure_is_a_line_and_with_json_an_object(command, error, code, text):
    ended, out, err = command(error, "breaks", "--json")
    assert ended == code and err.splitlines()[-1] == f"sfms-robot: {text}"
    assert json.loads(out.splitlines()[-1]) == {"version": 1, "exit": "failed", "error": text, "exit_code": code}
    assert command(error, "breaks")[1] == ""


def test_an_interruption_is_130_without_a_word(command):
    ended, out, err = command(KeyboardInterrupt(), "breaks", "--json")
    assert (ended, err) == (130, "") and json.loads(out)["exit"] == "interrupted"


@pytest.mark.parametrize("module", ["logging", "typer", "sfms_robot.cli.run_command", "pathlib", "numpy"])
def test_ctrl_c_while_modules_are_imported_is_130_without_a_traceback(module):
    """Python tells of each module that it has imported: that is when the signal is sent."""
    command = [sys.executable, "-X", "importtime", "-c", "from sfms_robot.cli import start; start()"]
    words = ["head", "solve", "reachy_mini", "--poses", "/dev/stdin"]  # waits where it is not interrupted before
    with subprocess.Popen([*command, *words], stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stderr:
            if line.split("|")[-1].strip() == module:
                process.send_signal(signal.SIGINT)
                break
        _, error = process.communicate(timeout=60)
    said = [line for line in error.splitlines() if not line.startswith("import time:")]
    assert process.returncode == 130 and said == []


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_that_would_kill_is_an_interruption_and_its_handler_is_put_back(monkeypatch, capsys, name):
    number = getattr(signal, name, None)
    if number is None:
        pytest.skip(f"no {name} here")
    cleaned = []

    def body() -> None:
        try:
            signal.raise_signal(number)
        finally:
            cleaned.append(True)

    app = typer.Typer()
    app.command("breaks")(body)
    monkeypatch.setattr(command_line, "app", app)
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)  # whatever the tests were started under
    try:
        with pytest.raises(SystemExit) as ended:
            command_line.main([])
        assert signal.getsignal(number) is usual
    finally:
        signal.signal(number, before)
    assert ended.value.code == 130 and cleaned and capsys.readouterr().err == ""


def test_a_command_that_said_how_it_ended_is_not_spoken_for(command):
    assert command(typer.Exit(4), "breaks", "--json") == (4, "", "")
    assert command(None, "breaks", "--json") == (0, "", "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_behind_stdout_is_one_line():
    with open("/dev/full", "w") as full:
        done = subprocess.run([*START, "listener", "list"], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1 and done.stderr.strip() == "sfms-robot: No space left on device"


@pytest.mark.parametrize(
    ("words", "path", "named"),
    [
        (["--out", "/d"], "/d/x.png", "--out /d"),
        (["--out=/d/x.png"], "/d/x.png", "--out /d/x.png"),
        (["--out", "/d"], "/e/x.png", "/e/x.png"),
        (["--out", "."], "x.png", "x.png"),
    ],
)
def test_a_file_that_fails_is_named_by_the_flag_that_led_to_it(command, words, path, named):
    ended, out, err = command(PermissionError(13, "Permission denied", path), "breaks", "--json", *words)
    assert (ended, json.loads(out)["error"]) == (2, f"{named}: Permission denied")
    assert err == f"sfms-robot: {named}: Permission denied\n"


def limited(*words, files):
    """The command line with --json, in a process that may have so many files open; its exit code and last object."""
    limit = partial(resource.setrlimit, resource.RLIMIT_NOFILE, (files, files))
    done = subprocess.run([*START, *words, "--json"], capture_output=True, text=True, check=False, preexec_fn=limit)
    assert "Traceback" not in done.stderr
    return done.returncode, json.loads(done.stdout.splitlines()[-1])


def test_too_few_descriptors_at_the_start_of_a_run_are_an_object():
    code, told = limited("run", "--fast", "--head", "interbotix_wxxms", "--duration", "0.1", files=7)
    why = "Too many open files: raise the limit of the shell (ulimit -n)"
    assert (code, told) == (1, {"version": 1, "exit": "failed", "error": why, "exit_code": 1})


def test_a_folder_that_cannot_hold_a_recording_is_an_object_that_names_the_flag(tmp_path):
    folder = tmp_path / "file" / "run"
    folder.parent.write_text("")
    words = ("run", "--fast", "--head", "interbotix_wxxms", "--duration", "0.1", "--record", str(folder))
    code, told = limited(*words, files=256)
    assert (code, told["error"]) == (2, f"--record {folder}: Not a directory")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_behind_stderr_costs_no_object():
    with open("/dev/full", "w") as full:
        words = [*START, "head", "check", "nobody", "--json"]
        done = subprocess.run(words, stdout=subprocess.PIPE, stderr=full, text=True, check=False)
    assert (done.returncode, json.loads(done.stdout)["exit_code"]) == (2, 2)


def test_a_reader_that_has_gone_is_no_error_worth_a_word():
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        done = subprocess.run([*START, "speaker", "list"], stdout=pipe, stderr=subprocess.PIPE, text=True, check=False)
    assert done.stderr == ""


@pytest.mark.parametrize("words", [["-v", "listener", "list"], ["listener", "list", "--verbose"]])
def test_verbose_stands_before_and_after_the_command(words, command_line):
    ended = command_line(*words, "--json")
    assert ended.code == 0 and ended.told["listeners"]


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--port", "/dev/ttyNowhere"], 3),
        (["--head", "nope"], 2),
        (["--listener", "nope"], 2),
        (["--audio", "nope.wav"], 2),
        (["--face", "nope.csv"], 2),
    ],
)
def test_a_slip_of_the_keyboard_is_found_before_anything_is_loaded(words, code):
    program = (
        "import sys; from sfms_robot.cli.main import main\n"
        f"try: main(['run', *{words!r}])\n"
        "except SystemExit as ended: code = ended.code\n"
        f"loaded = {HEAVY!r} & set(sys.modules)\n"
        "sys.exit(f'loaded {loaded}' if loaded else code)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    assert words[1] in done.stderr


@pytest.mark.parametrize(
    ("group", "name", "key"),
    [("head", "face28", "heads"), ("listener", "sfms-small", "listeners"), ("speaker", "katie", "speakers")],
)
def test_what_there_is_has_a_line_each(command_line, group, name, key):
    for words in ([group, "list"], [group, "list", "--json"]):
        ended = command_line(*words)
        assert ended.code == 0 and name in ended.out
    assert all(row["description"] for row in ended.told[key])


def test_a_shell_completes_names_of_heads():
    words = {"_SFMS_ROBOT_COMPLETE": "complete_bash", "COMP_WORDS": "sfms-robot run --head rea", "COMP_CWORD": "3"}
    program = "import sys; sys.argv[0] = 'sfms-robot'; from sfms_robot.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program], env={**os.environ, **words}, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["reachy_mini"], done.stderr
