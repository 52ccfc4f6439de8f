"""Laws of the mapping that hold for every head that is shipped."""

import numpy as np
import pytest

from sfms_robot.config import load_head
from sfms_robot.config.check import check_head
from sfms_robot.data import head_names
from sfms_robot.frames import MOTION_DIM
from sfms_robot.retarget.head_retargeter import HeadRetargeter

HEADS = head_names()
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


@pytest.mark.parametrize("name", HEADS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_frame_that_is_not_finite_is_refused(name, bad):
    retargeter = HeadRetargeter(load_head(name))
    motion = np.zeros(MOTION_DIM, np.float32)
    for channel in range(MOTION_DIM):
        motion[:] = 0
        motion[channel] = bad
        with pytest.raises(ValueError, match="motion channel"):
            retargeter.angles(motion)


@pytest.mark.parametrize("name", HEADS)
def test_the_neutral_face_is_the_rest_pose(name):
    head = load_head(name)
    rest = np.array([joint.rest_rad for joint in head.joints.values()])
    assert HeadRetargeter(head).angles(np.zeros(MOTION_DIM, np.float32)) == pytest.approx(rest, rel=0, abs=1e-9)


@pytest.mark.parametrize("name", HEADS)
def test_a_shipped_head_has_no_problem(name):
    assert check_head(name) == []
