"""Mapping and neck as one: the neck follows the pose, the rest of the head the face."""

import numpy as np
import pytest
from motion_rows import motion

from sfms_robot.config import load_head
from sfms_robot.config.check import check_head
from sfms_robot.data import head_names
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, MOTION_DIM
from sfms_robot.retarget.head_retargeter import HeadRetargeter

HEADS = head_names()


@pytest.mark.parametrize("name", HEADS)
def test_a_shipped_head_has_no_problem_rests_with_the_neutral_face_and_shows_or_names_every_channel(name):
    retargeter = HeadRetargeter(load_head(name))
    face = motion(roll=0.05, pitch=0.1, yaw=-0.2, jawOpen=0.5, browInnerUp=0.4)
    stepped, _ = retargeter.step(face, retargeter.start())
    assert np.array_equal(stepped, retargeter.angles(face))
    rows = np.tile(face, (3, len(retargeter.joints), 1))
    assert retargeter.angles(rows) == pytest.approx(np.tile(stepped, (3, 1)), abs=1e-9)
    rest = retargeter.angles(motion())
    for channel in CHANNELS:
        sizes = (0.02, -0.02) if channel in CHANNELS[:6] else (1.0,)
        moved = any(np.abs(retargeter.angles(motion(**{channel: size})) - rest).max() > 1e-6 for size in sizes)
        alone = channel in ("eyeWideLeft", "eyeWideRight", "mouthClose")  # those only ever take something back
        assert moved or alone or channel in retargeter.blind_channels, channel
        assert not (moved and channel in retargeter.blind_channels), channel
    head = load_head(name)
    rest = np.array([joint.rest_rad for joint in head.joints.values()])
    assert HeadRetargeter(head).angles(np.zeros(MOTION_DIM, np.float32)) == pytest.approx(rest, rel=0, abs=1e-9)
    assert check_head(name) == []


def test_the_whole_neck_shows_the_pose_of_one_instant_scaled_by_its_regions_intensity():
    retargeter = HeadRetargeter(load_head("reachy_mini"))
    rows = np.stack([motion(pitch=0.01 * row) for row in range(len(retargeter.joints))])
    one = retargeter.angles(rows[retargeter.neck_columns[0]])
    assert np.array_equal(retargeter.angles(rows)[retargeter.neck_columns], one[retargeter.neck_columns])
    retargeter = HeadRetargeter(load_head("face28"))
    yaw = retargeter.joints.index("neck_yaw")
    for intensity in (0.0, 0.5, 2.0):
        knobs = retargeter.mapping.knobs({"neck": intensity})
        assert retargeter.angles(motion(yaw=0.2), knobs)[yaw] == pytest.approx(0.2 * intensity)


def test_style_of_the_necks_region_bends_small_poses_and_leaves_large_ones():
    retargeter = HeadRetargeter(load_head("face28"))
    yaw = retargeter.joints.index("neck_yaw")

    def turn(angle: float, style: float) -> float:
        return float(retargeter.angles(motion(yaw=angle), retargeter.mapping.knobs(style={"neck": style}))[yaw])

    assert turn(0.05, 2.0) == pytest.approx(1.95 * turn(0.05, 1.0), rel=1e-3)
    assert abs(turn(0.05, 0.0)) < 0.1 * turn(0.05, 1.0) and turn(1.0, 0.0) == pytest.approx(turn(1.0, 2.0))


def test_what_the_neck_remembers_is_handed_through():
    head = load_head("reachy_mini")
    body = head.kinematics.body_yaw.model_copy(update={"low_pass_hz": 0.5})
    slow = head.model_copy(update={"kinematics": head.kinematics.model_copy(update={"body_yaw": body})})
    retargeter = HeadRetargeter(slow, 0.01)
    memory, turned = retargeter.start(), []
    for _ in range(100):
        angles, memory = retargeter.step(motion(yaw=0.3), memory)
        turned.append(angles[0])
    assert turned[0] < 0.02 < turned[-1] < 0.3 and (np.diff(turned) > 0).all()


def test_antennas_of_reachy_mini_rise_with_brows_and_smiles_and_fall_with_frowns_on_their_side():
    retargeter = HeadRetargeter(load_head("reachy_mini"))

    def raised(**face) -> list[float]:
        turned = retargeter.angles(motion(**face)) - retargeter.angles(motion())
        assert not turned[:7].any()  # body and legs follow the pose, not the face
        return (turned[7:] * [1, -1]).tolist()

    right, left = raised(browOuterUpLeft=1.0)
    assert 0 < right < left and raised(browOuterUpRight=1.0) == pytest.approx([left, right])
    assert min(raised(browInnerUp=1.0)) > 0 > max(raised(browDownLeft=1.0, browDownRight=1.0))
    assert (
        min(raised(mouthSmileLeft=1.0, mouthSmileRight=1.0)) > 0 > max(raised(mouthFrownLeft=1.0, mouthFrownRight=1.0))
    )


def test_a_rest_that_is_not_the_necks_home_is_told():
    head = load_head("reachy_mini")
    leg = head.joints["stewart_2"].model_copy(update={"rest_deg": -20.0})
    with pytest.raises(ConfigError, match=r"joints.stewart_2.rest_deg = -20.0 is not where .* at home, -35.898"):
        HeadRetargeter(head.model_copy(update={"joints": {**head.joints, "stewart_2": leg}}))


FRAMES = 10_000


def adversarial(rng) -> np.ndarray:
    """Frames as a listener gone wrong might give them: plausible, extreme, jumping, absurd."""
    plausible = rng.uniform(0, 1, (FRAMES // 4, MOTION_DIM))
    extreme = rng.choice([0.0, 1.0], (FRAMES // 4, MOTION_DIM))
    jumping = rng.choice([0.0, 0.0, 0.0, 1.0, -1.0, 50.0], (FRAMES // 4, MOTION_DIM))
    absurd = rng.choice([0.0, 3e38, -3e38, 1e-45, -7.0, 1e6], (FRAMES // 4, MOTION_DIM))
    return np.concatenate([plausible, extreme, jumping, absurd]).astype(np.float32)


@pytest.mark.parametrize("name", HEADS)
@pytest.mark.parametrize("intensity", [pytest.param(1.0, marks=pytest.mark.slow), 2.0])
def test_angles_are_finite_and_inside_the_range_for_ten_thousand_wild_frames(name, intensity):
    head = load_head(name)
    retargeter = HeadRetargeter(head)
    knobs = retargeter.mapping.knobs(dict.fromkeys(head.regions, intensity), dict.fromkeys(head.regions, intensity))
    frames = adversarial(np.random.default_rng(0))
    rows = np.broadcast_to(frames[:, None], (FRAMES, len(head.joints), MOTION_DIM))
    angles = np.concatenate([retargeter.angles(part, knobs) for part in np.array_split(rows, 10)])
    low, high = np.array([(joint.min_rad, joint.max_rad) for joint in head.joints.values()]).T
    assert np.isfinite(angles).all() and (angles >= low).all() and (angles <= high).all()
