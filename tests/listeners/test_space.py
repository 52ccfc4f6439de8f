"""What a listener hears and shows does not depend on the motion space it works in."""

import numpy as np
import pytest
from tiny_sfms import plans_of, speech, tiny_listener, tiny_settings

from sfms_robot.errors import ConfigError
from sfms_robot.frames import SPACE_CHANNELS
from sfms_robot.listeners.space import MotionSpace

PRESET = {"preset": "one", "levels": [3, 3], "keyframes": 6}


def faces(frames: int = 20, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.uniform(-0.6, 0.6, (frames, 3)), rng.uniform(-0.05, 0.05, (frames, 3))], axis=1)
    return np.concatenate([pose, rng.uniform(0, 1, (frames, 52))], axis=1).astype(np.float32)


def space(name: str, **changes) -> MotionSpace:
    return MotionSpace.of(tiny_settings(motion_space=name, groups=PRESET, **changes))


@pytest.mark.parametrize("name", ["arkit58", "faceverse58"])
def test_our_motion_survives_the_way_into_a_space_and_back(name):
    there = space(name, metres_per_unit=0.5)
    frames = there.encode(faces())
    assert frames.shape == (20, len(SPACE_CHANNELS[name]))
    back, jaw = there.decode(frames)
    assert jaw is None
    assert back == pytest.approx(faces(), abs=1e-5)


def test_deca_keeps_pose_and_jaw_and_rest_in_every_space_is_a_face_at_rest():
    deca = space("deca56")
    back, jaw = deca.decode(deca.encode(faces()))
    assert back[:, :3] == pytest.approx(faces()[:, :3], abs=1e-5)
    assert back[:, 6 + 24] == pytest.approx(faces()[:, 6 + 24], abs=1e-5)  # jawOpen
    assert jaw is not None and jaw.shape == (20, 3)
    assert "pose and jaw only" in deca.limitation
    assert space("faceverse58").limitation is None
    for name in SPACE_CHANNELS:
        at_rest = space(name)
        assert at_rest.decode(at_rest.neutral[None].astype(np.float32))[0] == pytest.approx(np.zeros((1, 58)), abs=1e-6)


@pytest.mark.parametrize("name", ["faceverse58", "deca56"])
def test_a_listener_of_another_space_plans_our_frames(name):
    plans = plans_of(tiny_listener(motion_space=name, groups=PRESET), speech(9))
    assert len(plans) == 3
    for plan in plans.values():
        assert plan.frames.shape == (8, 58) and np.isfinite(plan.frames).all()
        assert (plan.jaw_rad is not None) == (name == "deca56")


@pytest.mark.parametrize("preset, groups", [("one", 1), ("four", 4), ("all", 58)])
def test_presets_split_the_channels_without_leaving_one_out(preset, groups):
    settings = tiny_settings(motion_space="faceverse58", groups=PRESET | {"preset": preset})
    assert len(settings.groups) == groups
    assert sorted(c for group in settings.groups.values() for c in group.channels) == sorted(settings.channels)


@pytest.mark.parametrize(
    "changes, line",
    [
        ({"groups": PRESET | {"preset": "five"}}, "none of one, four"),
        ({"groups": PRESET | {"preset": "four"}, "motion_space": "deca56"}, "four .not for deca56."),
        ({"groups": {"preset": "one"}}, "a preset takes the keys"),
        ({"neutral": [0.0, 1.0]}, "neutral: 2 numbers, arkit58 has 58"),
        ({"flame_matrix": "m.npy"}, "flame_matrix: arkit58 already is"),
        ({"motion_space": "smpl"}, "motion_space"),
        ({"kind": "lstm"}, "kind"),
    ],
)
def test_a_wrong_space_is_one_clear_line(changes, line):
    with pytest.raises(ConfigError, match=line) as told:
        tiny_settings(**changes)
    assert "\n" not in str(told.value)
