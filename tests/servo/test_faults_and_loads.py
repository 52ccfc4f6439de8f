"""Faults and loads of emulated servos, and what the head's configuration makes of them. In virtual time."""

import numpy as np
import pytest
from chain_rig import plugged
from emulated_port import bus_servo
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import Faults, Safety, Threshold, load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.servo.policy import counts, load_rules

RAD_PER_TICK = 2 * np.pi / 4096
OVERLOAD, VOLTAGE = 1 << 5, 1 << 0


def three(**more):
    return plugged([EmulatedServo(i, start_ticks=2048) for i in (1, 2, 3)], **more)


def test_servo_that_is_rebooted_waits_where_it_stands():
    rig = three(safety=Safety(on_fault="reboot_and_ease_in"))
    held = rig.hold()
    rig.ticks(held, 10)
    rig.fault(2, OVERLOAD)
    seconds, readings = rig.until(held + 0.4, lambda r: r["joint2"].rejoined, 2.0)
    assert 0.3 < seconds < 1.5 and readings["joint2"].fault is None
    assert rig.register(2, "hardware_error_status") == 0 and rig.register(2, "torque_enable") == 1
    readings = rig.ticks(held + 0.4, 30)
    assert readings["joint2"].position_rad == pytest.approx(held[1], abs=2 * RAD_PER_TICK)


def test_masked_fault_does_not_hide_another():
    rig = three(faults=Faults(mask=("input voltage",)))
    held = rig.hold()
    rig.ticks(held, 5)
    rig.fault(2, 1 << 4)
    readings = rig.ticks(held, 10)
    assert readings["joint2"].fault == "electrical shock"
    rig.fault(2, OVERLOAD)
    readings = rig.ticks(held, 30)
    assert readings["joint2"].fault == "electrical shock, overload"
    assert rig.bus.statistics()["faults"] == ["joint2: electrical shock", "joint2: electrical shock, overload"]


@given(st.floats(0.0, 30.0))
def test_threshold_decides_by_what_is_measured(voltage_V):
    faults = Faults(thresholds={"input voltage": Threshold(min=4.5, max=7.8)})
    assert counts("input voltage", faults, {"input voltage": voltage_V}) == (not 4.5 <= voltage_V <= 7.8)
    assert counts("input voltage", faults, {}) and counts("overload", faults, {"input voltage": voltage_V})


def test_every_servo_with_a_current_sensor_has_a_pinch_rule():
    [(name, rule)] = load_rules(bus_servo("jaw", 1, load_firmware_map("xl330-m288"), safety=Safety()))
    assert name == "pinched" and rule.current_mA == pytest.approx(0.6 * 1750) and rule.then == "limp"


def test_torque_is_limited_where_current_cannot_be_and_halved_by_a_fault():
    servos = [EmulatedServo(1, "xl430-w250")]
    safety = Safety(torque_limit_percent=50, on_fault="reduce")
    rig = plugged(servos, maps=[load_firmware_map("xl430-w250")], safety=safety)
    rig.ticks(rig.hold(), 3)
    assert rig.register(1, "goal_pwm") == 442
    rig.fault(1, VOLTAGE)  # which its shutdown mask leaves out
    rig.ticks(np.zeros(1), 20)
    assert rig.register(1, "goal_pwm") == 221
