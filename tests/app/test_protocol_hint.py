"""Asked in the wrong protocol, servos are named in theirs, quickly."""

import pytest
from test_single_servo import wire_on

from sfms_robot.app.servo.serial_line import protocol_hint
from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo

SPOKEN = {"xl330-m288": "dynamixel2", "ax-12a": "dynamixel1", "sts3215": "feetech"}
ASKED = ("dynamixel2", "dynamixel1", "feetech")


@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize(("model", "baud"), [("xl330-m288", 57_600), ("ax-12a", 1_000_000), ("sts3215", 1_000_000)])
def test_servos_of_another_protocol_are_named(model, baud, asked):
    servos = [EmulatedServo(i, model, baud, load_firmware_map(model).center_ticks) for i in (1,)]
    with wire_on(*servos, family=asked) as (wire, _):
        before, began_s = wire.baud, wire.clock.now_s()
        hint = protocol_hint(wire)
        spoken = SPOKEN[model]
        assert ("" if spoken == asked else f"--family {spoken}") in hint and bool(hint) == (spoken != asked)
        assert wire.baud == before and wire.clock.now_s() - began_s < 3.0


def test_an_empty_wire_gives_no_hint():
    with wire_on(EmulatedServo(1, baud=4_000_000)) as (wire, chain):
        chain.kill(1)
        assert protocol_hint(wire) == ""
