"""The default head: what its file promises."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from motion_rows import motion

from sfms_robot.config import load_head
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM
from sfms_robot.retarget.head_retargeter import HeadRetargeter

HEAD = load_head("face28")
MAPPING = HeadRetargeter(HEAD)
JOINTS = list(HEAD.joints)
REST = np.array([joint.rest_rad for joint in HEAD.joints.values()])
LOW = np.array([joint.min_rad or -1.0 for joint in HEAD.joints.values()])
HIGH = np.array([joint.max_rad or 1.0 for joint in HEAD.joints.values()])
TURNS_ROUND = {"neck_yaw", "neck_roll", "tongue_side", "eye_pan_left", "eye_pan_right"}  # + is to one side


def angle_deg(joint: str, **channels: float) -> float:
    return float(np.degrees(MAPPING.angles(motion(**channels))[JOINTS.index(joint)]))


def other_side(name: str) -> str:
    for a, b in (("Left", "Right"), ("left", "right")):
        if name.endswith(a):
            return name.removesuffix(a) + b
        if name.endswith(b):
            return name.removesuffix(b) + a
    return name


@given(st.integers(0, 2**32 - 1))
def test_a_mirrored_face_gives_mirrored_joints(seed):
    rng = np.random.default_rng(seed)
    motion = rng.uniform(0, 1, MOTION_DIM).astype(np.float32)
    motion[:6] = rng.uniform(-0.5, 0.5, 6)
    mirrored = motion[[CHANNEL_INDEX[other_side(name)] for name in CHANNELS]]
    for name in ("roll", "yaw", "y"):
        mirrored[CHANNEL_INDEX[name]] *= -1
    wanted = MAPPING.angles(motion)[[JOINTS.index(other_side(name)) for name in JOINTS]]
    signs = np.array([-1.0 if name in TURNS_ROUND else 1.0 for name in JOINTS])
    assert MAPPING.angles(mirrored) == pytest.approx(signs * wanted, abs=1e-6)


def test_every_region_can_be_turned_to_rest():
    motion = np.ones(MOTION_DIM, np.float32)
    still = MAPPING.mapping.knobs(intensity=dict.fromkeys(HEAD.regions, 0.0))
    assert np.array(JOINTS)[MAPPING.angles(motion, still) != REST].size == 0


@pytest.mark.parametrize("joint", ["lid_left", "lid_right"])
def test_a_lid_closes_with_a_blink_whatever_else_the_eye_does(joint):
    side, top = joint.removeprefix("lid_").capitalize(), HEAD.joints[joint].max_deg
    for other in ({}, {f"eyeLookUp{side}": 1.0}, {f"eyeWide{side}": 1.0}):
        assert angle_deg(joint, **{f"eyeBlink{side}": 0.86}, **other) == pytest.approx(top)


def test_the_lips_never_cross_whatever_the_mouth_does():
    rng, motion = np.random.default_rng(1), np.zeros((2000, MOTION_DIM), np.float32)
    motion[:, 6:] = rng.choice([0.0, 0.3, 1.0], (2000, MOTION_DIM - 6))
    angles = np.array([MAPPING.angles(row) for row in motion])
    units = angles / np.where(angles > 0, HIGH, -LOW)
    column = {name: units[:, JOINTS.index(name)] for name in JOINTS}
    for part in ("left", "right", "centre"):
        gap = column[f"lip_upper_{part}"] + column[f"lip_lower_{part}"] + column["jaw"]
        assert gap.min() >= -0.3 - 1e-9, part
