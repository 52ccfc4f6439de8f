"""Dynamixel 2.0: what was away comes back (a servo, the wire, the supply), watchdogs, modes."""

import logging

import numpy as np
import pytest
from chain_rig import bus_of
from emulated_port import BAUD

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo, launch
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.port import SerialPort

RAD_PER_TICK = 2 * np.pi / 4096


def four(make_rig, **more):
    return make_rig([EmulatedServo(i, start_ticks=2048) for i in (1, 2, 3, 4)], **more)


def goals_of(rig, radians):
    return np.full(rig.count, radians)


def test_other_servo_under_the_same_id_is_not_switched_on(make_rig, caplog):
    rig = four(make_rig)
    held = rig.hold()
    rig.ticks(held, 5)
    rig.kill(2)
    rig.ticks(held, 30)
    rig.bus._startups[1].table = load_and_rename()
    rig.revive(2)
    with caplog.at_level(logging.WARNING):
        rig.ticks(held, 200)
    assert "is model number 1200, the head says other (77)" in caplog.text


def load_and_rename():
    from sfms_robot.servo.registers import Table

    return Table.of(load_firmware_map("xl330-m288").model_copy(update={"model": "other", "model_number": 77}))


def test_host_that_stood_still_brings_its_servos_back(make_rig):
    rig = four(make_rig, watchdog_ms=100)
    held = rig.hold()
    rig.ticks(held, 5)
    rig.clock.t += 0.5  # nothing fed the watchdogs
    back: set[str] = set()
    rig.until(held, lambda r: back.update(j for j in r if r[j].rejoined) or len(back) == 4, 1.0)
    assert rig.ticks(held + 0.01, 30)["joint1"].position_rad == pytest.approx(0.01, abs=2 * RAD_PER_TICK)
    assert registers(rig, "bus_watchdog") == [5, 5, 5, 5]


def test_trip_that_was_left_over_is_cleared_at_connect(make_rig):
    rig = four(make_rig)
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
    rig = four(make_rig)
    held = rig.hold()
    rig.ticks(held, 3)
    rig.hang_up()
    rig.ticks(held, 2)
    rig.come_back()
    rig.bus.stop("release")
    assert [rig.state(i)["torque"] for i in (1, 2, 3, 4)] == [0, 0, 0, 0]


def test_mode_and_drive_mode_are_set_before_the_first_goal(rig):
    with rig.link() as link:
        # Extended position, torque on by goal, acknowledge nothing.
        for address, value in ((11, 4), (10, 0x08), (68, 0)):
            link.write(1, address, bytes([value]))
    rig.hold()
    rig.bus.close()
    with rig.link() as link:
        assert [link.read(1, address, 1).data[0] for address in (11, 10, 68, 9)] == [3, 0, 2, 0]


def test_bus_works_in_real_time_on_the_serial_port_alone():
    maps = [load_firmware_map("xl330-m288")] * 28
    with launch([EmulatedServo(i, start_ticks=2000) for i in range(1, 29)]) as chain:
        port = chain.device, BAUD, RealClock()
        bus = bus_of(maps, range(1, 29), lambda: SerialPort(*port), read_deadline_s=1.0)
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
