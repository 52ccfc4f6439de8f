"""Pollen Robotics' motor controller for Reachy Mini, on `sfms-robot emulate --head reachy_mini`.

The robot's supply of 6.8 to 7.6 V is above the 7.0 V that its servos allow, so on a healthy robot the voltage alert is
set for good; at 5 V it is not.
"""

import datetime
import math

import pytest

from sfms_robot.app.servo.emulated_chains import emulators

controller = pytest.importorskip("reachy_mini_motor_controller")

pytestmark = pytest.mark.realtime

IDS = range(10, 19)


@pytest.fixture(params=[5.0, None])
def robot(request):
    with emulators(head="reachy_mini", voltage=request.param) as chains:
        [chain] = chains.values()
        alert = "" if request.param else "input voltage"
        assert [chain.state(i)["faults"] for i in IDS] == [alert] * 9
        yield chain


def angles(chain):
    return [(chain.state(i)["position"] - 2048) * 2 * math.pi / 4096 for i in IDS]


def test_controller_moves_all_nine_joints(robot, again):
    host = controller.ReachyMiniMotorController(robot.device)
    assert host.read_all_positions() == pytest.approx(angles(robot), abs=0.001) and not host.is_torque_enabled()
    host.enable_torque()
    assert host.is_torque_enabled()
    goals = [0.2, 0.3, -0.3, 0.3, -0.3, 0.3, -0.3, -0.17, 0.17]
    host.set_all_goal_positions(goals)
    again(host.read_all_positions, lambda p: p == pytest.approx(goals, abs=0.003))
    assert angles(robot) == pytest.approx(goals, abs=0.003)
    assert len(host.read_stewart_platform_current()) == 6
    host.disable_torque()
    assert not host.is_torque_enabled()


def test_control_loop_starts_runs_and_stops(robot, again):
    loop = controller.ReachyMiniPyControlLoop(robot.device, datetime.timedelta(milliseconds=20), allowed_retries=20)
    try:
        assert sorted(loop.get_motor_name_id().values()) == list(range(10, 19))
        loop.enable_torque()
        goals = controller.FullBodyPosition(0.1, [0.2, -0.2, 0.2, -0.2, 0.2, -0.2], [0.1, -0.1])
        loop.set_all_goal_positions(goals)

        def stewart():
            return loop.get_last_position().stewart

        again(stewart, lambda p: p == pytest.approx(goals.stewart, abs=0.003), tries=3_000_000)
        loop.disable_torque()
    finally:
        loop.close()
