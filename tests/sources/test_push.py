"""A source fed from outside: what comes out is what went in, on a grid that never slips."""

import threading

import numpy as np
import pytest
import soxr
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES, FaceFrame
from sfms_robot.sources.push import FACE_S, PATIENCE_FRAMES, PushSource

RATES_HZ = [8000, 16000, 22050, 24000, 44100, 48000]
TAIL_S = (PATIENCE_FRAMES + 4) / 25


def heard(frames):
    return np.concatenate([frame.audio for frame in frames]) if frames else np.zeros(0, dtype=np.float32)


@given(
    st.sampled_from(RATES_HZ), st.lists(st.integers(1, 9000), min_size=1, max_size=12), st.integers(0, 9), st.booleans()
)
def test_whatever_the_pieces_what_comes_out_is_the_sound_resampled_at_once(rate_hz, sizes, seed, says):
    samples = np.random.default_rng(seed).uniform(-1, 1, sum(sizes)).astype(np.float32)
    source, frames, pushed = PushSource(heard_s=60.0), [], 0
    for size in sizes:
        (source.say if says else source.hear)(samples[pushed : pushed + size], rate_hz)
        pushed += size
        if not says:  # a microphone gives each piece when it is over, a synthesized voice comes before its time
            frames += source.read(pushed / rate_hz)
    frames += source.read(pushed / rate_hz + TAIL_S)
    out = np.concatenate([frame.agent_audio for frame in frames]) if says else heard(frames)
    whole = samples if rate_hz == 16000 else soxr.resample(samples, rate_hz, 16000, quality="HQ")
    np.testing.assert_array_equal(out[: len(whole)], np.clip(whole, -1, 1))
    assert not out[len(whole) :].any()


@given(st.lists(st.one_of(st.floats(0, 0.5), st.integers(1, 4000), st.none()), max_size=40))
def test_the_grid_never_slips_and_every_frame_is_whole_or_empty(moves):
    source, now_s, frames = PushSource(), 0.0, []
    for move in moves:
        if move is None:
            source.see(np.full(58, np.float32(0.5)))
        elif isinstance(move, int):
            source.hear(np.full(move, 0.1), 16000)
        else:
            now_s += move
            frames += source.read(now_s)
    assert [round(frame.time_s * 25) for frame in frames] == list(range(1, len(frames) + 1))
    assert len(frames) == int(now_s * 25 + 1e-6)
    assert all(frame.audio.shape in ((0,), (FRAME_SAMPLES,)) and frame.audio.dtype == np.float32 for frame in frames)


def test_bytes_integers_floats_and_channels_mean_the_same():
    pcm = np.arange(-640, 640, dtype=np.int16) * 20
    ways = [pcm.tobytes(), pcm, pcm / 32768, np.stack([pcm, pcm], axis=1), (pcm / 32768).astype(np.float16)]
    for way in ways:
        source = PushSource()
        source.hear(way, 16000)
        np.testing.assert_allclose(heard(source.read(0.08)), pcm / 32768, atol=5e-4)


@pytest.mark.parametrize(
    ("pcm", "rate_hz", "told"),
    [
        (np.zeros(9), 1, "rate_hz = 1 is no rate"),
        (np.zeros(9), float("nan"), "rate_hz = nan"),
        (b"abc", 16000, "3 bytes is not of 16-bit"),
        (np.zeros(9, dtype=np.int64), 16000, "pcm is int64"),
        (np.zeros((2, 2, 2)), 16000, r"shape \(2, 2, 2\)"),
    ],
)
def test_what_is_no_sound_is_refused_and_leaves_no_trace(pcm, rate_hz, told):
    source = PushSource()
    with pytest.raises(ConfigError, match=told):
        source.hear(pcm, rate_hz)
    assert not len(source.read(0.04)[0].audio)


def test_what_is_not_finite_becomes_silence_and_is_counted():
    source = PushSource()
    source.hear(np.r_[np.full(638, 0.5), np.nan, 1e300], 16000)
    (frame,) = source.read(0.04)
    assert frame.audio[:638].all() and frame.audio[638] == 0 and frame.audio[639] == 0
    assert source.statistics() == {"dropped": 0, "not_finite": 2}


def test_a_caller_who_is_faster_than_time_fills_no_memory():
    source = PushSource(heard_s=0.4)
    for second in range(20):
        source.hear(np.full(16000, second / 100), 16000)
    frames = source.read(1.0)
    assert np.unique(heard(frames)) == np.float32(0.19)  # the newest
    assert len(heard(frames)) == 6400 and source.statistics()["dropped"] == 20 * 16000 - 6400


def test_a_face_holds_for_a_quarter_of_a_second_and_can_be_lost():
    source = PushSource()
    source.see(FaceFrame(123.0, np.ones(6, dtype=np.float32), np.full(52, 0.5, dtype=np.float32)))
    faces = [source.read(n / 25)[0].face for n in range(1, 10)]
    assert [face is not None for face in faces] == [n / 25 - 0.04 <= FACE_S for n in range(1, 10)]
    assert faces[0].time_s == 0.04 and faces[2].time_s == 0.12
    source.see(np.zeros(58))
    assert source.read(0.4)[0].face is not None
    source.see(None)
    assert source.read(0.44)[0].face is None
    with pytest.raises(ConfigError, match=r"face has the shape \(52,\)"):
        source.see(np.zeros(52))


def test_a_robot_that_has_not_spoken_has_no_track_and_one_that_has_is_silent_after():
    source = PushSource(duration_s=2.0)
    assert source.read(0.04)[0].agent_audio is None
    source.say(np.full(640, 0.5), 16000)
    one, *after = source.read(5.0)
    assert one.agent_audio.all() and not any(frame.agent_audio.any() for frame in after)
    assert one.time_s == 0.08 and after[-1].time_s == 2.0 and not source.read(9.0)


def test_calls_may_come_from_any_thread():
    source = PushSource(heard_s=60.0)

    def speak() -> None:
        for _ in range(50):
            source.hear(np.full(160, 0.25), 16000)

    threads = [threading.Thread(target=speak) for _ in range(4)]
    for thread in threads:
        thread.start()
    frames = [frame for n in range(1, 20) for frame in source.read(n / 25)]
    for thread in threads:
        thread.join()
    frames += source.read(20.0)
    assert len(heard(frames)) == 4 * 50 * 160 and np.unique(heard(frames)) == np.float32(0.25)
