"""Pollen Robotics' rustypot, which reads with timeouts of its own in compiled code."""

import math

import pytest

from sfms_robot.emulator.launch import EmulatedServo

rustypot = pytest.importorskip("rustypot")

pytestmark = pytest.mark.realtime

IDS = [1, 2, 3]


def test_dynamixel_servos_are_found_driven_and_read(plugged_in, again):
    chain = plugged_in([EmulatedServo(i, start_ticks=2048) for i in IDS], timing="wire")
    host = rustypot.Xl330PyController(chain.device, 1_000_000, 0.5)
    assert host.scan([1, 2, 3, 4]) == {1: 1200, 2: 1200, 3: 1200}
    host.sync_write_torque_enable(IDS, [True] * 3)
    goals = [0.1, -0.1, 0.2]
    host.sync_write_goal_position(IDS, goals)

    def arrived(positions):
        return all(math.isclose(p, g, abs_tol=0.002) for p, g in zip(positions, goals, strict=True))

    again(lambda: host.sync_read_present_position(IDS), arrived)
    assert host.ping(2) and not host.ping(9)


@pytest.mark.parametrize(("model", "controller"), [("sts3215", "Sts3215PyController"), ("ax-12a", "AxPyController")])
def test_older_protocols_are_read_and_driven(plugged_in, again, model, controller):
    center = 2048 if model == "sts3215" else 512
    chain = plugged_in([EmulatedServo(i, model, start_ticks=center, firmware=24) for i in IDS])
    host = getattr(rustypot, controller)(chain.device, 1_000_000, 0.5)
    host.write_torque_enable(1, True)
    host.write_goal_position(1, 0.3)

    def position():
        read = host.read_present_position(1)
        return read[0] if isinstance(read, list) else read

    again(position, lambda p: math.isclose(p, 0.3, abs_tol=0.01))
    assert host.ping(3) and not host.ping(9)
