"""The doctor on emulated chains in virtual time: what it finds, and that its cures cure."""

import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial

import pytest
import typer

from sfms_robot.app.servo.diagnosis import Line, Wanted
from sfms_robot.app.servo.doctor import examine, examine_line
from sfms_robot.app.servo.serial_line import Wire
from sfms_robot.app.servo.single_servo import checked_ids, reboot, set_baud, write_register
from sfms_robot.cli.main import app
from sfms_robot.config import Faults, Threshold, load_firmware_map, map_files
from sfms_robot.data import head_file
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.runtime.clock import RealClock, VirtualClock
from sfms_robot.servo.families import servo_families
from sfms_robot.servo.port import SerialPort, VirtualTimePort
from sfms_robot.servo.stored_settings import JointNeeds

BAUD = 1_000_000


class Patient:
    """A chain, and the head that expects ids 1 to `count` of one model on it."""

    def __init__(self, chain: Chain, count: int, model: str, masked: Sequence[str]):
        number = load_firmware_map(model).model_number
        self.wanted = {
            i: Wanted(joint=f"joint{i}", model=model, model_number=number, faults=Faults(mask=tuple(masked)))
            for i in range(1, count + 1)
        }
        self.chain, self.clock = chain, VirtualClock()

    def port(self, baud: int = BAUD) -> VirtualTimePort:
        return VirtualTimePort(self.chain.device, self.chain.control, baud, self.clock)

    def examined(self, rate_hz: float = 100.0, fix=None, port=None, **line) -> dict:
        """`line`: what else is known of the port than that it is a face's."""
        usual = Line(
            bus="face", device=self.chain.device, shown="/dev/ttyUSB0", family="dynamixel2", baud=BAUD,
            rate_hz=rate_hz, wanted=self.wanted,
        )  # fmt: skip
        line = replace(usual, **line)
        return examine_line(line, port or partial(self.port, line.first_baud), fix=fix)

    @contextmanager
    def wire(self) -> Iterator[Wire]:
        port = self.port()
        try:
            yield Wire(port, "dynamixel2", BAUD)
        finally:
            port.close()

    def set(self, servo: int, register: str, value: int) -> None:
        with self.wire() as wire:
            write_register(wire.find(servo), register, str(value), lambda question: True)


@contextmanager
def patient(*servos: EmulatedServo, count: int = 3, model: str = "xl330-m288", masked: Sequence[str] = ()):
    with launch(servos or [EmulatedServo(i) for i in range(1, count + 1)], virtual=True) as chain:
        yield Patient(chain, count, model, masked)


def told(report: dict, severity: str) -> list[str]:
    return [f"{each['about']}: {each['problem']}" for each in report["findings"] if each["severity"] == severity]


def fix_of(report: dict, problem: str) -> str:
    return next(each["fix"] for each in report["findings"] if problem in each["problem"])


def test_a_sound_chain_is_fit_to_run_and_looking_changes_nothing():
    with patient() as sick:
        report = sick.examined()
        assert sick.examined() == report
    assert [(row["id"], row["joint"], row["model"], row["firmware"]) for row in report["servos"]] == [
        (i, f"joint{i}", "xl330-m288", 53) for i in (1, 2, 3)
    ]
    assert report["fast_sync_read"] is True and report["budget"]["plain"]["hz"] > 100


TWO = "two servos seem to answer to this id (or the wire is disturbed)"
SWAPPED = "id 2 (joint2): xl330-m077 (1190) answers, the head says xl330-m288 (1200)"
UNNAMED = "id 40: xl330-m288 at 1000000 baud is not in the head's file"
OTHERS = [EmulatedServo(1), EmulatedServo(2, model="xl330-m077"), EmulatedServo(3), EmulatedServo(40)]


@pytest.mark.parametrize(
    ("servos", "harm", "errors", "warnings", "fix"),
    [
        ([], "", [], [], ""),
        ([], "echo=1", [], [], ""),  # an adapter that hears itself
        ([], "silent:2", ["id 2 (joint2): no answer, at any rate"], [], "servo scan.*set-id OLD NEW"),
        ([], "silent", ["bus: no answer at any rate: none of 3 servos"], [], "power"),
        ([], "duplicate:2=1", [f"id 2: {TWO}"], [], "set-id 2"),
        (OTHERS, "", [SWAPPED], [UNNAMED], "cables swapped"),
    ],
)
def test_trouble_is_named_once_with_what_to_do(servos, harm, errors, warnings, fix):
    with patient(*servos) as sick:
        if harm:
            sick.chain.inject(harm)
        report = sick.examined()
    assert report["exit_code"] == (4 if errors else 0)
    assert (told(report, "error"), told(report, "warning")) == (errors, warnings)
    assert not errors or re.search(fix, report["findings"][0]["fix"])


def test_servos_at_another_rate_are_found_there_and_the_fix_brings_them_home():
    servos = [EmulatedServo(1), EmulatedServo(2, baud=57_600), EmulatedServo(3, baud=57_600)]
    with patient(*servos) as sick:
        report = sick.examined()
        assert told(report, "error") == ["ids 2-3: set to 57600 baud, the head says 1000000"]
        assert fix_of(report, "57600") == "sfms-robot servo set-baud 2-3 1000000 --port /dev/ttyUSB0 --baud 57600"
        with sick.wire() as wire:
            for servo in checked_ids("2-3"):
                set_baud(wire.find(servo), BAUD, lambda question: True)
        assert sick.examined()["exit_code"] == 0


def test_a_hardware_error_is_named_and_the_reboot_cures_it():
    with patient() as sick:
        sick.chain.fault(3, 0x24)
        report = sick.examined()
        assert told(report, "error") == ["id 3 (joint3): hardware error: overheating, overload"]
        assert fix_of(report, "overload").startswith("sfms-robot servo reboot 3 --port")
        with sick.wire() as wire:
            reboot(wire.find(3), lambda question: True)
        assert sick.examined()["exit_code"] == 0


@pytest.mark.parametrize("trouble", ["drop=0.4", "corrupt=0.4", "truncate=0.4", "noise=0.4", "delay=0.03", "silent:2"])
def test_whatever_the_wire_does_the_doctor_comes_to_an_end(trouble):
    with patient() as sick:
        sick.chain.inject(trouble)
        assert sick.examined()["exit_code"] in (0, 4)


def test_a_port_that_vanishes_meanwhile_is_a_finding():
    class Loose(VirtualTimePort):
        reads = 0

        def read(self, n: int, deadline_s: float) -> bytes:
            self.reads += 1
            if self.reads > 5:
                raise BusError(f"{self.name}: the device is gone")
            return super().read(n, deadline_s)

    with patient() as sick:
        report = sick.examined(port=lambda: Loose(sick.chain.device, sick.chain.control, BAUD, sick.clock))
    assert report["exit_code"] == 4 and "gone" in report["findings"][0]["problem"]


def test_a_servo_that_only_answers_pings_gets_its_voice_back_by_the_fix():
    with patient() as sick:
        sick.set(2, "status_return_level", 1)
        with sick.wire() as wire:
            field = wire.find(2).registers()["status_return_level"]
            wire.link.write(2, field.address, field.to_bytes(0))
        report = sick.examined()
        assert report["exit_code"] == 4
        assert "write 2 status_return_level 2" in fix_of(report, "does not answer when asked")
        sick.set(2, "status_return_level", 2)
        assert sick.examined()["exit_code"] == 0


def test_a_fault_that_the_head_lives_with_is_a_note_and_beyond_its_threshold_an_error():
    with patient(masked=["input voltage"]) as sick:
        sick.chain.fault(1, 0x01)
        report = sick.examined()
    assert report["exit_code"] == 0 and any("input voltage" in text for text in told(report, "note"))
    with patient() as sick:
        for servo, want in sick.wanted.items():
            sick.wanted[servo] = replace(want, faults=Faults(thresholds={"input voltage": Threshold(max=7.5)}))
        sick.chain.supply(7.2)
        sick.chain.fault(1, 0x01)
        assert sick.examined()["exit_code"] == 0
        sick.chain.supply(7.9)
        report = sick.examined()
    assert any("hardware error: input voltage" in text for text in told(report, "error"))
    assert any("supply 7.9 V is outside its limits 3.5..7.0 V" in text for text in told(report, "warning"))


def test_settings_that_a_run_puts_right_are_one_note_for_all_servos():
    with patient(*[EmulatedServo(i, firmware=50) for i in (1, 2, 3)]) as sick:
        notes = told(sick.examined(), "note")
    assert any("does not stop the motor" in note and "firmware 50" in note for note in notes)
    with patient() as sick:
        notes = told(sick.examined(), "note")
        assert notes == ["ids 1-3: return delay of 500 us before every answer (a run sets it to 0)"]
        for servo in (1, 2, 3):
            sick.set(servo, "return_delay_time", 0)
        assert told(sick.examined(), "note") == []


def test_a_wrong_mode_matters_only_under_torque():
    with patient() as sick:
        sick.set(1, "operating_mode", 1)
        assert sick.examined()["exit_code"] == 0
        sick.set(1, "torque_enable", 1)
        report = sick.examined()
    assert report["exit_code"] == 4 and "torque_enable 0" in fix_of(report, "operating_mode")


def test_without_a_head_everybody_is_listed_at_their_rate():
    with patient(EmulatedServo(1), EmulatedServo(2), EmulatedServo(9, baud=57_600)) as sick:
        report = sick.examined(bus=None, baud=None, wanted={})
    assert [(row["id"], row["baud"]) for row in report["servos"]] == [(1, BAUD), (2, BAUD), (9, 57_600)]
    assert report["exit_code"] == 0 and report["baud"] == BAUD


@pytest.mark.parametrize("family", servo_families())
def test_every_model_that_has_a_map_can_be_examined(family):
    maps = [load_firmware_map(file.stem) for file in map_files()]
    served = servo_families()[family].maps
    models = [each.model for each in maps if (each.family, each.protocol) == served and not each.variant_of]
    servos = [EmulatedServo(i, model, start_ticks=500) for i, model in enumerate(models, start=1)]
    with patient(*servos) as sick:
        wanted = {
            i: Wanted(joint=model, model=model, model_number=load_firmware_map(model).model_number)
            for i, model in enumerate(models, 1)
        }
        report = sick.examined(10.0, family=family, wanted=wanted)
    assert told(report, "error") == [] and [row["model"] for row in report["servos"]] == models
    fast = report["budget"] and report["budget"]["fast"]
    assert family == "dynamixel2" or (fast, report["fast_sync_read"]) == (None, None)
    assert all(row["voltage_V"] and row["faults"] == "" for row in report["servos"])


def board(model: str, family: str, baud: int, rate_hz: float, registers: dict | None = None, **line) -> dict:
    """What is said of 24 channels of a board."""
    with launch([EmulatedServo(i, model, baud, registers=registers or {}) for i in range(24)], virtual=True) as chain:
        sick = Patient(chain, 1, "xl330-m288", ())
        wanted = dict(enumerate([replace(sick.wanted[1], model=model)] * 24))
        return sick.examined(rate_hz, shown="/dev/ttyACM0", family=family, baud=baud, wanted=wanted, **line)


@pytest.mark.parametrize("model", ["maestro-24", "ssc-32"])
def test_a_board_that_answers_is_fit_and_one_that_does_not_comes_with_its_serial_mode(model):
    family = load_firmware_map(model).family
    assert told(board(model, family, 115_200, 50.0), "error") == []
    slow = board(model, family, 9_600, 50.0)
    assert slow["exit_code"] == 0 and slow["budget"]["write_only"]["ms"] > 50
    assert "Hz of 50" in told(slow, "warning")[0] and "24 servos" in told(slow, "note")[0]
    with patient() as sick:  # servos on the port where the board should be
        wanted = {0: replace(sick.wanted[1], model=model)}
        report = sick.examined(50.0, shown="/dev/ttyACM0", family=family, wanted=wanted)
    assert told(report, "error") == [f"bus: no {model} answers"] and report["exit_code"] == 4
    assert ("USB Dual Port" if family == "maestro" else "jumpers") in fix_of(report, "answers")


@pytest.mark.parametrize("stored", [{}, {"crc": 1}])
@pytest.mark.parametrize("crc", [False, True])
def test_a_maestro_answers_where_its_crc_setting_is_that_of_the_heads_file(stored, crc):
    report = board("maestro-24", "maestro", 115_200, 50.0, stored, crc=crc)
    if crc == bool(stored):
        assert told(report, "error") == []
    else:
        (problem,) = told(report, "error")  # the line of a run
        assert f"expects {'a' if stored else 'no'} CRC: set crc: {str(bool(stored)).lower()} for this bus" in problem
        assert "Enable CRC" in fix_of(report, "CRC")


def no_port(path: str) -> dict:
    line = Line(device=path, shown=path, family="dynamixel2", baud=BAUD, rate_hz=100.0, wanted={})
    return examine_line(line, partial(SerialPort, path, BAUD, RealClock()))


def test_a_port_that_somebody_holds_ends_in_three():
    with patient() as sick:
        with closing(SerialPort(sick.chain.device, BAUD, sick.clock)):
            report = no_port(sick.chain.device)
    assert report["exit_code"] == 3 and len(report["findings"]) >= 1


def test_the_port_of_a_head_is_opened_as_its_run_opens_it(tmp_path):
    text = head_file("op3_head").read_text()
    (tmp_path / "head.yaml").write_text(text.replace("rate_hz: 100}", "rate_hz: 100, rs485: rts}"))
    with patient() as sick:  # a pseudo terminal has no RTS line
        report = examine(sick.chain.device, str(tmp_path), None, None)
    assert report["exit_code"] == 3 and "rs485 = 'rts': this device has no RTS line" in str(report["findings"])


NARROW = {"min_position_limit": 1900, "max_position_limit": 2200}


def needing(sick, servo: int, needs: JointNeeds) -> None:
    sick.wanted[servo] = replace(sick.wanted[servo], needs=needs)


def test_limits_that_stop_a_joint_short_are_an_error_and_the_fix_cures_them():
    with patient(EmulatedServo(1, registers=NARROW), EmulatedServo(2), EmulatedServo(3)) as sick:
        for servo in sick.wanted:
            needing(sick, servo, JointNeeds(1462, 2634))
        errors = told(sick.examined(), "error")
        assert [each.split(":")[0] for each in errors] == ["id 1 (joint1)"] * 2
        assert "min_position_limit is 1900, wanted 1462" in errors[0]
        report = sick.examined(fix=lambda question: False)
        assert report["fixed"] == [] and len(told(report, "error")) == 2
        asked: list[str] = []
        report = sick.examined(fix=lambda question: not asked.append(question))
        assert len(asked) == 2 and "min_position_limit 1900 -> 1462" in asked[0]
        assert report["exit_code"] == 0 and len(report["fixed"]) == 2
        assert told(sick.examined(), "error") == []


def test_a_servo_turned_past_one_turn_is_brought_back_by_the_fix():
    with patient(EmulatedServo(1, start_ticks=4150), count=1) as sick:
        needing(sick, 1, JointNeeds(1462, 2634))
        assert "present_position is 4150, wanted 54" in told(sick.examined(), "error")[0]
        assert sick.examined(fix=lambda question: True)["fixed"] == ["id 1: present_position 4150 -> 54"]
        assert told(sick.examined(), "error") == []


def test_what_acts_by_itself_or_shifts_angles_is_told_and_without_a_head_left_alone():
    stored = {"startup_configuration": 1, "secondary_id": 2, "homing_offset": 100, "drive_mode": 1, "shutdown": 0}
    with patient(EmulatedServo(1, registers=stored), EmulatedServo(3), count=1) as sick:
        needing(sick, 1, JointNeeds(1462, 2634, other_ids=frozenset({2})))
        report = sick.examined()
    said = " ".join(told(report, "error") + told(report, "warning"))
    assert all(f"{name} is {value}" in said for name, value in stored.items())
    with patient(EmulatedServo(1, registers={"homing_offset": 100, "drive_mode": 1}), count=1) as sick:
        report = sick.examined(wanted={}, fix=lambda question: True)
    assert len(told(report, "warning")) == 2 and report["fixed"] == [] and report["exit_code"] == 0


def test_every_command_that_is_proposed_is_one_that_the_program_has():
    servos = [EmulatedServo(1, baud=57_600), EmulatedServo(2), EmulatedServo(4)]
    with patient(*servos, count=3) as sick:
        sick.chain.fault(2, 0x20)
        report = sick.examined()
    root = typer.main.get_command(app)
    fixes = "\n".join(each["fix"] for each in report["findings"])
    proposed = re.findall(r"sfms-robot (servo .+?)(?=, then|$)", fixes, re.MULTILINE)
    assert len(proposed) >= 4
    for text in proposed:
        words = shlex.split(text.replace("OLD", "1").replace("NEW", "2"))
        root.commands[words[0]].commands[words[1]].make_context(words[1], words[2:], resilient_parsing=False)


@pytest.mark.parametrize("where", [{"port": "sim", "head": None}, {"port": "/dev/null", "head": "reachy_mini"}])
@pytest.mark.parametrize(("flag", "value"), [("--baud", 57600), ("--family", "feetech")])
def test_what_a_heads_file_says_is_not_said_once_more(where, flag, value):
    said = {"family": None, "baud": None, flag.removeprefix("--"): value}
    with pytest.raises(ConfigError, match=f"^{flag} {value}: head '{where['head'] or 'face28'}'"):
        examine(**where, **said)
