import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import load_firmware_map
from sfms_robot.servo.registers import Table

MAP = load_firmware_map("xl330-m288")
TABLE = Table.of(MAP)


@given(st.sampled_from(sorted(TABLE.fields)), st.data())
def test_every_register_takes_its_whole_range(name, data):
    field = TABLE[name]
    raw = data.draw(st.integers(field.low, field.high))
    assert len(field.to_bytes(raw)) == field.size
    assert field.from_bytes(field.to_bytes(raw)) == raw


def test_value_that_does_not_fit_is_refused():
    with pytest.raises(OverflowError):
        TABLE["torque_enable"].to_bytes(256)


def test_low_byte_comes_first_and_negative_is_twos_complement():
    assert TABLE["goal_position"].to_bytes(-2) == b"\xfe\xff\xff\xff"
    assert TABLE["goal_current"].to_bytes(0x123) == b"\x23\x01"


def test_current_velocity_and_position_are_one_block():
    assert TABLE.span(["present_position", "present_current", "present_velocity"]) == (126, 10)


def test_table_survives_json():
    assert Table.from_plain(json.loads(json.dumps(MAP.model_dump(mode="json")))) == TABLE


def test_faults_are_named():
    assert TABLE.fault_names(0) == ""
    assert TABLE.fault_names(0b100100) == "overheating, overload"
    assert TABLE.fault_names(0b10) == "hardware error bit 1"


def test_shipped_map_states_what_the_maker_publishes():
    assert MAP.model_number == 1200
    assert TABLE["goal_position"].address == 116 and TABLE["present_position"].address == 132
    assert TABLE.baud_codes[3] == 1_000_000
    assert "ROBOTIS" in MAP.source
