import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import Joint, load_head
from sfms_robot.errors import ConfigError
from sfms_robot.motion.calibration import Calibration

HEAD = load_head("face28")
FACE = Calibration(HEAD.joints, np.full(len(HEAD.joints), 4096))


def joint(**changes) -> Joint:
    given_values = {"bus": "main", "id": 1, "model": "m", "zero_ticks": 2048, "limits": "any"}
    return Joint(**{**given_values, "min_deg": -10, "max_deg": 20, **changes})


@given(st.integers(0, 2**32 - 1))
def test_ticks_and_back_is_within_half_a_tick_and_every_tick_comes_back_as_itself(seed):
    low = np.maximum(FACE.to_rad(FACE.low_ticks), FACE.to_rad(FACE.high_ticks))
    high = np.minimum(FACE.to_rad(FACE.low_ticks), FACE.to_rad(FACE.high_ticks))
    angles = np.random.default_rng(seed).uniform(np.minimum(low, high), np.maximum(low, high))
    error_ticks = (FACE.to_rad(FACE.to_ticks(angles)) - angles) * FACE.ticks_per_rad
    assert np.abs(error_ticks).max() <= 0.5 + 1e-9
    ticks = np.random.default_rng(seed).integers(FACE.low_ticks, FACE.high_ticks + 1)
    assert np.array_equal(FACE.to_ticks(FACE.to_rad(ticks)), ticks)


def test_no_angle_leads_to_a_tick_outside_the_limits():
    low = np.array([joint.min_rad for joint in HEAD.joints.values()])
    high = np.array([joint.max_rad for joint in HEAD.joints.values()])
    for angles in (low, high, low - 1, high + 1, np.full(len(low), 1e9)):
        reached = FACE.to_rad(FACE.to_ticks(angles))
        assert (reached >= low - 1e-9).all() and (reached <= high + 1e-9).all()


def test_sign_ratio_and_zero_hold_inside_and_outside_the_limits():
    two = {"a": joint(zero_ticks=1000), "b": joint(zero_ticks=3000, sign=-1, ratio=2.0)}
    calibration = Calibration(two, np.array([3600, 7200]))
    assert calibration.to_ticks(np.radians([9.0, 9.0])).tolist() == [1000 + 90, 3000 - 360]
    assert np.degrees(calibration.to_rad(np.array([1050, 3400]))) == pytest.approx([5.0, -10.0])
    calibration = Calibration({"a": joint()}, np.array([4096]))
    assert np.degrees(calibration.to_rad(np.array([3072]))) == pytest.approx([90.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_has_no_tick(bad):
    with pytest.raises(ValueError, match="not finite"):
        FACE.to_ticks(np.where(np.arange(28) == 1, bad, 0.0))


@pytest.mark.parametrize("changes", [{"zero_ticks": 50}, {"zero_ticks": 4000}, {"max_deg": 200}])
def test_a_range_that_leaves_the_turn_of_the_servo_is_an_error(changes):
    with pytest.raises(ConfigError, match=r"joints.jaw: .* outside the servo's 0..4095; change zero_ticks = "):
        Calibration({"jaw": joint(**changes)}, np.array([4096]))
