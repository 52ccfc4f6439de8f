"""Goals of a bus."""

import numpy as np
import pytest
from emulated_port import Straight, bus_servo
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import load_firmware_map
from sfms_robot.servo.bus import Goals

RAD = 2 * np.pi / 4096


def goals_of(count=1) -> Goals:
    table = load_firmware_map("sts3215")
    return Goals("face", [bus_servo(f"joint{i}", i, table) for i in range(count)], Straight(table, 1.0))


FIRST, BOTH, NOBODY = np.array([0]), np.array([0, 1]), np.zeros(0, np.intp)


@given(st.floats(1.01, 3.0), st.floats(0.0, 1.0))
def test_way_out_closes_behind_a_joint_that_comes_in(outside, share):
    goals = goals_of()
    goals.hold(0, outside)
    nearer = 1.0 + share * (outside - 1.0)
    assert (goals.ticks(np.array([nearer]), FIRST)[0] - 2048) * RAD == pytest.approx(nearer, abs=RAD)
    with pytest.raises(ValueError, match="goal of joint0"):
        goals.ticks(np.array([nearer + 0.01]), FIRST)


def test_a_joint_that_is_not_sent_is_not_judged_keeps_its_way_in_and_is_asked_for_nothing_that_is_not_finite():
    goals = goals_of(2)
    goals.hold(1, 2.0)
    goals.ticks(np.array([0.0, 0.0]), FIRST)  # the face goes on while joint1 is away
    goals.ticks(np.array([0.0, 9.0]), FIRST)
    assert goals.ticks(np.array([0.0, 2.0]), BOTH)[1] == round(2048 + 2.0 / RAD)
    with pytest.raises(ValueError, match="goal of joint1 is not finite"):
        goals_of(2).ticks(np.array([0.0, np.nan]), NOBODY)
