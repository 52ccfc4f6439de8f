"""Serial necks: any order of axes, split axes, differential pairs, and what such a neck cannot do."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import parse
from sfms_robot.config.kinematics import SerialNeck
from sfms_robot.errors import ConfigError
from sfms_robot.retarget.neck import Serial
from sfms_robot.signals import rotations

AXES = ("roll", "pitch", "yaw")
seeds = st.integers(0, 2**32 - 1)


def neck(order, axes=None, reach=3.2, ranges=None, **section) -> Serial:
    """Joints are named as their axes unless `axes` says otherwise."""
    config = SerialNeck(
        kind="serial", order=order, axes={name: name for name in order} if axes is None else axes, **section
    )
    return Serial(config, {name: (-reach, reach) for name in config.joints()} | (ranges or {}))


def poses(seed: int, count: int = 50, size: float = 0.7) -> np.ndarray:
    out = np.zeros((count, 6))
    out[:, :3] = np.random.default_rng(seed).uniform(-size, size, (count, 3))
    return out


@pytest.mark.parametrize("order", list(permutations(AXES)))
@given(seed=seeds)
def test_three_axes_in_any_order_take_any_rotation(order, seed):
    wanted, three = poses(seed, size=1.2), neck(order)
    solved = three.solve(wanted)
    assert solved.reached.all() and solved.residual_rad.max() < 1e-9
    assert three.forward(solved.angles_rad, wanted) == pytest.approx(wanted, abs=1e-9)


def test_yaw_pitch_roll_are_the_angles_of_the_pose_and_what_a_joint_cannot_turn_is_residual():
    wanted = poses(1)
    assert neck(("yaw", "pitch", "roll")).solve(wanted).angles_rad == pytest.approx(wanted[:, 2::-1], abs=1e-12)
    short = neck(("yaw", "pitch", "roll"), ranges={"pitch": (-0.2, 0.2)})
    solved = short.solve(np.array([[0, 0.5, 0, 0, 0, 0], [0, 0.1, 0, 0.01, 0, 0]]))
    assert solved.angles_rad[:, 1] == pytest.approx([0.2, 0.1])
    assert solved.residual_rad == pytest.approx([0.3, 0.0], abs=1e-12)
    assert solved.residual_m == pytest.approx([0.0, 0.01]) and not solved.reached.any()


@given(seeds)
def test_a_pan_tilt_neck_keeps_the_direction_of_the_face_and_reports_the_roll(seed):
    wanted, pan_tilt = poses(seed), neck(("yaw", "pitch"))
    solved = pan_tilt.solve(wanted)
    given_pose = pan_tilt.forward(solved.angles_rad, wanted)
    ahead = np.array([1.0, 0.0, 0.0])
    faces = [rotations.rotation(some[:, :3]) @ ahead for some in (wanted, given_pose)]
    assert faces[0] == pytest.approx(faces[1], abs=1e-12)
    assert solved.residual_rad == pytest.approx(np.abs(wanted[:, 0]), abs=1e-9)
    assert not solved.reached[np.abs(wanted[:, 0]) > 1e-6].any()


HALF = {"lower": "neck", "upper": "head", "lower_share": 0.5}
BY_FREQUENCY = {"lower": "neck", "upper": "head", "crossover_hz": 0.5}


def test_a_shared_axis_gives_each_joint_its_share_and_the_rest_to_the_other_at_an_end():
    two = neck(("pitch", "yaw"), {"pitch": HALF, "yaw": "pan"}, ranges={"neck": (-0.35, 1.1), "head": (-0.8, 0.8)})
    assert two.joints == ("neck", "head", "pan")
    wanted = np.zeros((4, 6))
    wanted[:, 1] = [0.4, -0.9, 1.8, 2.5]
    solved = two.solve(wanted)
    assert solved.angles_rad[:, :2] == pytest.approx(np.array([[0.2, 0.2], [-0.35, -0.55], [1.0, 0.8], [1.1, 0.8]]))
    assert solved.reached.tolist()[:2] == [True, True] and not solved.reached[3]


def test_a_split_by_frequency_gives_slow_pitch_to_the_lower_joint_and_a_nod_to_the_upper_one():
    two = neck(("pitch",), {"pitch": BY_FREQUENCY})
    assert two.solve(np.array([0, 0.3, 0, 0, 0, 0])).angles_rad == pytest.approx([0.3, 0.0])  # held for ever
    dt_s, memory = 0.01, two.start()
    lean, nod = 0.3, 0.1
    angles = []
    for tick in range(1500):
        wanted = np.zeros(6)
        wanted[1] = lean + nod * np.sin(2 * np.pi * 3.0 * tick * dt_s)
        joints, memory = two.step(wanted, dt_s, memory)
        assert joints.sum() == pytest.approx(wanted[1])
        angles.append(joints)
    settled = np.array(angles[1000:])
    assert settled.mean(axis=0) == pytest.approx([lean, 0.0], abs=0.005)
    assert np.ptp(settled[:, 1]) > 5 * np.ptp(settled[:, 0])


GEARS = {"left": "left", "right": "right", "pitch_gain": 1.85, "roll_gain": 2.0}


@given(seeds)
def test_a_differential_pitches_with_the_sum_and_rolls_with_the_difference(seed):
    gimbal = neck(("yaw", "pitch", "roll"), {"yaw": "pan"}, reach=9.0, differential=GEARS)
    wanted = poses(seed)
    solved = gimbal.solve(wanted)
    roll, pitch = wanted[:, 0], wanted[:, 1]
    assert gimbal.joints == ("pan", "left", "right")
    assert solved.angles_rad[:, 1] == pytest.approx(1.85 * pitch + 2 * roll)
    assert solved.angles_rad[:, 2] == pytest.approx(1.85 * pitch - 2 * roll)
    assert gimbal.forward(solved.angles_rad, wanted) == pytest.approx(wanted, abs=1e-9) and solved.reached.all()


def test_a_differential_at_its_end_keeps_the_direction_of_the_lean():
    gimbal = neck(("pitch", "roll"), {}, reach=1.0, differential=GEARS)
    solved = gimbal.solve(np.array([0.4, 0.8, 0, 0, 0, 0]))
    lean = gimbal.forward(solved.angles_rad, np.zeros(6))
    assert np.abs(solved.angles_rad).max() == pytest.approx(1.0) and not solved.reached
    assert lean[0] / lean[1] == pytest.approx(0.5) and lean[1] > 0


@given(seeds)
def test_joints_stay_inside_their_ranges_whatever_is_asked(seed):
    wanted = np.random.default_rng(seed).uniform(-3, 3, (100, 6))
    for some in (
        neck(("yaw", "pitch", "roll"), reach=0.4),
        neck(("pitch", "yaw"), {"pitch": HALF, "yaw": "pan"}, reach=0.4),
        neck(("yaw", "pitch", "roll"), {"yaw": "pan"}, reach=0.4, differential=GEARS),
    ):
        assert np.abs(some.solve(wanted).angles_rad).max() <= 0.4


def test_a_pose_that_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="not finite"):
        neck(("yaw",)).solve(np.array([0, 0, np.nan, 0, 0, 0]))


@pytest.mark.parametrize(
    ("section", "told"),
    [
        ({"order": ["yaw", "yaw"], "axes": {"yaw": "a"}}, "twice; two joints of one axis are a split"),
        ({"order": ["yaw", "pitch"], "axes": {"yaw": "a"}}, "axis 'pitch' of order needs a joint"),
        ({"order": ["yaw"], "axes": {"yaw": "a", "roll": "b"}}, "axis 'roll' has a joint but is not in order"),
        ({"order": ["yaw", "pitch"], "axes": {"yaw": "a", "pitch": "a"}}, "joint 'a' is used twice"),
        ({"order": ["pitch"], "axes": {"pitch": {"lower": "a", "upper": "b"}}}, "exactly one of lower_share"),
        ({"order": ["pitch", "roll"], "differential": {**GEARS, "roll_gain": 0}}, "roll_gain is 0"),
        ({"order": ["tilt"], "axes": {}}, "'roll', 'pitch' or 'yaw'"),
    ],
)
def test_a_neck_that_makes_no_sense_is_told_in_one_line(section, told):
    with pytest.raises(ConfigError, match=told) as error:
        parse(SerialNeck, {"kind": "serial", **section}, "head.yaml")
    assert len(str(error.value).splitlines()) == 1
