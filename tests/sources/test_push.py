"""A person handed over by calls: what comes out is what went in, on a grid that never slips."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import soxr
from hypothesis import given, settings
from hypothesis import strategies as st

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES, FaceFrame
from sfms_robot.sources.paired import FACE_S, PairedSource
from sfms_robot.sources.push import PushedSight, PushedSpeech, PushedVoice

RATES_HZ = [8000, 16000, 22050, 24000, 44100, 48000]


class Person:
    """What a program pushes, at a time that the test sets, joined as a robot does."""

    def __init__(self, **more):
        self.now_s = 100.0
        self.voice = PushedVoice(lambda: self.now_s)
        self.sight = PushedSight(lambda: self.now_s)
        self.speech = PushedSpeech(lambda: self.now_s)
        self.source = PairedSource(self.voice, self.sight, self.speech, **more)
        self.source.start(100.0)

    def read(self, loop_s):
        self.now_s = 100.0 + loop_s
        return self.source.read(loop_s)


def heard(frames):
    return np.concatenate([frame.audio for frame in frames]) if frames else np.zeros(0, dtype=np.float32)


@settings(max_examples=15)
@given(st.sampled_from(RATES_HZ), st.sampled_from([0.01, 0.02, 0.0213, 0.1, 0.5, 1.0]), st.floats(0, 0.03))
def test_pieces_of_any_length_are_heard_whole_and_in_order(rate_hz, piece_s, jitter_s):
    """A ramp comes out as a ramp, however long and how unevenly its pieces come."""
    person, frames = Person(), []
    rng, n = np.random.default_rng(1), round(rate_hz * piece_s)
    for index in range(round(6.0 / piece_s)):
        frames += person.read((index + 1) * piece_s + rng.uniform(0, jitter_s))
        person.voice.hear((index * n + np.arange(n)) / rate_hz / 10, rate_hz)
    sound = [frame for frame in frames if len(frame.audio) and frame.time_s > 3.5]
    assert len(sound) == sum(frame.time_s > 3.5 for frame in frames) > 20
    steps = (heard(sound)[640:] - heard(sound)[:-640]) * 10 * 25
    assert 0.97 < steps.min() and steps.max() < 1.03
    assert person.source.statistics()["voice"]["delay_ms"] == pytest.approx(1e3 * n / rate_hz, abs=0.1)
    assert person.voice.latency_s < 0.08


@given(st.lists(st.one_of(st.floats(0, 0.5), st.integers(1, 4000), st.none()), max_size=40))
def test_the_grid_never_slips_and_every_frame_is_whole_or_empty(moves):
    person, now_s, frames = Person(), 0.0, []
    for move in moves:
        if move is None:
            person.sight.see(np.full(58, np.float32(0.5)))
        elif isinstance(move, int):
            person.voice.hear(np.full(move, 0.1), 16000)
        else:
            now_s += move
            frames += person.read(now_s)
    frames += person.read(now_s + 1.0)
    assert [round(frame.time_s * 25) for frame in frames] == list(range(1, len(frames) + 1))
    assert len(frames) >= int(now_s * 25 + 1e-6)
    assert all(frame.audio.shape in ((0,), (FRAME_SAMPLES,)) and frame.audio.dtype == np.float32 for frame in frames)


def test_bytes_integers_floats_and_channels_mean_the_same():
    pcm, outs = (np.sin(np.arange(3200) / 9) * 9000).astype(np.int16), []
    two = np.stack([pcm, pcm], axis=1)
    data, full = pcm.tobytes(), pcm / 32768
    ways = (data, bytearray(data), memoryview(data), pcm, full, full.tolist(), two, two.T, full[None])
    for way in (*ways, full.astype(np.float32)):
        person = Person()
        person.voice.hear(way, 16000)
        outs.append(heard(person.read(0.4)))
        np.testing.assert_allclose(outs[-1], outs[0], atol=5e-4)
    assert len(outs[0]) > 1280 and np.abs(outs[0]).max() == pytest.approx(9000 / 32768, abs=0.01)


@pytest.mark.parametrize(
    ("pcm", "rate_hz", "told"),
    [
        (np.zeros(9), 1, "rate_hz = 1: expected a rate"),
        (np.zeros(9), float("nan"), "rate_hz = nan"),
        (b"abc", 16000, "expected 16-bit samples, got 3 bytes"),
        (np.zeros(9, dtype=np.int64), 16000, "pcm is int64"),
        (np.zeros((2, 2, 2)), 16000, r"shape \(2, 2, 2\)"),
        (np.zeros((9, 9)), 16000, r"shape \(9, 9\): expected \(n, channels\) or \(channels, n\)"),
        (np.zeros((40, 480)), 16000, r"shape \(40, 480\): .* at most 32 channels"),
        (np.full(9, 8000.0), 16000, r"pcm: holds samples up to 8000, full scale is 1: .* by 32768"),
        (np.zeros(9), "16000", "rate_hz = '16000': expected a rate of speech"),
        (np.zeros(9, ">i2"), 16000, "pcm is >i2"),
        ("UklGRg==", 16000, "pcm is <U8"),
        (None, 16000, "pcm is object"),
        ((0, 1), 16000, "pcm is int64"),
    ],
)
def test_what_is_no_sound_is_refused_and_leaves_no_trace(pcm, rate_hz, told):
    person = Person()
    for push in (person.voice.hear, person.speech.say):
        with pytest.raises(ConfigError, match=told):
            push(pcm, rate_hz)
    (frame,) = person.read(0.1)
    assert not len(frame.audio) and frame.agent_audio is None


def test_what_is_not_finite_becomes_silence_and_is_counted():
    person = Person()
    person.speech.say(np.r_[np.full(638, 0.5), np.nan, np.inf], 16000)
    person.voice.hear(np.full(1600, np.nan), 16000)
    frame = person.read(0.4)[0]
    assert frame.agent_audio[:638].all() and not frame.agent_audio[638:].any() and not frame.audio.any()
    told = person.source.statistics()
    assert (told["agent_audio"]["not_finite"], told["voice"]["not_finite"]) == (2, 1600)


def test_a_caller_that_is_faster_than_time_fills_no_memory_and_delays_only_until_a_pause():
    person = Person()
    for _ in range(20):
        person.voice.hear(np.full(48000, 0.1), 16000)
        person.voice.hear(np.full(16000, 0.1), 16000)
    assert person.voice.statistics()["delay_ms"] == 1000.0
    frames = person.read(5.0)
    assert 16000 - 1280 <= np.count_nonzero(heard(frames)) <= 16000 + 1280
    assert person.source.statistics()["voice"]["dropped"] == 20 * 32000
    person.voice.hear(np.zeros(320), 16000)
    assert person.voice.statistics()["delay_ms"] == 20.0


def test_bursts_are_named_and_then_heard_whole(caplog):
    person, frames = Person(), []
    for burst in range(30):
        frames += person.read(burst * 0.4)
        for piece in range(20):
            person.voice.hear((burst * 6400 + piece * 320 + np.arange(320)) / 250_000, 16000)
    sound = heard(frames[125:])
    assert len(sound) == 640 * len(frames[125:]) and np.diff(sound) == pytest.approx(1 / 250_000, abs=1e-5)
    (said,) = caplog.records
    assert said.getMessage().startswith("hear(): sound comes in bursts, up to 400 ms apart")


def test_a_face_holds_for_a_quarter_of_a_second_and_can_be_lost():
    person = Person()
    person.sight.see(FaceFrame(123.0, np.ones(6, dtype=np.float32), np.full(52, 0.5, dtype=np.float32)))
    source = PairedSource(None, person.sight)
    faces = [frame.face for frame in source.read(0.4)]
    assert [face is not None for face in faces] == [n / 25 <= FACE_S for n in range(1, 11)]
    assert faces[0].time_s == 0.0 and faces[2].time_s == 0.0  # when it was seen
    person.now_s = 100.42
    person.sight.see(np.zeros(58))
    person.now_s = 100.47
    person.sight.see(None)
    assert [frame.face is not None for at_s in (0.445, 0.52) for frame in source.read(at_s)] == [True, False, False]
    with pytest.raises(ConfigError, match=r"face has the shape \(52,\)"):
        person.sight.see(np.zeros(52))
    with pytest.raises(ConfigError, match=r"shape \(1, 58\)"):
        person.sight.see(np.zeros((1, 58)))


def test_a_face_by_names_is_seen_and_one_in_other_units_is_refused():
    person = Person()
    person.sight.see({"eyeBlink_L": 0.5, "JawOpen": 0.25, "head_yaw": 0.1})
    face = person.sight.at(0.0).face
    assert face.motion[[2, 6 + 8]].tolist() == pytest.approx([0.1, 0.5]) and np.count_nonzero(face.motion) == 3
    for wrong, told in (
        ({"jawOpne": 1.0}, "'jawOpne' is not a channel; did you mean 'jawOpen'"),
        ({"yaw": 20.0}, r"yaw: expected radians \(in degrees\?\), got 20"),
        (np.full(58, np.nan), "roll is not finite"),
    ):
        with pytest.raises(ConfigError, match=told):
            person.sight.see(wrong)
    assert person.sight.at(0.0).face is not None


def played(speech, frames):
    """What is played in so many frames from the start on."""
    return np.concatenate([speech.take(index) for index in range(frames)])


@given(st.sampled_from(RATES_HZ), st.lists(st.integers(1, 9000), min_size=1, max_size=12), st.integers(0, 9))
def test_what_the_robot_says_comes_out_as_the_sound_resampled_at_once(rate_hz, sizes, seed):
    """A frame after the first call, whatever its pieces, behind one another without a gap."""
    samples = np.random.default_rng(seed).uniform(-1, 1, sum(sizes)).astype(np.float32)
    speech, pushed = PushedSpeech(lambda: 100.0), 0
    speech.start(100.04)
    for size in sizes:
        speech.say(samples[pushed : pushed + size], rate_hz)
        pushed += size
    whole = samples if rate_hz == 16000 else soxr.resample(samples, rate_hz, 16000, quality="HQ")
    out = played(speech, len(whole) // 640 + 3)
    np.testing.assert_array_equal(out[: len(whole)], np.clip(whole, -1, 1))
    assert not out[len(whole) :].any()


def test_a_robot_that_has_not_spoken_has_no_track_and_one_that_has_is_silent_after():
    """Said at 0.1 s, it is played at 0.14 s: in the second half of the frame that begins at 0.12 s."""
    person = Person(duration_s=2.0)
    assert [frame.agent_audio for frame in person.read(0.1)] == [None]
    person.speech.say(np.full(640, 0.5), 16000)
    before, one, two, *after = person.read(5.0)
    assert not before.agent_audio.any()
    assert (one.time_s, two.time_s, after[-1].time_s) == (0.12, 0.16, 2.0) and not person.read(9.0)
    assert not one.agent_audio[:320].any() and one.agent_audio[320:].all()
    assert two.agent_audio[:320].all() and not two.agent_audio[320:].any()
    assert not any(frame.agent_audio.any() for frame in after)


@given(st.integers(-3000, 60_000), st.sampled_from([16000, 24000, 48000]))
def test_speech_is_placed_at_the_sample_at_which_it_is_played(after, rate_hz):
    speech = PushedSpeech(lambda: 100.0)
    speech.start(100.0)
    speech.say(np.full(rate_hz // 10, 0.5), rate_hz, 100.0 + after / 16000)
    out = played(speech, 110)
    assert abs(int((out > 0.25).argmax()) - max(after, 0)) <= 1 or not (out > 0.25).any() and after <= -1600
    assert np.count_nonzero(out > 0.25) == pytest.approx(max(0, 1600 + min(after, 0)), abs=2)


def test_a_piece_near_the_end_of_the_last_follows_it_and_one_further_off_is_where_it_says():
    speech = PushedSpeech(lambda: 0.0)
    for at_s in (0.1, 0.215, 0.285, 0.5):
        speech.say(np.full(1600, 0.5), 16000, at_s)
    sounds = np.flatnonzero(np.diff(np.r_[0, played(speech, 25) != 0, 0].astype(int)))
    assert sounds.tolist() == [1600, 6400, 8000, 9600]


@pytest.mark.parametrize("hushed", [False, True])
def test_an_earlier_time_and_a_hush_replace_the_rest(hushed):
    now_s = 0.0
    speech = PushedSpeech(lambda: now_s)
    speech.say(np.full(32000, 0.5), 16000)  # a frame after this call, and for 2 s
    now_s = 0.26
    if hushed:
        speech.hush()
    speech.say(np.full(800, -0.5), 16000, None if hushed else 0.3)
    out = played(speech, 60)
    assert (out[640:4160] == 0.5).all() and (out[4160:4800] == (0.0 if hushed else 0.5)).all()
    assert (out[4800:5600] == -0.5).all() and not out[5600:].any()


@given(st.lists(st.floats(0, 0.015), min_size=50, max_size=50), st.sampled_from([16000, 24000]))
def test_a_voice_that_is_streamed_as_it_is_played_has_no_gaps(lates_s, rate_hz):
    """Pieces of 20 ms that come up to 15 ms late, frames taken when they are due: no silence between them."""
    now_s, out = 0.0, []
    speech = PushedSpeech(lambda: now_s)
    for index, late_s in enumerate(lates_s):
        now_s = index * 0.02 + late_s
        speech.say(np.full(rate_hz // 50, 0.5), rate_hz)
        if index % 2:
            now_s = (index + 1) * 0.02
            out.append(speech.take(len(out)))
    sound = np.concatenate(out)
    first = int((sound > 0.25).argmax())
    assert first <= 640 + 240 and (sound[first + 32 :] > 0.1).all()


def test_speech_too_far_ahead_and_speech_after_its_time_are_left_out_and_counted(monkeypatch):
    monkeypatch.setattr("sfms_robot.sources.push.SAID_S", 0.08)
    speech = PushedSpeech(lambda: 0.0)
    speech.say(np.r_[np.full(640, 0.1), np.full(1280, 0.2)], 16000)
    out = played(speech, 5)
    assert (out[640:1280] == np.float32(0.1)).all() and not out[1280:].any()
    assert speech.statistics() == {"dropped": 1280, "late": 0, "not_finite": 0}
    speech = PushedSpeech(lambda: 0.0)
    speech.say(np.full(640, 0.5), 16000, 0.0)
    assert speech.take(0).all()
    speech.say(np.full(1280, -0.5), 16000, 0.01)
    assert (np.flatnonzero(speech.take(1)) == np.arange(640)).all() and speech.statistics()["late"] == 480
    with pytest.raises(ConfigError, match="at_s = nan: expected a finite time"):
        speech.say(np.zeros(9), 16000, float("nan"))


def test_a_voice_with_times_is_placed_by_them():
    """A click that was heard at 1.0 s is at 1.0 s, whenever its piece came."""
    person, frames = Person(), []
    for index in range(40):
        sound = np.zeros(1600, np.float32)
        sound[0] = index == 10
        person.now_s = 100.0 + (index + 1) * 0.1 + 0.03 * (index % 3)
        person.voice.hear(sound, 16000, 100.0 + (index + 1) * 0.1)
        frames += person.read(person.now_s - 100.0)
    whole = np.concatenate([frame.audio if len(frame.audio) else np.zeros(640) for frame in frames])
    assert abs(int(np.abs(whole).argmax()) - 16000) <= 16


def test_calls_may_come_from_any_thread():
    person = Person()

    def speak() -> None:
        for _ in range(50):
            person.voice.hear(np.full(160, 0.25), 16000)
            person.speech.say(np.full(160, 0.25), 16000)
            person.sight.see(np.zeros(58))

    with ThreadPoolExecutor(4) as threads:
        speakers = [threads.submit(speak) for _ in range(4)]
        frames = [frame for n in range(1, 20) for frame in person.source.read(n / 25)]
    assert not any(each.exception() for each in speakers)
    frames += person.source.read(20.0)
    said = np.concatenate([frame.agent_audio for frame in frames if frame.agent_audio is not None])
    assert np.count_nonzero(said) + person.speech.statistics()["late"] == 4 * 50 * 160
