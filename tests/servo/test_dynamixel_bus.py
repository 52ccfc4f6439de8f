import math
import time

import numpy as np
import pytest

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo, launch
from sfms_robot.errors import BusError, ServoError
from sfms_robot.servo.chain.dynamixel2_bus import Dynamixel2Bus
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import SerialPort

RAD_PER_TICK = 2 * math.pi / 4096


def test_servos_are_identified_and_left_without_torque(rig):
    rig.bus.connect()
    readings = rig.bus.poll(0.0)
    assert [round(r.position_rad / RAD_PER_TICK) + 2048 for r in readings.values()] == [1900, 2048, 2300, 2100]
    with pytest.raises(ValueError, match="no joint is enabled"):
        rig.bus.write(np.zeros(4), 0.0)


def test_torque_comes_on_without_a_jump(rig):
    held = rig.hold()
    rig.clock.t = 2.0  # plenty of time to move, had the goal been another
    readings = rig.bus.poll(2.0)
    assert held == pytest.approx([(t - 2048) * RAD_PER_TICK for t in (1900, 2048, 2300, 2100)])
    assert [r.position_rad for r in readings.values()] == pytest.approx(held, abs=RAD_PER_TICK)


def test_goal_is_reached_and_motion_is_seen_on_the_way(rig):
    held = rig.hold()
    moving = rig.ticks(held + 0.3, 5)
    assert all(r.extra["velocity_rad_s"] > 0.1 for r in moving.values())
    arrived = rig.ticks(held + 0.3, 60)
    assert [r.position_rad for r in arrived.values()] == pytest.approx(held + 0.3, abs=RAD_PER_TICK)
    assert all(r.age_s == 0.0 and r.fault is None for r in arrived.values())


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1.2, -1.2])
def test_bad_goal_is_refused_with_nothing_sent(rig, bad):
    held = rig.hold()
    rig.bus.poll(0.0)
    before = rig.chain.digest()
    goals = held.copy()
    goals[2] = bad
    with pytest.raises(ValueError, match="joint3"):
        rig.bus.write(goals, 0.01)
    rig.bus.close()
    assert rig.chain.digest() == before


def test_goals_of_the_wrong_number_are_refused(rig):
    rig.hold()
    with pytest.raises(ValueError, match="4 joints"):
        rig.bus.write(np.zeros(3), 0.0)


def test_joint_outside_its_limits_is_held_and_may_only_come_in(make_rig):
    with make_rig([EmulatedServo(1, start_ticks=3000)]) as rig:
        held = rig.hold()
        assert held[0] == pytest.approx((3000 - 2048) * RAD_PER_TICK)  # 1.46 rad, limit 1
        assert rig.ticks(held, 20)["joint1"].position_rad == pytest.approx(held[0], abs=RAD_PER_TICK)
        assert rig.ticks([1.2], 50)["joint1"].position_rad == pytest.approx(1.2, abs=RAD_PER_TICK)
        with pytest.raises(ValueError, match="joint1"):
            rig.bus.write(np.array([1.3]), rig.clock.t)
        rig.ticks([0.5], 1)
        with pytest.raises(ValueError, match="joint1"):
            rig.bus.write(np.array([1.1]), rig.clock.t)


def test_wrong_model_is_named(make_rig):
    other = load_firmware_map("xl330-m288").model_copy(update={"model": "xl330-m077", "model_number": 1190})
    with make_rig([EmulatedServo(1)], firmware_map=other) as rig:
        with pytest.raises(
            ServoError, match=r"joint1 \(id 1\) is model number 1200, the head says xl330-m077 \(1190\)"
        ):
            rig.bus.connect()


def test_absent_servo_is_a_silent_member_that_comes_in_when_it_appears(make_rig):
    with make_rig([EmulatedServo(i, start_ticks=2000) for i in (1, 2, 3)]) as rig:
        rig.chain.kill(2)
        held = rig.hold()
        assert held[1] == 0.0
        readings = rig.ticks(held, 10)
        assert readings["joint2"].fault == "no answer" and readings["joint2"].position_rad is None
        assert readings["joint1"].age_s == 0.0 and rig.chain.state(2)["torque"] == 0
        rig.chain.revive(2)
        _, readings = rig.until(held, lambda r: r["joint2"].rejoined, 2.0)
        stands = readings["joint2"].position_rad
        assert stands == pytest.approx((2000 - 2048) * RAD_PER_TICK) and readings["joint2"].fault is None
        rig.ticks(held, 50)
        assert rig.chain.state(2)["position"] == pytest.approx(2000, abs=1)  # 0.07 rad is no goal that begins there
        held[1] = stands
        rig.ticks(held, 1)
        for step in np.linspace(0.0, -stands, 30):
            held[1] = stands + step
            rig.ticks(held, 1)
        assert rig.ticks(held, 50)["joint2"].position_rad == pytest.approx(0.0, abs=2 * RAD_PER_TICK)


def test_other_baud_is_silence(make_rig):
    with make_rig([EmulatedServo(1, baud=57600)]) as rig:
        with pytest.raises(BusError, match="at 1000000 baud: no answer from id 1"):
            rig.bus.connect()
    with make_rig([EmulatedServo(1, baud=57600)], baud=57600) as rig:
        rig.bus.connect()


@pytest.mark.parametrize("dead", [[1], [2], [4], [2, 3], [1, 2]])
def test_silent_servos_cost_the_others_nothing(rig, dead):
    held = rig.hold()
    rig.ticks(held, 3)
    for servo in dead:
        rig.chain.kill(servo)
    settled = rig.ticks(held, 10)
    ages = {joint: reading.age_s for joint, reading in settled.items()}
    assert {joint for joint, age in ages.items() if age > 0} == {f"joint{i}" for i in dead}
    for _ in range(30):
        readings = rig.ticks(held, 1)
        assert all(readings[f"joint{i}"].age_s == 0.0 for i in range(1, 5) if i not in dead)
    assert rig.bus.statistics()["silent"] == dead


def test_silent_servo_is_probed_seldom_and_taken_back(rig):
    held = rig.hold()
    rig.chain.kill(2)
    rig.ticks(held, 300)
    counts = rig.bus.statistics()
    assert counts["retries"] < 12
    rig.chain.revive(2)
    assert rig.ticks(held, 200)["joint2"].age_s == 0.0
    after = rig.bus.statistics()
    assert after["silent"] == [] and after["reconnects"] == 1


def test_wire_that_is_wholly_quiet_blames_nobody_at_once(rig):
    held = rig.hold()
    for servo in (1, 2, 3, 4):
        rig.chain.kill(servo)
    rig.ticks(held, 2)
    assert rig.bus.statistics()["silent"] == []
    for servo in (1, 2, 3, 4):
        rig.chain.revive(servo)
    assert all(r.age_s == 0.0 for r in rig.ticks(held, 1).values())


def test_alert_becomes_a_named_fault_of_that_joint(rig):
    held = rig.hold()
    rig.ticks(held, 1)
    rig.chain.fault(3, 1 << 5)
    readings = rig.ticks(held, 2)
    assert {joint: r.fault for joint, r in readings.items() if r.fault} == {"joint3": "overload"}
    assert rig.bus.statistics()["faults"] == ["joint3: overload"]


def test_servo_in_shutdown_is_named_at_torque_on(rig):
    rig.bus.connect()
    rig.chain.fault(2, 1 << 2)
    with pytest.raises(ServoError, match=r"joint2 \(id 2\) refuses torque_enable := 1.*hardware error"):
        rig.bus.enable(rig.bus.joints)


def test_stop_releases_all_that_can_be_reached(rig):
    held = rig.hold()
    rig.chain.kill(2)
    rig.bus.stop("release")
    rig.bus.stop("release")
    with pytest.raises(ValueError, match="no joint is enabled"):
        rig.bus.write(held, 0.0)
    rig.bus.close()
    rig.bus.stop("release")
    rig.bus.close()
    rig.chain.revive(2)
    torques = torque_of(rig)
    assert torques == [0, 1, 0, 0]  # the dead one's cable was out: it could not hear


def test_stop_can_hold(rig):
    rig.hold()
    rig.bus.stop("hold")
    rig.bus.close()
    assert torque_of(rig) == [1, 1, 1, 1]


def torque_of(rig):
    with rig.link() as link:
        return [link.read(servo, 64, 1).data[0] for servo in range(1, rig.count + 1)]


def test_mode_and_drive_mode_are_set_before_the_first_goal(rig):
    with rig.link() as link:
        # Extended position, torque on by goal, acknowledge nothing.
        for address, value in ((11, 4), (10, 0x08), (68, 0)):
            link.write(1, address, bytes([value]))
    rig.hold()
    rig.bus.close()
    with rig.link() as link:
        assert [link.read(1, address, 1).data[0] for address in (11, 10, 68, 9)] == [3, 0, 2, 0]


def test_mode_that_cannot_be_changed_under_torque_is_an_error(rig):
    with rig.link() as link:
        link.write(2, 11, bytes([4]))
        link.write(2, 64, bytes([1]))
    with pytest.raises(ServoError, match=r"joint2 \(id 2\) has torque on and operating_mode 4, must be 3"):
        rig.bus.connect()


def test_servo_that_lost_its_torque_while_silent_is_named(rig):
    held = rig.hold()
    rig.chain.kill(2)
    rig.ticks(held, 3)
    rig.chain.fault(2, 1 << 5)
    rig.chain.revive(2)
    assert rig.ticks(held, 20)["joint2"].fault in ("torque lost", "overload")


def test_what_goes_over_the_wire_is_the_same_every_time(make_rig):
    def digest():
        with make_rig([EmulatedServo(i, start_ticks=2000 + i) for i in range(1, 9)]) as rig:
            held = rig.hold()
            for k in range(100):
                rig.ticks(held + 0.2 * math.sin(k / 10), 1)
            rig.bus.stop("release")
            rig.bus.close()
            return rig.chain.digest()

    assert digest() == digest()


class Monotonic:
    def now_s(self) -> float:
        return time.monotonic()


def test_bus_works_in_real_time_on_the_serial_port_alone(linear):
    firmware_map = load_firmware_map("xl330-m288")
    with launch([EmulatedServo(i, start_ticks=2000) for i in range(1, 29)]) as chain:
        bus = Dynamixel2Bus(
            "face",
            [BusServo(f"joint{i}", i, firmware_map, -1.0, 1.0) for i in range(1, 29)],
            linear(1.0),
            lambda: SerialPort(chain.device, 1_000_000, Monotonic()),
            1_000_000,
            read_deadline_s=1.0,
        )
        bus.connect()
        held = bus.enable(bus.joints)
        for k in range(20):
            bus.write(held, 0.01 * k)
            readings = bus.poll(0.01 * k)
            assert [r.position_rad for r in readings.values()] == pytest.approx(held)
        bus.stop("release")
        bus.close()
        counts = bus.statistics()
        assert (counts["writes"], counts["retries"], counts["errors"], counts["silent"]) == (20, 0, 0, [])
