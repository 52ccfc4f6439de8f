"""Motion spaces of the papers: laws of the conversion, and listeners that work in any of them."""

import numpy as np
import pytest
from tiny_sfms import plans_of, speech, tiny_listener, tiny_settings

from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, JAW_FULL_OPEN_RAD, ORDERS, SHAPES, SPACE_CHANNELS
from sfms_robot.listeners.space import SPACES, FlameMatrix, MotionSpace, bounded_least_squares, read_matrix

RNG = np.random.default_rng(5)
MATRIX = RNG.normal(size=(52, 50))
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


@pytest.mark.parametrize("known", SPACES.values(), ids=SPACES)
def test_axes_are_a_rotation(known):
    axes = np.array(known.axes)
    assert np.array_equal(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) == pytest.approx(1)


def test_a_translation_without_a_metric_scale_moves_nothing():
    frames = space("faceverse58").encode(faces())
    frames[:, 55:] = RNG.normal(size=(20, 3))
    assert not space("faceverse58").decode(frames)[0][:, 3:6].any()


@pytest.mark.parametrize(("index", "channel"), [(50, "pitch"), (51, "yaw"), (52, "roll")])
def test_flame_turns_about_its_own_axes(index, channel):
    frame = np.zeros((1, 56))
    frame[0, index] = 0.3
    pose = space("deca56").decode(frame)[0][0, :6]
    assert pose[CHANNEL_INDEX[channel]] == pytest.approx(0.3, abs=1e-6)
    assert np.count_nonzero(np.abs(pose) > 1e-6) == 1


def test_without_a_matrix_pose_and_jaw_alone_move():
    frames = RNG.normal(size=(5, 56))
    frames[:, 53] = JAW_FULL_OPEN_RAD / 2
    motion, jaw_rad = space("deca56").decode(frames)
    shapes = motion[:, SHAPES]
    assert shapes[:, BLENDSHAPES.index("jawOpen")] == pytest.approx(0.5)
    assert np.count_nonzero(shapes) == len(frames)
    assert jaw_rad is not None and jaw_rad[:, 1] == pytest.approx(JAW_FULL_OPEN_RAD / 2)


def test_solved_weights_are_bounded_and_gaze_stays_still():
    weights = FlameMatrix(MATRIX).solve(RNG.normal(scale=5, size=(20, 50)), np.zeros(20))
    assert weights.min() >= 0 and weights.max() <= 1
    assert not weights[:, [name.startswith("eyeLook") for name in BLENDSHAPES]].any()


def test_bounded_solution_cannot_be_bettered():
    """Where an unknown is free its slope is 0; at a bound the slope points outward (the optimality conditions)."""
    matrix, wanted = RNG.normal(size=(30, 8)), RNG.normal(scale=3, size=(25, 30))
    x = bounded_least_squares(matrix, wanted, np.full(8, -0.2), np.full(8, 0.5))
    slope = (x @ matrix.T - wanted) @ matrix
    at_low, at_high = x <= -0.2, x >= 0.5
    assert np.abs(slope[~at_low & ~at_high]).max() < 1e-4
    assert (slope[at_low] > -1e-4).all() and (slope[at_high] < 1e-4).all()


def test_matrix_files_of_both_kinds_are_the_same_matrix(tmp_path):
    by_order = MATRIX[[BLENDSHAPES.index(name) for name in ORDERS["apple"]]]
    np.save(tmp_path / "m.npy", by_order)
    lines = [",".join([name, *map(repr, row.tolist())]) for name, row in zip(ORDERS["apple"], by_order, strict=True)]
    (tmp_path / "m.csv").write_text("\n".join(lines))
    assert np.array_equal(read_matrix(tmp_path / "m.npy", "apple").rows, MATRIX)
    assert np.array_equal(read_matrix(tmp_path / "m.csv").rows, MATRIX)


@pytest.mark.parametrize(
    ("text", "told"),
    [("1,2\n3,4\n", "not a row of at least 50"), ("smile,1\n", "numbers"), ("jawOpen,1\nsmile,2\n", "'smile'")],
)
def test_bad_matrix_is_told_in_one_line(tmp_path, text, told):
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(ConfigError, match=told) as error:
        read_matrix(tmp_path / "m.csv")
    assert "m.csv" in str(error.value) and "\n" not in str(error.value)


def test_what_is_no_frame_is_refused():
    with pytest.raises(ValueError, match=r"not \(N, 56\)"):
        space("deca56").decode(np.zeros((1, 58)))
    with pytest.raises(ValueError, match="frame 1 is not finite"):
        space("deca56").decode(np.array([[0.0] * 56, [np.nan] * 56]))


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
