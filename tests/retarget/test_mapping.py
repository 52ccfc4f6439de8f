import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from sfms_robot.config import BusConfig, Expression, Head, Joint, LimitClass
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM
from sfms_robot.retarget.channel_mapping import ChannelMapping


def head_of(*drives, **joint) -> Head:
    settings = {"min_deg": -10.0, "rest_deg": 2.0, "max_deg": 30.0} | joint
    return Head(
        name="test",
        description="",
        buses={"main": BusConfig(family="dynamixel2", baud=1000000)},
        limits={"any": LimitClass(speed_deg_s=1, acceleration_deg_s2=1, jerk_deg_s3=1)},
        joints={
            f"joint{i}": Joint(bus="main", id=i, model="m", zero_ticks=2048, limits="any", drive=drive, **settings)
            for i, drive in enumerate(drives)
        },
    )


def value(node: Expression, motion) -> float:
    """The meaning of an expression, written the slow way."""
    if node.channel:
        u = float(motion[CHANNEL_INDEX[node.channel]])
    else:
        parts = [value(child, motion) for child in node.parts]
        u = {"sum": sum, "max": max, "min": min, "mean": np.mean, "product": np.prod}[node.group](parts)
    u = math.copysign(max(abs(u) - node.dead_band, 0.0), u)
    if node.curve:
        x, y = np.array(node.curve).T
        u = float(PchipInterpolator(x, y)(min(max(u, x[0]), x[-1])))
    down, up = node.gains
    u = u * (up if u > 0 else down) + node.offset
    return u if node.clamp is None else min(max(u, node.clamp[0]), node.clamp[1])


small = st.floats(-2, 2)
curves = st.lists(
    st.tuples(st.integers(-20, 20), st.integers(-20, 20)), min_size=2, max_size=5, unique_by=lambda point: point[0]
).map(lambda points: tuple(sorted((x / 10, y / 10) for x, y in points)))
shapes = st.fixed_dictionaries(
    {"gain": small, "offset": small},
    optional={
        "gain_up": small,
        "gain_down": small,
        "dead_band": st.floats(0, 0.5),
        "clamp": st.just((-0.5, 0.5)),
        "curve": curves,
    },
)
leaves = st.builds(lambda channel, shape: Expression(channel=channel, **shape), st.sampled_from(CHANNELS), shapes)


def grown(children):
    return st.builds(
        lambda kind, parts, shape: Expression(**{kind: tuple(parts)}, **shape),
        st.sampled_from(["sum", "max", "min", "mean", "product"]),
        st.lists(children, min_size=1, max_size=4),
        shapes,
    )


@given(
    st.lists(st.none() | st.recursive(leaves, grown, max_leaves=10), min_size=1, max_size=6),
    st.sampled_from(["range", "rad"]),
    st.integers(0, 2**32 - 1),
)
def test_angles_are_what_the_expressions_mean(drives, unit, seed):
    head = head_of(*drives, unit=unit)
    motion = np.random.default_rng(seed).uniform(-1, 1, (len(drives), MOTION_DIM)).astype(np.float32)
    angles = ChannelMapping(head).angles(motion)
    for angle, joint, row in zip(angles, head.joints.values(), motion, strict=True):
        u = value(joint.drive, row) if joint.drive else 0.0
        span = joint.max_rad - joint.rest_rad if u > 0 else joint.rest_rad - joint.min_rad
        wanted = joint.rest_rad + u * (span if unit == "range" else 1.0)
        assert angle == pytest.approx(min(max(wanted, joint.min_rad), joint.max_rad), abs=1e-6)


def test_each_joint_reads_its_own_row():
    motion = np.zeros((2, MOTION_DIM), np.float32)
    motion[0, CHANNEL_INDEX["jawOpen"]] = 1
    angles = ChannelMapping(head_of(Expression(channel="jawOpen"), Expression(channel="jawOpen"))).angles(motion)
    assert np.degrees(angles) == pytest.approx([30.0, 2.0])


def test_one_row_serves_all_joints_and_a_stack_is_done_at_once():
    mapping = ChannelMapping(head_of(Expression(channel="jawOpen"), Expression(channel="yaw")))
    motion = np.random.default_rng(0).uniform(0, 1, MOTION_DIM).astype(np.float32)
    once = mapping.angles(motion)
    stacked = mapping.angles(np.broadcast_to(motion, (3, 2, MOTION_DIM)))
    assert once.shape == (2,) and np.array_equal(stacked, np.broadcast_to(once, (3, 2)))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused_by_name(bad):
    motion = np.zeros(MOTION_DIM, np.float32)
    motion[CHANNEL_INDEX["mouthPucker"]] = bad
    with pytest.raises(ValueError, match="mouthPucker is"):
        ChannelMapping(head_of(Expression(channel="jawOpen"))).angles(motion)


@pytest.mark.parametrize("shape", [(57,), (2, 58), (3, 2, 58), ()])
def test_a_wrong_shape_is_refused(shape):
    with pytest.raises(ValueError, match="not"):
        ChannelMapping(head_of(Expression(channel="jawOpen"))).angles(np.zeros(shape, np.float32))
