"""Whether a person looks at the head, from their face."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.data import data_dir
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM, FaceFrame
from sfms_robot.signals.attention import AttentionState, attend
from sfms_robot.signals.gaze_kinematics import turn
from sfms_robot.signals.tracks import read_track

FULL_RAD = np.radians([30.0, 20.0])


def face(time_s, head_deg=(0.0, 0.0), eyes_deg=(0.0, 0.0), closed=0.0) -> FaceFrame:
    """Head and eyes turned by (yaw, pitch)."""
    row = np.zeros(MOTION_DIM, np.float32)
    turn(row, np.radians([eyes_deg] * 2), FULL_RAD)
    row[[CHANNEL_INDEX["yaw"], CHANNEL_INDEX["pitch"]]] = np.radians(head_deg) + 1e-4  # no tracker gives exact zeros
    row[[CHANNEL_INDEX["eyeBlinkLeft"], CHANNEL_INDEX["eyeBlinkRight"]]] = closed
    return FaceFrame.of(time_s, row)


def attentions(looks, seconds, state=None, place_m=None) -> tuple[np.ndarray, AttentionState]:
    """Attention per frame of `looks(t)`, the keywords of `face`."""
    state, out = state or AttentionState(), []
    start_s = 0.0 if state.time_s is None else state.time_s + FRAME_S
    for index in range(round(seconds / FRAME_S)):
        now_s = start_s + index * FRAME_S
        attention, state = attend(face(now_s, **looks(index * FRAME_S)), place_m, state)
        out.append(attention)
    return np.array(out), state


def at_head(t):
    return {}


def test_a_track_of_the_mouth_alone_tells_nothing():
    track = read_track(data_dir("sim") / "speakers" / "facegood_1114_3_16" / "face.csv.gz")
    state = AttentionState()
    for time_s, row in zip(track.times_s, track.motion, strict=True):
        attention, state = attend(FaceFrame.of(float(time_s), row), None, state)
        assert attention is None


def test_a_blink_changes_nothing_and_eyes_kept_shut_look_at_nothing():
    _, state = attentions(at_head, 3.0)
    blink, _ = attentions(lambda t: {"closed": 1.0, "eyes_deg": (0, 18)} if t < 0.3 else {}, 1.0, state)
    assert blink.min() > 0.95
    asleep, _ = attentions(lambda t: {"closed": 1.0}, 2.0, state)
    assert asleep[-1] < 0.01


@given(st.floats(-math.pi, math.pi), st.floats(0, 1))
def test_a_look_aside_is_told_within_three_tenths_of_a_second_and_so_is_its_end(way, share):
    """However it is shared between head and eyes."""
    aside = 30 * np.array([math.cos(way), math.sin(way)])
    eyes = np.clip(share * aside, -FULL_RAD * 57, FULL_RAD * 57)
    _, state = attentions(at_head, 5.0)
    away, state = attentions(lambda t: {"head_deg": aside - eyes, "eyes_deg": eyes}, 2.0, state)
    assert away[round(0.3 / FRAME_S) - 1 :].max() < 0.2
    back, _ = attentions(at_head, 1.0, state)
    assert back[round(0.3 / FRAME_S) - 1] > 0.8


@given(st.floats(0, 80), st.floats(0, 80), st.floats(-math.pi, math.pi))
def test_never_more_attention_for_a_larger_angle(one_deg, other_deg, way):
    small, large = sorted((one_deg, other_deg))
    _, state = attentions(at_head, 5.0)
    shown = [
        attentions(lambda t, a=angle: {"head_deg": (a * math.cos(way), a * math.sin(way))}, 0.5, state)[0]
        for angle in (small, large)
    ]
    assert (shown[0] >= shown[1] - 1e-9).all()


@given(st.floats(-14, 14), st.floats(-14, 14))
def test_a_neutral_of_its_own_is_learnt(yaw_deg, pitch_deg):
    """A phone that stands aside: after a quarter of a minute the same looks give the same attention."""

    def look(offset):
        def at(t):
            return {"head_deg": np.add(offset, (12.0 if t % 4 > 3 else 0.0, 0.0))}

        return at

    straight, _ = attentions(look((0.0, 0.0)), 25.0)
    aside, _ = attentions(look((yaw_deg, pitch_deg)), 25.0)
    late = slice(round(16 / FRAME_S), None)
    assert aside[late] == pytest.approx(straight[late], abs=0.1)


@given(st.floats(-0.8, 0.8), st.floats(-0.4, 0.4), st.floats(0.5, 2.0))
def test_where_the_place_is_known_looking_at_the_camera_is_attention_at_once(y_m, z_m, x_m):
    place_m = np.array([x_m, y_m, z_m], np.float32)
    there = np.degrees([math.atan2(y_m, x_m), math.atan2(z_m, math.hypot(x_m, y_m))])
    assert attend(face(0.0, head_deg=there), place_m, AttentionState())[0] > 0.95


def test_whoever_comes_after_a_while_starts_from_nothing():
    _, state = attentions(lambda t: {"head_deg": (18.0, 0.0)}, 20.0)
    later, _ = attend(face(state.time_s + 11.0), None, state)
    assert later > 0.95
