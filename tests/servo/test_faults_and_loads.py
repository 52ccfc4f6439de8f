"""Faults and loads of emulated servos, and what the head's configuration makes of them. In virtual time."""

import logging

import numpy as np
import pytest
from chain_rig import plugged
from emulated_port import bus_servo
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import Faults, LoadRule, Safety, Threshold, load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.servo.chain.member import Member, Notices
from sfms_robot.servo.chain.protocol2 import Dynamixel2Startup
from sfms_robot.servo.policy import counts, load_rules
from sfms_robot.servo.stored_settings import JointNeeds

RAD_PER_TICK = 2 * np.pi / 4096
OVERLOAD, VOLTAGE = 1 << 5, 1 << 0


def three(**more):
    return plugged([EmulatedServo(i, start_ticks=2048) for i in (1, 2, 3)], **more)


@pytest.mark.parametrize("policy", ["limp", "hold", "reduce", "reboot_and_ease_in"])
def test_fault_stops_one_joint_and_no_other(policy):
    rig = three(safety=Safety(on_fault=policy))
    held = rig.hold()
    rig.ticks(held, 10)
    rig.fault(2, OVERLOAD)
    readings = rig.ticks(held + 0.3, 30)
    assert readings["joint2"].fault == "overload" or policy == "reboot_and_ease_in"
    assert readings["joint1"].fault is None and readings["joint3"].fault is None
    assert rig.bus.statistics()["faults"] == ["joint2: overload"]
    rig.ticks(held + 0.3, 30)
    assert rig.state(1)["position"] == pytest.approx(2048 + 0.3 / RAD_PER_TICK, abs=3)


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


def test_masked_fault_is_reported_by_nobody_and_acted_upon_by_nobody(caplog):
    caplog.set_level(logging.INFO)
    rig = three(faults=Faults(mask=("input voltage",)))
    for servo in (1, 2, 3):
        rig.fault(servo, VOLTAGE)
    rig.bus.connect()
    rig.bus.close()
    allowed = [r for r in caplog.records if "which this head's configuration allows" in r.message]
    assert len(allowed) == 3
    assert rig.bus.statistics()["faults"] == []


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


def test_alert_of_a_head_at_seven_volts_is_no_fault_by_its_own_threshold():
    faults = Faults(thresholds={"input voltage": Threshold(min=4.5, max=7.8)})
    at_7V2 = [EmulatedServo(i, supply_v=7.2, registers={"shutdown": 52}) for i in (1, 2)]
    rig = plugged(at_7V2, faults=faults)
    readings = rig.ticks(rig.hold(), 60)
    assert readings["joint1"].extra["voltage_V"] == pytest.approx(7.2)
    assert [r.fault for r in readings.values()] == [None, None]
    assert rig.bus.statistics()["faults"] == []


def jaw(**safety):
    servo = bus_servo("jaw", 1, load_firmware_map("xl330-m288"), safety=Safety(**safety))
    startup = Dynamixel2Startup(servo, JointNeeds(0, 4095), {})
    return servo, Member(0, startup, Faults(), {}, Notices("main", 1))


def test_pinch_needs_current_without_a_break():
    _, member = jaw(pinch=LoadRule(current_mA=100, for_s=0.1))
    member.enabled()
    for current_mA, now_s in ((150, 0.00), (50, 0.06), (-150, 0.08)):
        member.take_current(current_mA, now_s)
        assert member.state == "online"
    member.take_current(-150, 0.19)
    assert member.state == "limp" and member.fault == "pinched"


def test_every_servo_with_a_current_sensor_has_a_pinch_rule():
    servo, _ = jaw()
    [(name, rule)] = load_rules(servo)
    assert name == "pinched" and rule.current_mA == pytest.approx(0.6 * 1750) and rule.then == "limp"


def test_pinched_joint_goes_limp_and_comes_back_later():
    rig = three(safety=Safety(pinch=LoadRule(current_mA=200, for_s=0.2)))
    held = rig.hold()
    rig.ticks(held, 10)
    rig.servo(2).plant.stuck = True
    seconds, _ = rig.until(held + 0.3, lambda r: rig.state(2)["torque"] == 0, 2.0)
    assert seconds < 1.0
    assert any(fault.startswith("joint2: pinched") for fault in rig.bus.statistics()["faults"])
    rig.servo(2).plant.stuck = False
    seconds, readings = rig.until(held, lambda r: r["joint2"].rejoined, 5.0)
    assert seconds > 2.0
    assert rig.bus.statistics()["supply_peak_mA"] > 200


def test_current_limit_is_the_servos_own_job():
    rig = three(safety=Safety(current_limit_mA=300))
    held = rig.hold()
    rig.ticks(held, 3)
    assert rig.register(1, "operating_mode") == 5 and rig.register(1, "goal_current") == 300
    assert rig.ticks(held + 0.2, 100)["joint1"].position_rad == pytest.approx(0.2, abs=3 * RAD_PER_TICK)


def test_torque_is_limited_where_current_cannot_be_and_halved_by_a_fault():
    servos = [EmulatedServo(1, "xl430-w250")]
    safety = Safety(torque_limit_percent=50, on_fault="reduce")
    rig = plugged(servos, maps=[load_firmware_map("xl430-w250")], safety=safety)
    rig.ticks(rig.hold(), 3)
    assert rig.register(1, "goal_pwm") == 442
    rig.fault(1, VOLTAGE)  # which its shutdown mask leaves out
    rig.ticks(np.zeros(1), 20)
    assert rig.register(1, "goal_pwm") == 221
