import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import load_firmware_map
from sfms_robot.servo.registers import Table

X = Table.of(load_firmware_map("xl330-m288"))
AX = Table.of(load_firmware_map("ax-12a"))
MX = Table.of(load_firmware_map("mx-64-1.0"))
STS = Table.of(load_firmware_map("sts3215"))
SCS = Table.of(load_firmware_map("scs0009"))
MAESTRO = Table.of(load_firmware_map("maestro-24"))
SERVOS = {table.model: table for table in (X, AX, MX, STS, SCS)}


@given(st.sampled_from([(table, name) for table in SERVOS.values() for name in sorted(table.fields)]), st.data())
def test_every_register_takes_its_whole_range(register, data):
    field = register[0][register[1]]
    value = data.draw(st.integers(field.low, field.high))
    assert len(field.to_bytes(value)) == field.size and field.from_bytes(field.to_bytes(value)) == value


@given(st.sampled_from([(table, name) for table in SERVOS.values() for name in sorted(table.fields)]), st.binary())
def test_whatever_a_servo_sends_has_a_value(register, data):
    assert isinstance(register[0][register[1]].from_bytes(data.ljust(4, b"\xff")), int)


@pytest.mark.parametrize(
    ("table", "name", "value", "raw"),
    [
        (X, "goal_position", -2, "fe ff ff ff"),
        (X, "goal_current", 0x123, "23 01"),
        (X, "bus_watchdog", -1, "ff"),
        (AX, "moving_speed", -5, "05 04"),
        (MX, "current", 10, "0a 08"),
        (MX, "current", -2048, "00 00"),
        (STS, "goal_position", 0x0123, "23 01"),
        (STS, "goal_position", -1, "01 80"),
        (STS, "homing_offset", -2047, "ff 0f"),
        (SCS, "goal_position", 0x0123, "01 23"),
        (SCS, "goal_velocity", -2, "80 02"),
    ],
    ids=str,
)
def test_sign_rule_and_byte_order_are_the_models_own(table, name, value, raw):
    assert table[name].to_bytes(value) == bytes.fromhex(raw) and table[name].from_bytes(bytes.fromhex(raw)) == value


@pytest.mark.parametrize(
    ("table", "name", "value"),
    [(X, "torque_enable", 256), (X, "torque_enable", -1), (STS, "homing_offset", 2048), (MX, "current", -2049)],
    ids=str,
)
def test_value_that_does_not_fit_is_refused(table, name, value):
    with pytest.raises(OverflowError):
        table[name].to_bytes(value)


def test_faults_and_the_error_byte_name_what_is_the_servos():
    assert X.faults_in(0) == AX.faults_in(0b0001_0000) == []
    assert X.faults_in(0b100100) == AX.faults_in(0b0110_0100) == ["overheating", "overload"]
    assert X.faults_in(0b10) == ["hardware error bit 1"]


@pytest.mark.parametrize(
    ("role", "names"),
    [
        ("present_speed", ["present_velocity", "present_speed", "present_speed"] + ["present_velocity"] * 2),
        ("status_level", ["status_return_level"] * 3 + ["response_level"] * 2),
        ("error_status", ["hardware_error_status", None, None, "status", "status"]),
        ("present_current", ["present_current", None, "current", "present_current", "present_current"]),
        ("bus_watchdog", ["bus_watchdog", None, None, None, None]),
    ],
)
def test_role_leads_to_the_register_of_each_family(role, names):
    found = [table.role(role) for table in SERVOS.values()]
    assert [field.name if field else None for field in found] == names


def test_lock_until_power_off_is_not_the_lock_that_tools_open_and_close():
    assert AX["lock"].writable and AX.role("lock") is None
    assert STS.role("lock") == STS["lock"]
