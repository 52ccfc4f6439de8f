"""Motion spaces of the papers: laws of the conversion, and what is told when something is missing."""

import numpy as np
import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, ORDERS, SHAPES
from sfms_robot.signals import spaces

RNG = np.random.default_rng(5)
MATRIX = RNG.normal(size=(52, 50))


def faces(count=40):
    motion = np.zeros((count, 58), dtype=np.float32)
    motion[:, :3] = RNG.uniform(-0.6, 0.6, (count, 3))
    motion[:, 3:6] = RNG.uniform(-0.05, 0.05, (count, 3))
    motion[:, SHAPES] = RNG.uniform(0, 1, (count, 52))
    return motion


@pytest.mark.parametrize("space", spaces.SPACES.values(), ids=spaces.SPACES)
def test_axes_are_a_rotation(space):
    axes = np.array(space.axes)
    assert np.array_equal(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) == pytest.approx(1)


def test_faceverse_and_back_is_the_same_face():
    motion, neutral = faces(), spaces.encode(np.zeros((1, 58)))[0]
    frames = spaces.encode(motion, metres_per_unit=1.0)
    back, jaw_rad = spaces.decode(frames, "faceverse58", neutral=neutral, metres_per_unit=1.0)
    assert np.abs(back - motion).max() < 1e-5 and jaw_rad is None


def test_faceverse_neutral_looks_straight_ahead_and_its_translation_has_no_metric_scale():
    frame = np.zeros((1, 58))
    frame[0, 52] = np.pi
    assert np.abs(spaces.decode(frame, "faceverse58")[0]).max() < 1e-6
    assert not spaces.decode(spaces.encode(faces()), "faceverse58")[0][:, 3:6].any()


@pytest.mark.parametrize(("index", "channel"), [(50, "pitch"), (51, "yaw"), (52, "roll")])
def test_flame_turns_about_its_own_axes(index, channel):
    frame = np.zeros((1, 56))
    frame[0, index] = 0.3
    pose = spaces.decode(frame, "deca56")[0][0, :6]
    assert pose[CHANNEL_INDEX[channel]] == pytest.approx(0.3, abs=1e-6)
    assert np.count_nonzero(np.abs(pose) > 1e-6) == 1


def test_without_a_matrix_pose_and_jaw_move_and_it_says_so():
    frames = RNG.normal(size=(5, 56))
    frames[:, 53] = spaces.JAW_FULL_OPEN_RAD / 2
    motion, jaw_rad = spaces.decode(frames, "deca56")
    assert "pose and jaw only" in (spaces.limitation("deca56", None) or "")
    shapes = motion[:, SHAPES]
    assert shapes[:, BLENDSHAPES.index("jawOpen")] == pytest.approx(0.5) and np.count_nonzero(shapes) == len(frames)
    assert jaw_rad is not None and jaw_rad[:, 1] == pytest.approx(spaces.JAW_FULL_OPEN_RAD / 2)


def test_expression_comes_back_through_the_matrix():
    shown = [BLENDSHAPES.index(name) for name in ("mouthSmileLeft", "mouthSmileRight", "browInnerUp", "cheekPuff")]
    weights = np.zeros((30, 52))
    weights[:, shown] = RNG.uniform(0.2, 0.9, (30, 1))
    frames = np.zeros((30, 56))
    frames[:, :50] = weights @ MATRIX
    motion, _ = spaces.decode(frames, "deca56", flame=spaces.FlameMatrix(MATRIX))
    assert spaces.limitation("deca56", spaces.FlameMatrix(MATRIX)) is None
    assert np.abs(motion[:, SHAPES] - weights).mean() < 0.02
    assert np.abs(motion[:, SHAPES][:, shown] - weights[:, shown]).max() < 0.1


def test_solved_weights_are_bounded_and_gaze_stays_still():
    weights = spaces.FlameMatrix(MATRIX).solve(RNG.normal(scale=5, size=(20, 50)), np.zeros(20))
    assert weights.min() >= 0 and weights.max() <= 1
    assert not weights[:, [name.startswith("eyeLook") for name in BLENDSHAPES]].any()


def test_bounded_solution_cannot_be_bettered():
    """Where an unknown is free its slope is 0; at a bound the slope points outward (the optimality conditions)."""
    matrix, wanted = RNG.normal(size=(30, 8)), RNG.normal(scale=3, size=(25, 30))
    x = spaces.bounded_least_squares(matrix, wanted, np.full(8, -0.2), np.full(8, 0.5))
    slope = (x @ matrix.T - wanted) @ matrix
    at_low, at_high = x <= -0.2, x >= 0.5
    assert np.abs(slope[~at_low & ~at_high]).max() < 1e-4
    assert (slope[at_low] > -1e-4).all() and (slope[at_high] < 1e-4).all()


def test_matrix_files_of_both_kinds_are_the_same_matrix(tmp_path):
    by_order = MATRIX[[BLENDSHAPES.index(name) for name in ORDERS["apple"]]]
    np.save(tmp_path / "m.npy", by_order)
    lines = [",".join([name, *map(repr, row.tolist())]) for name, row in zip(ORDERS["apple"], by_order, strict=True)]
    (tmp_path / "m.csv").write_text("\n".join(lines))
    assert np.array_equal(spaces.read_matrix(tmp_path / "m.npy", "apple").rows, MATRIX)
    assert np.array_equal(spaces.read_matrix(tmp_path / "m.csv").rows, MATRIX)


@pytest.mark.parametrize(
    ("text", "told"),
    [("1,2\n3,4\n", "not a row of at least 50"), ("smile,1\n", "numbers"), ("jawOpen,1\nsmile,2\n", "'smile'")],
)
def test_bad_matrix_is_told_in_one_line(tmp_path, text, told):
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(ConfigError, match=told) as error:
        spaces.read_matrix(tmp_path / "m.csv")
    assert "m.csv" in str(error.value) and "\n" not in str(error.value)


def test_what_is_no_frame_is_refused():
    with pytest.raises(ConfigError, match="faceverse58, deca56"):
        spaces.decode(np.zeros((1, 58)), "emoca")
    with pytest.raises(ValueError, match=r"not \(N, 56\)"):
        spaces.decode(np.zeros((1, 58)), "deca56")
    with pytest.raises(ValueError, match="frame 1 is not finite"):
        spaces.decode(np.array([[0.0] * 56, [np.nan] * 56]), "deca56")


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("eyeBlink_L", "eyeBlinkLeft"),
        ("EYEBLINKRIGHT", "eyeBlinkRight"),
        ("BlendShape.mouthSmile_R", "mouthSmileRight"),
        ("brow_inner_up", "browInnerUp"),
        ("jawL", "jawLeft"),
        ("tongueOut", "tongueOut"),
        ("HeadYaw", "yaw"),
        ("pitch [degrees]", "pitch"),
        ("headX_cm", "x"),
        ("AU12_r", None),
        ("eyeBlink", None),
    ],
)
def test_a_channel_goes_by_every_spelling(name, channel):
    assert spaces.channel_of(name) == channel


def test_every_shape_has_its_short_name_and_what_is_left_out_is_counted_and_named():
    for name in BLENDSHAPES:
        short = name.replace("Left", "_L").replace("Right", "_R")
        assert spaces.channel_of(f"ARKit.{short}") == spaces.channel_of(name.upper()) == name
    assert spaces.used_line(["jawOpen", "yaw"], ["b", "a"]) == "1 of 52 channels used; not known: a, b"
    assert spaces.used_line(BLENDSHAPES, []) == "52 of 52 channels used"


TURN = np.sin(np.arange(90) / 30)


def face_of(**channels):
    motion = np.zeros((90, 58), dtype=np.float32)
    for name, values in channels.items():
        motion[:, CHANNEL_INDEX[name]] = values
    return motion


@pytest.mark.parametrize(
    ("motion", "line"),
    [
        (face_of(yaw=1.2 * TURN, jawOpen=1.1), ""),
        (face_of(yaw=5.5 * TURN), "angles are taken as degrees"),
        (face_of(yaw=np.random.default_rng(0).normal(0, 0.3, 90)), "angles are taken as degrees"),  # trembles at 30 Hz
        (face_of(jawOpen=40 * np.abs(TURN)), "blendshapes are taken as percent"),
        (face_of(yaw=np.where(np.arange(90) == 50, 3.1, 0.1)), ""),  # a tracker lost its way once
    ],
)
def test_units_are_decided_by_what_a_head_can_do_in_a_file_and_live(motion, line):
    times_s, live = np.arange(90) / 30, spaces.LiveUnits()
    units = spaces.units_of(motion, times_s)
    assert units.line == line
    taken = [live.take(row, time_s) for row, time_s in zip(motion, times_s, strict=True)]
    assert live.units == units and all(each is None for each in taken[:30])
    for each, row in zip(taken[31:], units.ours(motion)[31:], strict=True):
        assert each is None or np.array_equal(each, row)


def test_a_face_beyond_a_head_is_named():
    row = np.zeros(58)
    assert spaces.beyond(row) is None
    for name, value, line in [
        ("yaw", 20.0, "yaw: expected radians (in degrees?), got 20"),
        ("z", -600.0, "z: expected metres (in cm or mm?), got -600"),
        ("jawOpen", 80.0, "jawOpen: expected 0 to 1 (in percent?), got 80"),
        ("jawOpen", np.nan, "jawOpen is not finite"),
    ]:
        wrong = row.copy()
        wrong[CHANNEL_INDEX[name]] = value
        assert spaces.beyond(wrong) == line
