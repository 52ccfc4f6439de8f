"""`servo` and `doctor` as they are typed, on an emulated chain in real time."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

import sfms_robot
from sfms_robot.cli.main import app
from sfms_robot.cli.show_servo import print_table
from sfms_robot.emulator.launch import EmulatedServo, launch


@pytest.fixture(scope="module")
def device() -> Iterator[str]:
    """Ids 1 and 2 at 1 Mbaud."""
    with launch([EmulatedServo(1), EmulatedServo(2, start_ticks=1500)]) as chain:
        yield chain.device


@pytest.fixture
def run(command_line, device):
    """Run `sfms-robot ARGUMENTS --port DEVICE`; (exit code, what --json printed or None, stderr)."""

    def command(*arguments: object, port: object = None) -> tuple[int, dict | None, str]:
        words = [str(word) for word in arguments]
        rate = ["--baud", "1000000"] if words[0] == "servo" else []
        ended = command_line(*words, "--port", port or device, *rate)
        return ended.code, ended.told if "--json" in words and ended.out else None, ended.err.strip()

    return command


def test_ping_tells_who_answers_and_fails_for_who_does_not(run):
    code, told, _ = run("servo", "ping", "1,2", "--json")
    assert code == 0 and [row["model"] for row in told["servos"]] == ["xl330-m288", "xl330-m288"]
    code, told, _ = run("servo", "ping", "1,9", "--json")
    assert code == 4 and [row["answers"] for row in told["servos"]] == [True, False]


def test_a_scan_of_a_few_ids(run):
    code, told, _ = run("servo", "scan", "--ids", "1-3", "--json")
    assert code == 0 and [row["id"] for row in told["servos"]] == [1, 2]


def test_registers_are_read_from_several_servos_in_one_command(run):
    code, told, _ = run("servo", "read", "1-2", "present_position", "voltage", "--json")
    assert code == 0 and [(row["id"], row["register"]) for row in told["registers"]] == [
        (1, "present_position"), (1, "present_input_voltage"), (2, "present_position"), (2, "present_input_voltage"),
    ]  # fmt: skip


def test_ram_is_written_and_eeprom_only_with_a_yes(run):
    code, told, _ = run("servo", "write", "1", "led", "1", "--json")
    assert code == 0 and told["written"][0] == {
        "id": 1, "register": "led", "before": 0, "raw": 1, "value": 1.0, "unit": "bool",
    }  # fmt: skip
    code, _, err = run("servo", "write", "1", "return_delay_time", "0")
    assert code == 2 and "--yes" in err and len(err.splitlines()) == 1
    code, told, _ = run("servo", "write", "1-2", "return_delay_time", "0", "--yes", "--json")
    assert code == 0 and [row["raw"] for row in told["written"]] == [0, 0]


def test_a_negative_value_is_a_value_and_not_an_option(run):
    code, _, err = run("servo", "write", "1", "goal_position", "-5")
    assert code == 4 and "goal_position := -5" in err and "limit" in err


def test_watching_ends_after_the_samples_asked_for(run):
    code, told, _ = run("servo", "monitor", "1-2", "--samples", "2", "--rate", "50", "--json")
    assert code == 0 and len(told["samples"]) == 2 and told["samples"][0][1]["position"] == 1500


@pytest.mark.parametrize(
    ("words", "code", "problem"),
    [
        (("read", "1", "goal_postion"), 2, "present_position"),
        (("read", "254", "led"), 2, "0..252"),
        (("read", "one", "led"), 2, "list of ids"),
        (("ping", "9-1"), 2, "list of ids"),
        (("write", "1", "led", "2"), 2, "raw 0..1"),
        (("read", "9", "led"), 4, "no answer from id 9"),
        (("set-id", "1", "2", "--yes"), 2, "taken"),
        (("set-baud", "1", "123", "--yes"), 2, "57600"),
    ],
)
def test_bad_input_is_one_line_and_an_exit_code(run, words, code, problem):
    ended, _, err = run("servo", *words)
    assert ended == code and problem in err and len(err.splitlines()) == 1


def test_a_directory_is_no_port(run, tmp_path):
    code, _, err = run("servo", "ping", "1", port=tmp_path)
    assert code == 3 and "directory" in err
    code, told, _ = run("doctor", "--json", port=tmp_path)
    assert code == 3 and "directory" in told["findings"][0]["problem"]


def test_release_says_of_every_joint_whether_its_torque_is_off(command_line):
    ended = command_line("servo", "release", "--port", "sim", "--json")
    assert ended.code == 0 and ended.told["torque_unconfirmed"] == []
    assert ended.told["released"][0] == {"bus": "main", "joint": "eye_pan_left", "id": 1, "torque": "off", "note": ""}
    assert {row["torque"] for row in ended.told["released"]} == {"off"} and len(ended.told["released"]) == 28
    assert command_line("servo", "release", "--port", "sim", "--all", "--json").code == 2
    ended = command_line("servo", "release", "--port", "sim", "--all", "--yes", "--head", "reachy_mini")
    assert ended.code == 0 and "torque off: 9 of 9" in ended.out
    with launch([EmulatedServo(10, "xc330-m288")]) as chain:
        ended = command_line("servo", "release", "--port", chain.device, "--head", "reachy_mini", "--json")
    assert ended.code == 4 and len(ended.told["torque_unconfirmed"]) == 8 and "stewart_1" in ended.err


def test_the_tables_for_people_hold_what_json_holds(command_line, device):
    for words in (("servo", "ping", "1"), ("servo", "read", "1", "all"), ("servo", "monitor", "1", "--samples", "1")):
        out = command_line(*words, "--port", device, "--baud", 1_000_000).out
        assert "xl330-m288" in out or "goal_position" in out


def test_the_doctor_finds_the_emulated_head_fit_to_run(command_line):
    ended = command_line("doctor", "--port", "sim", "--head", "face28")
    assert not ended.code and "fit to run: 0 errors" in ended.out and "One tick of 28 servos" in ended.out


def test_every_command_on_the_page_for_makers_is_one_that_the_program_has():
    page = (Path(sfms_robot.__file__).parents[1] / "docs" / "guide" / "servos.md").read_text(encoding="utf-8")
    typed = re.findall(r"^(?:\$ )?sfms-robot (.+?)(?: #.*)?$", page, re.MULTILINE)
    assert len(typed) >= 6
    for text in typed:
        words, command = shlex.split(text), typer.main.get_command(app)
        while hasattr(command, "commands"):
            command = command.commands[words.pop(0)]
        command.make_context("sfms-robot", words)


# --- tables: no row is cut, wherever it goes --------------------------------------------------------------------

ROWS = [
    {"id": 11, "joint": "a_joint_with_quite_a_long_name", "model": "xl330-m288", "faults": "input voltage, overload"},
    {"id": 12, "joint": "a_second_joint", "model": "xl330-m288", "faults": "overheating, " * 8},
]


def test_what_reads_a_pipe_finds_whole_rows(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    print_table(ROWS)
    rows = capsys.readouterr().out.splitlines()
    for row in ROWS:
        assert any(all(str(value).strip() in line for value in row.values()) for line in rows)


def test_a_narrow_terminal_folds_texts_and_keeps_numbers(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "50")
    print_table(ROWS)
    told = capsys.readouterr().out
    assert "…" not in told and max(map(len, told.splitlines())) <= 50
    assert "11" in told and "12" in told and told.count("overheating") >= 8
