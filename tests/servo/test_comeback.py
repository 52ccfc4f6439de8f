"""What was away comes back: a servo, the wire, the supply. In virtual time, on emulated servos."""

import logging

import numpy as np
import pytest

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.errors import BusError

RAD_PER_TICK = 2 * np.pi / 4096


def four(make_rig, **more):
    return make_rig([EmulatedServo(i, start_ticks=2048) for i in (1, 2, 3, 4)], **more)


def goals_of(rig, radians):
    return np.full(rig.count, radians)


@pytest.mark.parametrize("dead", [1, 2, 4])
def test_one_dead_servo_costs_the_others_not_even_one_tick(make_rig, dead):
    with four(make_rig) as rig:
        held = rig.hold()
        rig.ticks(held, 5)
        rig.chain.kill(dead)
        for _ in range(20):
            readings = rig.ticks(held, 1)
            assert all(r.age_s == 0.0 for joint, r in readings.items() if joint != f"joint{dead}")


def test_servo_that_was_away_holds_where_it_stands_until_goals_begin_there(make_rig):
    with four(make_rig) as rig:
        rig.hold()
        rig.ticks(goals_of(rig, 0.0), 3)
        rig.chain.kill(2)
        rig.ticks(goals_of(rig, 0.0), 30)
        rig.ticks(goals_of(rig, 0.5), 100)  # the others go on without it
        rig.chain.revive(2)
        _, readings = rig.until(goals_of(rig, 0.5), lambda r: r["joint2"].rejoined, 2.0)
        stands = readings["joint2"].position_rad
        assert stands == pytest.approx(0.0, abs=2 * RAD_PER_TICK)
        later = rig.ticks(goals_of(rig, 0.5), 50)
        assert later["joint2"].position_rad == pytest.approx(stands, abs=RAD_PER_TICK) and not later["joint2"].rejoined
        near = goals_of(rig, 0.5)
        near[1] = stands
        rig.ticks(near, 1)
        for step in np.linspace(0.0, 0.5, 50):
            near[1] = stands + step
            readings = rig.ticks(near, 1)
        assert rig.ticks(near, 50)["joint2"].position_rad == pytest.approx(0.5, abs=2 * RAD_PER_TICK)
        assert rig.bus.statistics()["silent"] == []


def test_servo_that_restarted_on_its_own_is_noticed_and_brought_back(make_rig):
    with four(make_rig) as rig:
        held = rig.hold()
        rig.ticks(held, 5)
        rig.bus._link.reboot(3)  # nobody told the bus
        seconds, readings = rig.until(held, lambda r: r["joint3"].rejoined, 2.0)
        assert readings["joint3"].fault is None
        assert "joint3: torque lost" in rig.bus.statistics()["faults"]
        assert rig.ticks(held + 0.05, 1)["joint1"].age_s == 0.0
        assert rig.chain.state(3)["torque"]


def test_every_servo_is_back_within_two_seconds_of_the_adapter(make_rig):
    with make_rig([EmulatedServo(i, start_ticks=2048) for i in range(1, 29)]) as rig:
        held = rig.hold()
        rig.ticks(held, 5)
        rig.chain.hang_up()
        readings = rig.ticks(held, 100)
        assert all(r.age_s > 0.5 for r in readings.values())
        rig.chain.come_back()
        rig.until_all_back(held, 2.0)
        assert all(r.age_s == 0.0 for r in rig.ticks(held, 5).values())
        moved = rig.ticks(held + 0.01, 50)  # near enough: goals continue from where they stand
        assert all(abs(r.position_rad - 0.01) < 3 * RAD_PER_TICK for r in moved.values())


def test_every_servo_is_back_within_two_seconds_of_the_supply(make_rig):
    with make_rig([EmulatedServo(i, start_ticks=2048) for i in range(1, 29)]) as rig:
        held = rig.hold()
        rig.ticks(held, 5)
        rig.chain.inject("brownout")
        rig.until(held, lambda r: all(x.age_s > 0.02 for x in r.values()), 1.0)
        rig.until_all_back(held, 2.6)  # the supply itself is gone for 0.2 s, and servos start up after that
        assert all(rig.chain.state(i)["torque"] for i in range(1, 29))


def test_bus_on_which_nobody_answers_any_more_fails_in_the_end(make_rig):
    with four(make_rig, reconnect_s=1.0) as rig:
        held = rig.hold()
        rig.ticks(held, 5)
        rig.chain.hang_up()
        with pytest.raises(BusError, match="no answer from any servo for 1 s"):
            rig.ticks(held, 200)


def test_other_servo_under_the_same_id_is_not_switched_on(make_rig, caplog):
    with four(make_rig) as rig:
        held = rig.hold()
        rig.ticks(held, 5)
        rig.chain.kill(2)
        rig.ticks(held, 30)
        rig.bus._startups[1].table = load_and_rename()
        rig.chain.revive(2)
        with caplog.at_level(logging.WARNING):
            rig.ticks(held, 200)
        assert "is model number 1200, the head says other (77)" in caplog.text


def load_and_rename():
    from sfms_robot.servo.registers import Table

    return Table.of(load_firmware_map("xl330-m288").model_copy(update={"model": "other", "model_number": 77}))


@pytest.mark.parametrize("watchdog_ms", [100, 200])
def test_watchdog_is_armed_after_the_first_goal_and_off_after_the_run(make_rig, watchdog_ms):
    with four(make_rig, watchdog_ms=watchdog_ms) as rig:
        held = rig.hold()
        assert registers(rig, "bus_watchdog") == [0, 0, 0, 0]
        rig.ticks(held, 1)
        assert registers(rig, "bus_watchdog") == [watchdog_ms // 20] * 4
        rig.bus.stop("hold")
        assert registers(rig, "bus_watchdog") == [0, 0, 0, 0]
        assert registers(rig, "torque_enable") == [1, 1, 1, 1]


def test_watchdog_that_cannot_stop_the_motor_is_left_alone(make_rig):
    weak = load_firmware_map("xl330-m288").model_copy(update={"watchdog": "flags_only"})
    with four(make_rig, firmware_map=weak) as rig:
        rig.ticks(rig.hold(), 3)
        assert registers(rig, "bus_watchdog") == [0, 0, 0, 0]


def test_host_that_stood_still_brings_its_servos_back(make_rig):
    with four(make_rig, watchdog_ms=100) as rig:
        held = rig.hold()
        rig.ticks(held, 5)
        rig.clock.t += 0.5  # nothing fed the watchdogs
        rig.until_all_back(held, 1.0)
        assert rig.ticks(held + 0.01, 30)["joint1"].position_rad == pytest.approx(0.01, abs=2 * RAD_PER_TICK)
        assert registers(rig, "bus_watchdog") == [5, 5, 5, 5]


def test_trip_that_was_left_over_is_cleared_at_connect(make_rig):
    with four(make_rig) as rig:
        with rig.link() as link:
            link.write(2, 64, b"\x01")
            link.write(2, 98, b"\x05")
            rig.clock.t += 1.0
            assert link.read(2, 98, 1).data == b"\xff"
        held = rig.hold()
        assert registers(rig, "bus_watchdog") == [0, 0, 0, 0]
        assert rig.ticks(held + 0.1, 50)["joint2"].position_rad == pytest.approx(0.1, abs=2 * RAD_PER_TICK)


def registers(rig, name):
    field = rig.bus._startups[0].table[name]
    return [field.from_bytes(rig.bus._link.read(i, field.address, field.size).data) for i in range(1, rig.count + 1)]


def test_stop_opens_a_port_that_is_back_to_release_the_head(make_rig):
    with four(make_rig) as rig:
        held = rig.hold()
        rig.ticks(held, 3)
        rig.chain.hang_up()
        rig.ticks(held, 2)
        rig.chain.come_back()
        rig.bus.stop("release")
        assert [rig.chain.state(i)["torque"] for i in (1, 2, 3, 4)] == [0, 0, 0, 0]
