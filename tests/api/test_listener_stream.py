"""A listener without a robot."""

import numpy as np
import pytest

import sfms_robot as sr
from sfms_robot.frames import FRAME_S


@pytest.fixture(scope="module")
def listener():
    return sr.load_listener("sfms-small")


def test_a_stream_is_the_pure_step_with_its_memory_kept(listener):
    sound = np.random.default_rng(0).normal(0, 0.1, (12, 640)).astype(np.float32)
    stream, memory = listener.stream(seed=3), listener.start(3)
    plans = 0
    for index, samples in enumerate(sound):
        plan = stream.push(samples)
        expected, memory = listener.step(sr.SpeakerFrame((index + 1) / 25, samples), memory)
        assert (plan is None) == (expected is None)
        if plan is not None and expected is not None:
            plans += 1
            assert np.array_equal(plan.frames, expected.frames)
            assert plan.times_s[0] == pytest.approx(stream.time_s + FRAME_S)
    assert plans == 3 and stream.time_s == pytest.approx(0.48)


def test_two_streams_know_nothing_of_one_another_and_a_face_may_be_an_array_or_a_face_frame(listener):
    first, second = listener.stream(seed=1), listener.stream(seed=1)
    alone = first.push(np.zeros(640))
    listener.stream(seed=9).push(np.ones(640) * 0.1)
    assert np.array_equal(alone.frames, second.push(np.zeros(640)).frames)
    motion = np.linspace(0, 0.1, 58, dtype=np.float32)
    plans = [listener.stream().push(None, face=face) for face in (motion, sr.FaceFrame.of(99.0, motion))]
    assert np.array_equal(plans[0].frames, plans[1].frames)


WRONG = [
    ({"audio": np.zeros(320)}, r"audio: expected shape \(640,\) \(40 ms, mono, 16 kHz\), got \(320,\)"),
    ({"audio": np.zeros((640, 2))}, r"audio: .* got \(640, 2\)"),
    ({"audio": np.r_[np.zeros(639), np.nan]}, r"audio\[639\] is not finite"),
    ({"audio": None, "agent_audio": np.full(640, np.inf)}, r"agent_audio\[0\] is not finite"),
    ({"audio": None, "face": np.zeros(52)}, r"face: expected shape \(58,\) .*, got \(52,\)"),
    ({"audio": None, "face": np.full(58, np.nan)}, r"face\[0\] is not finite"),
]


@pytest.mark.parametrize(("given", "message"), WRONG)
def test_what_is_no_frame_is_refused_and_the_stream_goes_on(listener, given, message):
    stream, untouched = listener.stream(), listener.stream()
    with pytest.raises(sr.InputError, match=message):
        stream.push(**given)
    assert stream.time_s == 0.0 and np.array_equal(stream.push(None).frames, untouched.push(None).frames)
