"""One expression on a resting head: what moves, how far, and what is refused."""

import numpy as np
import pytest

from sfms_robot.app.head.pose import RISE_S, expressions, held_face, parse_face, pose_head
from sfms_robot.app.options import HeadOptions
from sfms_robot.data import head_names
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX
from sfms_robot.runtime.safety import EASE_S

HEADS = head_names()


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))


@pytest.mark.parametrize("word", expressions())
def test_every_expression_is_made_of_channels_in_their_range(word):
    motion = parse_face([word])
    assert np.count_nonzero(motion) == len(expressions()[word])
    assert np.array_equal(motion, parse_face([f"{c}={v}" for c, v in expressions()[word].items()]))


def test_later_words_go_over_earlier_ones_and_the_face_rises_stays_and_falls():
    motion = parse_face(["smile", "mouthSmileLeft=0.1", "yaw=-0.5"])
    assert motion[CHANNEL_INDEX["mouthSmileLeft"]] == np.float32(0.1)
    assert motion[CHANNEL_INDEX["mouthSmileRight"]] == np.float32(0.9) and motion[CHANNEL_INDEX["yaw"]] == -0.5
    held = held_face(parse_face(["jawOpen=0.8"]), hold_s=1.0)
    times = np.array([0.0, EASE_S, EASE_S + RISE_S, EASE_S + RISE_S + 1.0, held.duration_s])
    jaw = held.sample(times, 0.0, None)[0][:, CHANNEL_INDEX["jawOpen"]]
    assert jaw.tolist() == pytest.approx([0, 0, 0.8, 0.8, 0], abs=1e-6)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("grin", r"EXPRESSION = 'grin' is not an expression \(smile, .*CHANNEL=VALUE\)"),
        ("mouth=1", r"CHANNEL = 'mouth' is not a channel; did you mean 'mouthLeft'"),
        ("jawOpen=1.5", r"jawOpen = '1.5' is not a number in its range \(0..1\)"),
        ("jawOpen=nan", "jawOpen = 'nan'"),
        ("yaw=wide", r"yaw = 'wide' is not a number in its range, in rad \(-1.6..1.6\)"),
        ("yaw=20", r"yaw = '20' is not a number in its range, in rad; 20 deg is yaw=0.349 \(-1.6..1.6\)"),
        ("x=5", r"x = '5' .*, in m \(-0.1..0.1\)"),
        ("jawOpen=", "jawOpen = ''"),
    ],
)
def test_what_is_no_face_is_refused(word, message):
    with pytest.raises(ConfigError, match=message):
        parse_face([word])


def test_a_smile_moves_the_mouth_and_leaves_the_neck_alone():
    told = pose_head(HeadOptions(fast=True), ["smile"], 0.5)
    assert told["exit"] == "done" and {"corner_left", "corner_right"} <= set(told["joints"])
    assert not {"neck_yaw", "neck_pitch", "neck_roll", "jaw"} & set(told["joints"])
    for row in told["joints"].values():
        assert row["reached_deg"] == pytest.approx(row["sent_deg"], abs=1.0)


@pytest.mark.parametrize("name", HEADS)
def test_every_head_nods_or_says_that_it_cannot(name):
    told = pose_head(HeadOptions(head=name, fast=True), ["pitch=0.1"], 0.2)
    assert told["exit"] == "done" and (told["joints"] or told["blind"] == ["pitch"])
