"""Dynamixel 2.0: another servo under the same id, watchdogs, firmware that has another layout."""

import logging

import numpy as np
import pytest
from chain_rig import plugged

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.servo.registers import Table

RAD_PER_TICK = 2 * np.pi / 4096
OTHER = load_firmware_map("xl330-m288").model_copy(update={"model": "other", "model_number": 77})


def four(**more):
    return plugged([EmulatedServo(i, start_ticks=2048) for i in (1, 2, 3, 4)], **more)


def watchdogs(rig):
    return [rig.register(i, "bus_watchdog") for i in (1, 2, 3, 4)]


def test_other_servo_under_the_same_id_is_not_switched_on(caplog):
    rig = four()
    held = rig.hold()
    rig.ticks(held, 5)
    rig.kill(2)
    rig.ticks(held, 30)
    rig.bus._startups[1].table = Table.of(OTHER)
    rig.revive(2)
    with caplog.at_level(logging.WARNING):
        rig.ticks(held, 200)
    assert "is model number 1200, the head says other (77)" in caplog.text


def test_trip_that_was_left_over_is_cleared_at_connect():
    rig = four()
    rig.set(2, "torque_enable", 1)
    rig.set(2, "bus_watchdog", 5)
    rig.clock.t += 1.0
    assert rig.register(2, "bus_watchdog") == -1
    held = rig.hold()
    assert watchdogs(rig) == [0, 0, 0, 0]
    assert rig.ticks(held + 0.1, 50)["joint2"].position_rad == pytest.approx(0.1, abs=2 * RAD_PER_TICK)


def test_modes_of_an_earlier_host_are_set_before_the_first_goal():
    rig = four()
    # Extended position, torque on by goal, acknowledge nothing.
    for name, value in (("operating_mode", 4), ("drive_mode", 0x08), ("status_level", 0)):
        rig.set(1, name, value)
    rig.hold()
    names = "operating_mode", "drive_mode", "status_level", "return_delay"
    assert [rig.register(1, name) for name in names] == [3, 0, 2, 0]
