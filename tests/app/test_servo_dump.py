"""Registers of a servo in a file and back into another one of the same model."""

import pytest
from test_single_servo import no, put, wire_on, yes

from sfms_robot.app.servo.single_servo import differences, dump, load_dump, restore, save_dump
from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.errors import ConfigError, ServoError

SET = {
    "xl330-m288": ("dynamixel2", {"homing_offset": 120, "min_position_limit": 900, "current_limit": 800}),
    "ax-12a": ("dynamixel1", {"cw_angle_limit": 200, "ccw_angle_limit": 800}),
    "sts3215": ("feetech", {"homing_offset": -40, "max_position_limit": 3000}),
}


def new(servo, model, **registers):
    return EmulatedServo(servo, model, start_ticks=load_firmware_map(model).center_ticks, registers=registers)


@pytest.mark.parametrize("model", SET)
def test_a_new_servo_becomes_the_old_one_and_keeps_its_own_id(model, tmp_path):
    family, registers = SET[model]
    with wire_on(new(1, model, **registers), new(2, model), family=family) as (wire, _):
        save_dump(dump([wire.find(1)]), tmp_path / "servos.yaml")
        (was,) = load_dump(tmp_path / "servos.yaml").servos
        assert (was.id, was.model) == (1, model)
        assert {name for name, *_ in differences(wire.find(2), was)} == set(registers)
        rows = restore(wire.find(2), was, yes)
        assert {row["register"]: row["raw"] for row in rows} == registers
        assert differences(wire.find(2), was) == []


def test_id_and_rate_come_along_only_when_asked_for(tmp_path):
    with wire_on(EmulatedServo(5, baud=57_600)) as (wire, _):
        kept = dump([wire.find(5)]).servos[0]
    with wire_on(EmulatedServo(1)) as (wire, _):
        assert restore(wire.find(1), kept, yes) == []
        restore(wire.find(1), kept, yes, identity=True)
        assert (wire.find(5).id, wire.baud) == (5, 57_600)


def test_another_model_is_refused():
    with wire_on(EmulatedServo(1), EmulatedServo(2, "xl330-m077")) as (wire, _):
        kept = dump([wire.find(1)]).servos[0]
        with pytest.raises(ConfigError, match="is not the model of the file"):
            restore(wire.find(2), kept, yes)


def test_nothing_is_written_unasked_or_under_torque():
    with wire_on(EmulatedServo(1, registers={"homing_offset": 120}), EmulatedServo(2)) as (wire, _):
        kept = dump([wire.find(1)]).servos[0]
        with pytest.raises(ConfigError, match="not confirmed"):
            restore(wire.find(2), kept, no)
        put(wire, 2, "torque_enable", 1)
        with pytest.raises(ServoError, match="has torque on"):
            restore(wire.find(2), kept, yes)
        assert [name for name, *_ in differences(wire.find(2), kept)] == ["homing_offset"]


def test_a_file_that_is_there_is_not_overwritten(tmp_path):
    file = tmp_path / "servos.yaml"
    file.write_text("precious")
    with wire_on(EmulatedServo(1)) as (wire, _):
        with pytest.raises(ConfigError, match="is there already"):
            save_dump(dump([wire.find(1)]), file)
    assert file.read_text() == "precious"
