import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import load_firmware_map
from sfms_robot.servo.goals import EASE_RAD_S, Goals
from sfms_robot.servo.policy import BusServo

RAD = 2 * np.pi / 4096


class Linear:
    def to_ticks(self, angles_rad):
        return np.rint(2048 + np.clip(angles_rad, -1.0, 1.0) / RAD).astype(np.int64)

    def to_rad(self, ticks):
        return (ticks - 2048) * RAD


def goals_of(count=1) -> Goals:
    table = load_firmware_map("sts3215")
    return Goals("face", [BusServo(f"joint{i}", i, table, -1.0, 1.0) for i in range(count)], Linear())


@given(st.floats(-1.0, 1.0), st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(0.0, 0.1)), max_size=30))
def test_servo_that_is_back_is_led_no_faster_than_it_may(start, steps):
    goals, now_s, last = goals_of(), 0.0, start
    goals.ease(0, start, 0.0)
    for wanted, dt_s in steps:
        now_s += dt_s
        sent = (goals.ticks(np.array([wanted]), [0], now_s)[0] - 2048) * RAD
        assert abs(sent - last) <= EASE_RAD_S * dt_s + 2 * RAD
        if abs(sent - wanted) <= RAD:
            return  # it has arrived, and is on its own again
        last = sent


def test_other_joints_are_not_slowed():
    goals = goals_of(2)
    goals.ease(0, 0.5, 0.0)
    ticks = goals.ticks(np.array([-0.5, -0.5]), [0, 1], 0.01)
    assert (ticks - 2048) * RAD == pytest.approx([0.49, -0.5], abs=RAD)


@given(st.floats(1.01, 3.0), st.floats(0.0, 1.0))
def test_way_out_closes_behind_a_joint_that_comes_in(outside, share):
    goals = goals_of()
    assert not goals.hold(0, outside)
    nearer = 1.0 + share * (outside - 1.0)
    goals.check(np.array([outside]))
    assert (goals.ticks(np.array([nearer]), [0], 0.0)[0] - 2048) * RAD == pytest.approx(nearer, abs=RAD)
    with pytest.raises(ValueError, match="goal of joint0"):
        goals.check(np.array([nearer + 0.01]))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1.1, -1.1])
def test_goal_that_is_no_goal_is_named(bad):
    with pytest.raises(ValueError, match="goal of joint1 = "):
        goals_of(2).check(np.array([0.0, bad]))
