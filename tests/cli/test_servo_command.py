"""`servo` and `doctor` as they are typed, on an emulated chain in real time."""

import re
import shlex
from pathlib import Path

import pytest
import typer

import sfms_robot
from sfms_robot.cli.main import app
from sfms_robot.emulator.launch import EmulatedServo, launch


@pytest.fixture(scope="module")
def device():
    """Ids 1 and 2 at 1 Mbaud."""
    with launch([EmulatedServo(1), EmulatedServo(2, start_ticks=1500)]) as chain:
        yield chain.device


@pytest.fixture
def servo(command_line, device):
    """Run `sfms-robot servo WORDS`; the exit code, and the list under `key` of what --json prints."""

    def run(words: str, key: str):
        ended = command_line("servo", *words.split(), "--port", device, "--baud", 1_000_000, "--json")
        return ended.code, ended.told[key]

    return run


VOLTAGE = "present_input_voltage"
LED = {"id": 1, "register": "led", "before": 0, "raw": 1, "value": 1.0, "unit": "bool"}
READ = [(servo, register) for servo in (1, 2) for register in ("present_position", VOLTAGE)]


@pytest.mark.parametrize(
    ("words", "code", "key", "part", "rows"),
    [
        ("ping 1,2", 0, "servos", lambda row: (row["id"], row["model"]), [(1, "xl330-m288"), (2, "xl330-m288")]),
        ("ping 1,9", 4, "servos", lambda row: row["answers"], [True, False]),
        ("scan --ids 1-3", 0, "servos", lambda row: row["id"], [1, 2]),
        ("read 1-2 present_position voltage", 0, "registers", lambda row: (row["id"], row["register"]), READ),
        ("write 1 led 1", 0, "written", lambda row: row, [LED]),
        ("write 1-2 return_delay_time 0 --yes", 0, "written", lambda row: row["raw"], [0, 0]),
        ("monitor 1-2 --samples 2 --rate 50", 0, "samples", lambda rows: rows[1]["position"], [1500, 1500]),
    ],
)
def test_each_command_prints_a_row_for_each_servo(servo, words, code, key, part, rows):
    ended, told = servo(words, key)
    assert (ended, [part(row) for row in told]) == (code, rows)


def test_the_doctor_finds_a_directory_that_is_no_port_and_an_emulated_head_that_is_fit(command_line, tmp_path):
    ended = command_line("doctor", "--json", "--port", tmp_path)
    assert ended.code == 3 and "directory" in ended.told["findings"][0]["problem"]
    ended = command_line("doctor", "--port", "sim", "--head", "face28")
    assert not ended.code and "fit to run: 0 errors" in ended.out and "the loop with 28 servos" in ended.out


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


def test_the_tables_for_people_hold_what_json_holds(command_line, device, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)  # pytest-xdist sets it
    for words in ("ping 1", "read 1 all", "monitor 1 --samples 1"):
        out = command_line("servo", *words.split(), "--port", device, "--baud", 1_000_000).out
        assert "xl330-m288" in out or "goal_position" in out


def test_every_command_on_the_page_for_makers_is_one_that_the_program_has():
    page = (Path(sfms_robot.__file__).parents[1] / "docs" / "guide" / "servos.md").read_text(encoding="utf-8")
    typed = re.findall(r"^(?:\$ )?sfms-robot (.+?)(?: #.*)?$", page, re.MULTILINE)
    assert len(typed) >= 6
    for text in typed:
        words, command = shlex.split(text), typer.main.get_command(app)
        while hasattr(command, "commands"):
            command = command.commands[words.pop(0)]
        command.make_context("sfms-robot", words)
