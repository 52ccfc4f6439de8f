"""What the words of a head's file mean: expressions, sharing, mirrors, couplings, folds, regions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from motion_rows import motion
from scipy.interpolate import PchipInterpolator

from sfms_robot.config import Expression, Head, parse
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM
from sfms_robot.retarget.channel_mapping import ChannelMapping

EXTREMES = np.array([0.0, 1.0, -1.0, 1e-30, 7.0, -1e4, 3e38, -3e38], np.float32)


def head_of(joints, **parts) -> Head:
    raw = {
        "name": "test",
        "description": "",
        "buses": {"main": {"family": "dynamixel2", "baud": 1000000}},
        "limits": {"any": {"speed_deg_s": 1, "acceleration_deg_s2": 1, "jerk_deg_s3": 1}},
        "joint_defaults": {
            "bus": "main", "model": "m", "zero_ticks": 2048, "min_deg": -10, "max_deg": 10, "limits": "any",
        },
        "joints": {name: {"id": number, **joint} for number, (name, joint) in enumerate(joints.items())},
    }  # fmt: skip
    return parse(Head, raw | parts, "head.yaml")


def shown(head, knobs=None, **channels):
    """Angles in tenths of the range of 10 degrees: joint units."""
    return (np.degrees(ChannelMapping(head).angles(motion(**channels), knobs)) / 10).tolist()


def test_expressions_are_what_they_say_wherever_they_are_used_also_in_one_another():
    smile = {"mean": ["mouthSmileLeft", "mouthSmileRight"]}
    head = head_of(
        {"corner": {"drive": "smile"}, "cheek": {"drive": {"sum": [{"use": "smile", "gain": 0.5}, "cheekPuff"]}}},
        expressions={"smile": smile},
    )
    assert shown(head, mouthSmileLeft=1.0, mouthSmileRight=0.6, cheekPuff=0.2) == pytest.approx([0.8, 0.6])
    head = head_of({"jaw": {"drive": "third"}}, expressions={
        "third": {"use": "second", "offset": 0.1}, "first": "jawOpen", "second": {"use": "first", "gain": 0.5},
    })  # fmt: skip
    assert shown(head, jawOpen=1.0) == pytest.approx([0.6])


def test_a_mirrored_joint_follows_the_other_side_and_turns_the_odd_channels_round():
    head = head_of({
        "lid_left": {"drive": {"sum": ["eyeBlinkLeft", {"channel": "roll", "gain": 0.5}]}, "max_deg": 30},
        "lid_right": {"mirror_of": "lid_left"},
        "pan_left": {"drive": {"sum": ["eyeLookOutLeft", "jawLeft"]}, "min_deg": -5, "max_deg": 10},
        "pan_right": {"mirror_of": "pan_left", "mirror_sense": "opposite"},
    })  # fmt: skip
    assert shown(head, eyeBlinkRight=0.3, roll=-0.2) == pytest.approx([-0.1, 1.2, 0, 0])
    assert shown(head, eyeLookOutRight=0.4, jawRight=0.1) == pytest.approx([0, 0, 0, -0.5])
    right = head.joints["pan_right"]
    assert (right.min_deg, right.max_deg, right.sign) == (-10, 5, 1) and head.joints["lid_right"].sign == -1


def test_a_mirrored_joint_keeps_what_it_gives_itself():
    head = head_of({"a": {"drive": "jawOpen", "lag_ms": 20}, "b": {"mirror_of": "a", "max_deg": 7, "sign": 1}})
    b = head.joints["b"]
    assert (b.lag_ms, b.max_deg, b.min_deg, b.sign, b.id) == (20, 7, -10, 1, 1)


def test_a_fold_shows_a_channel_in_a_joint_that_has_something_else_to_do():
    joints = {"lid_left": {"drive": "eyeBlinkLeft"}, "lid_right": {"mirror_of": "lid_left"}, "idle": {}}
    folds = [{"channel": "cheekSquintLeft", "into": "lid_left", "gain": 0.2},
             {"channel": "tongueOut", "into": "idle", "gain": 1}]  # fmt: skip
    head = head_of(joints, folds=folds)
    assert shown(head, cheekSquintLeft=1.0, eyeBlinkLeft=0.1, tongueOut=0.5) == pytest.approx([0.3, 0, 0.5])
    assert shown(head, cheekSquintRight=1.0) == pytest.approx([0, 0.2, 0])
    assert not {"cheekSquintLeft", "cheekSquintRight", "tongueOut"} & set(ChannelMapping(head).blind_channels)


LIPS = {
    "upper": {"drive": {"channel": "mouthRollUpper", "gain": -1}},
    "lower": {"drive": {"channel": "mouthRollLower", "gain": -1}},
    "jaw": {"drive": "jawOpen"},
}
APART = [{"keep": {"upper": 1, "lower": 1, "jaw": 0.5}, "at_least": -0.2, "moving": ["lower", "upper"]}]


def test_joints_give_way_to_one_another_in_turn_and_the_open_jaw_makes_room():
    head = head_of(LIPS, couplings=APART)
    assert shown(head, mouthRollUpper=0.5, mouthRollLower=0.5) == pytest.approx([-0.5, 0.3, 0])
    assert shown(head, mouthRollUpper=0.5, mouthRollLower=0.5, jawOpen=0.8) == pytest.approx([-0.5, -0.1, 0.8])
    assert shown(head, mouthRollUpper=0.1, mouthRollLower=0.1) == pytest.approx([-0.1, -0.1, 0])
    first = {"keep": {"upper": 1, "lower": 0.5}, "at_least": 0, "moving": ["lower", "upper"]}
    assert shown(head_of(LIPS, couplings=[first]), mouthRollUpper=1.0) == pytest.approx([-0.5, 1, 0])


@given(st.integers(0, 2**32 - 1), st.sampled_from(["range", "rad"]))
def test_couplings_hold_for_any_motion(seed, unit):
    rng = np.random.default_rng(seed)
    joints = {name: joint | {"unit": unit, "min_deg": -50} for name, joint in LIPS.items()}
    coupling = APART[0] | {"keep": {"upper": 1.5, "lower": -0.7, "jaw": 0.5}}
    mapping = ChannelMapping(head_of(joints, couplings=[coupling]))
    angles = mapping.angles(rng.uniform(-1, 1, (50, 3, MOTION_DIM)).astype(np.float32))
    ends = np.radians([50, 10])
    units = angles if unit == "rad" else angles / np.where(angles > 0, ends[1], ends[0])
    assert (units @ [1.5, -0.7, 0.5] >= -0.2 - 1e-9).all()


def test_regions_turn_their_joints_up_and_down_and_no_others():
    head = head_of(
        {"brow": {"drive": "browInnerUp"}, "jaw": {"drive": "jawOpen"}},
        regions={"brows": {"joints": ["brow"], "intensity": 0.5}, "mouth": {"joints": ["jaw"]}},
    )
    mapping = ChannelMapping(head)
    assert shown(head, browInnerUp=0.6, jawOpen=0.6) == pytest.approx([0.3, 0.6])
    assert shown(head, mapping.knobs({"brows": 2}), browInnerUp=0.3, jawOpen=0.6) == pytest.approx([0.6, 0.6])
    assert shown(head, mapping.knobs({"brows": 0, "mouth": 0}), browInnerUp=1.0, jawOpen=1.0) == [0, 0]


@pytest.mark.parametrize("style, wanted", [(0, [0.01, 1.0]), (1, [0.1, 1.0]), (2, [0.19, 1.0])])
def test_style_doubles_or_removes_what_is_small_and_leaves_the_ends(style, wanted):
    head = head_of({"brow": {"drive": "browInnerUp"}}, regions={"brows": {"joints": ["brow"], "style": style}})
    assert [shown(head, browInnerUp=x)[0] for x in (0.1, 1.0)] == pytest.approx(wanted)
    swept = [shown(head, browInnerUp=x)[0] for x in np.linspace(-1, 1, 81)]
    assert np.all(np.diff(swept) >= 0)


def test_wrong_knobs_are_told_with_the_choices_and_channels_and_joints_left_out_are_listed():
    mapping = ChannelMapping(head_of({"jaw": {"drive": "jawOpen"}}, regions={"mouth": {"joints": ["jaw"]}}))
    with pytest.raises(ConfigError, match=r"intensity: 'nose' is not a region of this head \(mouth\)"):
        mapping.knobs({"nose": 1})
    for value in (2.5, -0.1, float("nan")):
        with pytest.raises(ConfigError, match=r"style of mouth = .* is not in 0..2"):
            mapping.knobs(style={"mouth": value})
    mapping = ChannelMapping(
        head_of({"jaw": {"drive": "open"}, "ear": {}}, expressions={"open": {"max": ["jawOpen", "yaw"]}})
    )
    assert set(CHANNELS) - set(mapping.blind_channels) == {"jawOpen", "yaw"} and mapping.dead_joints == ("ear",)


@given(st.integers(0, 2**32 - 1))
def test_products_of_absurd_channels_stay_finite(seed):
    rng = np.random.default_rng(seed)
    node = Expression(product=tuple(Expression(channel=c, gain=1000) for c in rng.choice(CHANNELS, 4)))
    head = head_of({"a": {"drive": Expression(product=(node, node, node)).model_dump(exclude_none=True)}})
    angles = ChannelMapping(head).angles(rng.choice(EXTREMES, (20, 1, MOTION_DIM)))
    assert np.isfinite(angles).all() and (np.abs(angles) <= np.radians(10)).all()


def driven(*drives, **joint) -> Head:
    """A head with a joint for each expression, None: one that nothing drives."""
    ends = {"min_deg": -10.0, "rest_deg": 2.0, "max_deg": 30.0}
    parts = [{} if drive is None else {"drive": drive.model_dump(exclude_none=True)} for drive in drives]
    return head_of({f"joint{index}": ends | joint | part for index, part in enumerate(parts)})


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
gains = {"gain_up": small, "gain_down": small}
bends = {"dead_band": st.floats(0, 0.5), "clamp": st.just((-0.5, 0.5)), "curve": curves}
shapes = st.fixed_dictionaries({"gain": small, "offset": small}, optional=gains | bends)
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
    head = driven(*drives, unit=unit)
    motion = np.random.default_rng(seed).uniform(-1, 1, (len(drives), MOTION_DIM)).astype(np.float32)
    angles = ChannelMapping(head).angles(motion)
    for angle, joint, row in zip(angles, head.joints.values(), motion, strict=True):
        u = value(joint.drive, row) if joint.drive else 0.0
        span = joint.max_rad - joint.rest_rad if u > 0 else joint.rest_rad - joint.min_rad
        wanted = joint.rest_rad + u * (span if unit == "range" else 1.0)
        assert angle == pytest.approx(min(max(wanted, joint.min_rad), joint.max_rad), abs=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused_by_name(bad):
    motion = np.zeros(MOTION_DIM, np.float32)
    motion[CHANNEL_INDEX["mouthPucker"]] = bad
    with pytest.raises(ValueError, match="mouthPucker is"):
        ChannelMapping(driven(Expression(channel="jawOpen"))).angles(motion)


@pytest.mark.parametrize("shape", [(57,), (2, 58), (3, 2, 58), ()])
def test_a_wrong_shape_is_refused(shape):
    with pytest.raises(ValueError, match="not"):
        ChannelMapping(driven(Expression(channel="jawOpen"))).angles(np.zeros(shape, np.float32))
