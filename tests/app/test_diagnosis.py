"""Findings without a wire: what to type, and the wire budget against packets and figures of real chains."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.app.servo import diagnosis
from sfms_robot.app.servo.serial_line import FoundServo
from sfms_robot.app.servo.single_servo import checked_ids
from sfms_robot.config import Faults
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.discovery import Holder, SerialDevice

BAUD = 1_000_000


def line_on(shown, family="dynamixel2", head=None, ports=None):
    return diagnosis.Line(device=shown, shown=shown, family=family, head=head, ports=ports)


LINE = line_on("/dev/ttyUSB0")
FACTORY = {"baud": 57_600, "return_delay_us": 500.0, "latency_ms": 16.0}
TUNED = {"baud": 1_000_000, "return_delay_us": 0.0, "latency_ms": 1.0}


@given(servos=st.integers(1, 40), read=st.integers(1, 20), write=st.sampled_from([2, 4]))
def test_bytes_are_those_of_the_packets(servos, read, write):
    ids, head = bytes(range(1, servos + 1)), bytes([116, 0, write, 0])
    goals = dxl2.encode_instruction(
        dxl2.BROADCAST, dxl2.SYNC_WRITE, head + b"".join(bytes([i]) + bytes(write) for i in ids)
    )
    ask = dxl2.encode_instruction(dxl2.BROADCAST, dxl2.SYNC_READ, bytes([132, 0, read, 0]) + ids)
    answers = servos * len(dxl2.encode_status(1, 0, bytes(read)))
    fast = len(dxl2.encode_fast_status([(i, 0, bytes(read)) for i in ids]))
    budget = diagnosis.wire_budget("dynamixel2", servos, **TUNED, read_bytes=read, write_bytes=write)
    assert budget["write_only"]["bytes"] == len(goals)
    assert budget["plain"]["bytes"] == len(goals) + len(ask) + answers
    assert budget["fast"]["bytes"] == len(goals) + len(ask) + fast


def test_single_reads_pay_the_adapter_once_per_servo_and_fast_sync_read_makes_a_bus_fast_enough():
    slow = diagnosis.wire_budget("dynamixel1", 9, 1_000_000, 500.0, 16.0, read_bytes=2, write_bytes=2)
    assert slow["plain"]["ms"] == pytest.approx(150, abs=0.5) and slow["fast"] is None
    assert diagnosis.wire_budget("feetech", 9, 1_000_000, 0.0, 16.0, 2, 2, together=False)["plain"]["ms"] > 9 * 16
    assert diagnosis.wire_budget("feetech", 9, 1_000_000, 0.0, 16.0, 2, 2)["plain"]["ms"] < 18
    budget = diagnosis.wire_budget("dynamixel2", 28, 1_000_000, 500.0, 1.0, read_bytes=4)
    assert next(diagnosis.judge_rate(budget, LINE, True)).severity == "note"
    assert next(diagnosis.judge_rate(budget, LINE, False)).severity == "warning"


def test_what_is_to_be_typed_reaches_the_servos_it_is_about():
    words = "write 19 return_delay_time 0"
    assert LINE.servo(words, BAUD).endswith("--port /dev/ttyUSB0 --baud 1000000")
    assert line_on("/dev/ttyUSB0", "feetech", "face").servo(words).endswith("--port /dev/ttyUSB0 --family feetech")
    assert line_on("sim", "feetech", "face").servo(words, BAUD).endswith("--port sim --head face")
    assert line_on("sim", "feetech").servo(words, BAUD).endswith("--port sim --baud 1000000 --family feetech")
    two = line_on("/dev/a", "feetech", "my face", "face=/dev/a,neck=/dev/b")
    assert two.fix == "sfms-robot doctor --port face=/dev/a,neck=/dev/b --head 'my face' --fix"


def test_permissions_holders_latency_and_a_udev_rule_come_with_what_to_type():
    denied = diagnosis.judge_port("/dev/ttyUSB0", "no permission to open it", "dialout", [])
    assert denied.severity == "error" and denied.fix.startswith("sudo usermod -aG dialout $USER")
    busy = list(diagnosis.judge_opening("/dev/ttyUSB0", "/dev/ttyUSB0: is held", [Holder(42, "python wizard.py")]))
    assert busy[0].fix == "kill 42" and "wizard.py" in busy[0].problem
    slow = SerialDevice("/dev/ttyUSB0", latency_ms=16, latency_file="/sys/bus/usb-serial/devices/ttyUSB0/latency_timer")
    (finding,) = diagnosis.judge_adapter(slow, [])
    assert finding.fix.startswith("echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer ")
    assert list(diagnosis.judge_adapter(SerialDevice("/dev/ttyUSB0", latency_ms=1), [])) == []
    ftdi = SerialDevice(
        "/dev/ttyUSB0", vendor="0403", product="6014", serial="FT4TFS1T", driver="ftdi_sio", latency_file="/sys/x"
    )
    timer, name = diagnosis.udev_rule(ftdi).splitlines()
    assert 'DRIVER=="ftdi_sio"' in timer and 'ATTR{latency_timer}="1"' in timer
    assert 'ATTRS{serial}=="FT4TFS1T"' in name and 'SYMLINK+="servos-FT4TFS1T"' in name
    ch340 = SerialDevice("/dev/ttyUSB1", vendor="1a86", product="7523")
    assert diagnosis.udev_rule(ch340).endswith('SYMLINK+="servos-$env{ID_PATH_TAG}"')  # two of a kind: by their socket
    assert diagnosis.udev_rule(SerialDevice("/dev/ttyS0")) is None


@pytest.mark.parametrize(
    ("wire", "blamed"),
    [(FACTORY, "baud"), ({**TUNED, "latency_ms": 16.0}, "latency"), ({**TUNED, "return_delay_us": 500.0}, "delay")],
)
def test_a_bus_that_is_too_slow_is_told_what_takes_the_time(wire, blamed):
    budget = diagnosis.wire_budget("dynamixel2", 25, **wire, read_bytes=4)
    (finding,) = diagnosis.judge_rate(budget, LINE, False)
    assert finding.severity == "warning" and f"{blamed} takes most)" in finding.problem


def test_findings_alike_are_one_the_worst_come_first_and_an_unknown_model_is_named_once():
    notes = [diagnosis.Finding("note", f"id {i}", "slow", "do {id}", servo=i) for i in (3, 1, 2)]
    out = diagnosis.grouped([*notes, diagnosis.duplicate_id(7, LINE)])
    assert [(each.severity, each.about) for each in out] == [("error", "id 7"), ("note", "ids 1-3")]
    assert out[1].fix == "do 1-3"
    wanted = {1: diagnosis.Wanted(joint="jaw", model="sts3215", model_number=777, faults=Faults())}
    seen = FoundServo(id=1, baud=BAUD, model_number=2307, firmware=3, firmware_minor=9, table=None, wire=None)
    line = diagnosis.Line(device="/dev/ttyUSB0", shown="/dev/ttyUSB0", family="feetech", wanted=wanted)
    (found,) = diagnosis.judge_presence(line, [seen], BAUD)
    assert found.problem == "unknown (2307) answers, the head says sts3215 (777)"


@pytest.mark.parametrize("ids", [[1], [1, 2, 3], [1, 3, 5], [9, 1, 2, 12, 11]])
def test_ids_are_written_as_the_commands_take_them(ids):
    assert checked_ids(diagnosis.ids_text(ids)) == sorted(ids)
