"""A live voice keeps the time of the loop: drift, jitter, gaps, any pieces, rates and channels."""

import tracemalloc

import numpy as np
import pytest
import soxr
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES
from sfms_robot.sources.live_voice import LiveVoice, Pace, SampleClock
from sfms_robot.sources.paired import LONGEST_WAIT_S

ORIGIN_S = 5000.0
TONE_HZ = 10.0  # its phase tells the time within 50 ms either way


class Card:
    """A sound card with a clock of its own, whose callbacks come late by up to `jitter_s`."""

    def __init__(self, rate_hz, ppm=0.0, jitter_s=0.0, seed=0, tone_hz=TONE_HZ):
        self.rate_hz, self.true_hz = rate_hz, rate_hz * (1 + ppm * 1e-6)
        self.jitter_s, self.tone_hz = jitter_s, tone_hz
        self.rng, self.count, self.away_s, self.called_s = np.random.default_rng(seed), 0, 0.0, 0.0

    def piece(self, n, late_s=0.0):
        """Samples, and the time of the callback in loop time."""
        times_s = (self.count + 1 + np.arange(n)) / self.true_hz + self.away_s
        self.count += n
        self.called_s = max(self.called_s, times_s[-1] + late_s + self.rng.uniform(0, self.jitter_s))
        return (0.5 * np.sin(2 * np.pi * self.tone_hz * times_s)).astype(np.float32), self.called_s


def played(card, sizes, seconds, away=None, wait_s=LONGEST_WAIT_S):
    """Frames of a voice that is taken from as `PairedSource` does: None where the longest wait was in vain."""
    voice, frames = LiveVoice(), []
    voice.start(ORIGIN_S)
    while len(frames) < seconds * 25:
        sound, called_s = card.piece(next(sizes))
        while (len(frames) + 1) / 25 + wait_s < called_s:
            frames.append(voice.take(len(frames)))
        voice.push(sound, card.rate_hz, ORIGIN_S + called_s)
        if away and called_s > away[0]:
            card.away_s, away = away[1], None
    return voice, frames[: round(seconds * 25)]


def pieces(size):
    while True:
        yield size


def offsets_s(frames, first):
    """How far each frame from `first` on is from the time it should hold."""
    found = []
    for index, frame in enumerate(frames[first:], first):
        times_s = index / 25 + np.arange(FRAME_SAMPLES) / 16000
        both = np.stack([np.sin(2 * np.pi * TONE_HZ * times_s), np.cos(2 * np.pi * TONE_HZ * times_s)], axis=1)
        a, b = np.linalg.lstsq(both, frame, rcond=None)[0]
        found.append(np.arctan2(b, a) / (2 * np.pi * TONE_HZ))
    return np.array(found)


@settings(max_examples=8)
@given(
    st.sampled_from([8000, 16000, 44100, 48000]), st.floats(-200, 200), st.sampled_from([0.003, 0.01, 0.0213, 0.06]),
    st.floats(0, 0.03), st.integers(0, 99),
)  # fmt: skip
@example(48000, 0.0, 0.003, 0.03, 95)
def test_whatever_the_card_frames_are_in_their_time(rate_hz, ppm, piece_s, jitter_s, seed):
    """From 5 s on: a stretch is first placed within 10 ms, and jitter of the first second fades by 1/e a second."""
    # Of pieces far shorter than the jitter nearly each waits for one before it: a quarter of the jitter stays.
    limit_s = max(0.005, jitter_s / 3) if jitter_s > 3 * piece_s else 0.005
    voice, frames = played(Card(rate_hz, ppm, jitter_s, seed), pieces(max(1, int(piece_s * rate_hz))), 20)
    assert not any(frame is None for frame in frames[3:]) and np.abs(offsets_s(frames, 125)).max() < limit_s
    assert voice.statistics()["gaps"] == 0 and voice.latency_s < LONGEST_WAIT_S


@pytest.mark.slow
@pytest.mark.parametrize("ppm", [-200, 200])
def test_ten_minutes_of_drift_cost_no_frame_and_no_time(ppm):
    voice, frames = played(Card(16000, ppm, 0.03), pieces(320), 600)
    assert not any(frame is None for frame in frames[3:]) and np.abs(offsets_s(frames, 75)).max() < 0.005
    assert voice.statistics()["drift_ppm"] == pytest.approx(ppm, abs=20)


@settings(max_examples=10)
@given(st.lists(st.integers(50, 1600), min_size=5, max_size=50), st.integers(0, 99))
def test_pieces_may_have_any_length(sizes, seed):
    rng = np.random.default_rng(seed)
    _, frames = played(Card(16000, 100, 0.01, seed), iter(lambda: int(rng.choice(sizes)), None), 10)
    assert not any(frame is None for frame in frames[8:]) and np.abs(offsets_s(frames, 100)).max() < 0.005


@pytest.mark.parametrize("rate_hz", [8000, 22050, 96000, 192000])
def test_a_tone_stays_a_tone(rate_hz):
    """No clicks: all but the tone, at whatever frequency it comes out, is 60 dB below it."""
    _, frames = played(Card(rate_hz, 200, 0.03, tone_hz=1000.0), pieces(rate_hz // 100), 12)
    sound = np.concatenate(frames[200:])
    spectrum = np.abs(np.fft.rfft(sound * np.blackman(len(sound)))) ** 2
    at = np.fft.rfftfreq(len(sound), 1 / 16000)
    near = np.abs(at - 1000.0) < 20.0  # a correction of a percent for a moment is 10 Hz
    assert spectrum[~near].sum() < 1e-6 * spectrum[near].sum()
    if rate_hz > 16000:  # what 16 kHz cannot hold is filtered out
        _, frames = played(Card(rate_hz, tone_hz=9500.0), pieces(rate_hz // 100), 2)
        assert np.abs(np.concatenate(frames[30:])).max() < 0.002


class FixedRate:
    """`soxr.ResampleStream` of soxr 1.0, whose rate cannot be changed."""

    def __init__(self, rate_hz, *args, dtype, quality, made=soxr.ResampleStream):
        self.resample_chunk = made(rate_hz, *args, dtype=dtype, quality=quality).resample_chunk


@pytest.mark.parametrize("ppm", [-200, 200])
def test_with_soxr_1_0_a_frame_is_at_most_10_ms_off_and_none_is_lost(ppm, monkeypatch):
    monkeypatch.setattr(soxr, "ResampleStream", FixedRate)
    voice, frames = played(Card(48000, ppm, 0.01), pieces(480), 120)
    assert not any(frame is None for frame in frames[3:]) and np.abs(offsets_s(frames, 100)).max() < 0.0105
    assert voice.statistics()["gaps"] == 0


@pytest.mark.parametrize("ppm", [-150, 150])
@pytest.mark.parametrize("away_s", [0.5, 3.0])
def test_a_device_that_was_away_costs_its_frames_and_no_other(ppm, away_s):
    voice, frames = played(Card(16000, ppm, 0.02, 3), pieces(320), 20, away=(8.0, away_s))
    missing = [index for index, frame in enumerate(frames) if frame is None and index > 2]
    assert len(missing) == pytest.approx(away_s * 25, abs=1) and missing[-1] - missing[0] == len(missing) - 1
    assert missing[0] == pytest.approx(8.0 * 25, abs=2) and voice.statistics()["gaps"] == 1
    assert np.abs(offsets_s(frames, missing[-1] + 75)).max() < 0.005


def test_one_callback_that_is_late_moves_nothing():
    card, voice, frames = Card(16000), LiveVoice(), []
    voice.start(ORIGIN_S)
    for index in range(1000):
        sound, called_s = card.piece(320, late_s=0.12 if index == 500 else 0.0)
        card.called_s = 0.0
        while (len(frames) + 1) / 25 + LONGEST_WAIT_S < called_s:
            frames.append(voice.take(len(frames)))
        voice.push(sound, 16000, ORIGIN_S + called_s)
    assert not any(frame is None for frame in frames) and np.abs(offsets_s(frames, 3)).max() < 0.0005


def test_what_was_held_up_and_comes_at_once_is_placed_where_it_belongs():
    card, voice = Card(16000), LiveVoice()
    voice.start(ORIGIN_S)
    for _ in range(900):
        sound, called_s = card.piece(320)
        voice.push(sound, 16000, ORIGIN_S + (12.0 if 10.0 < called_s <= 12.0 else called_s))
        voice.take(int((called_s - 0.2) * 25) if called_s > 0.2 else 0)
    frames = [voice.take(index) for index in range(446, 449)]
    assert np.abs(offsets_s([None] * 446 + frames, 446)).max() < 0.005


def test_samples_that_were_lost_are_noticed():
    """A card that lost 50 ms is in its time again when the corrections of 1 % have made up for them."""
    _, frames = played(Card(16000, 0, 0.005), pieces(160), 15, away=(6.0, 0.05))
    assert np.abs(offsets_s(frames, 340)).max() < 0.005


def test_what_was_heard_before_the_start_is_dropped_and_has_taught_the_clock():
    card, voice = Card(48000, 100, 0.02), LiveVoice()
    while card.called_s < 10.0:
        sound, called_s = card.piece(480)
        voice.push(sound, 48000, ORIGIN_S + called_s)
    start_s = 10.0  # a whole number of periods of the tone
    voice.start(ORIGIN_S + start_s)
    while card.called_s < 12.0:
        sound, called_s = card.piece(480)
        voice.push(sound, 48000, ORIGIN_S + called_s)
    frames = [voice.take(index) for index in range(40)]
    assert not any(frame is None for frame in frames) and np.abs(offsets_s(frames, 1)).max() < 0.002


def test_another_rate_begins_anew():
    voice, card, frames = LiveVoice(), Card(16000), []
    voice.start(ORIGIN_S)
    for rate_hz in (16000, 48000):
        card.count, card.rate_hz, card.true_hz = round(card.called_s * rate_hz), rate_hz, rate_hz
        for _ in range(100):
            sound, called_s = card.piece(rate_hz // 50)
            while (len(frames) + 1) / 25 + LONGEST_WAIT_S < called_s:
                frames.append(voice.take(len(frames)))
            voice.push(sound, rate_hz, ORIGIN_S + called_s)
    assert len(frames) > 90 and not any(frame is None for frame in frames)
    assert np.abs(offsets_s(frames, 55)).max() < 0.002
    with pytest.raises(ConfigError, match="rate_hz = 1: expected a rate"):
        voice.push(np.zeros(1, dtype=np.float32), 1, 0.0)


def test_a_voice_that_nobody_takes_fills_no_memory():
    card, voice = Card(16000), LiveVoice()
    voice.start(ORIGIN_S)
    for minute in range(2):
        if minute:
            tracemalloc.start()
        for _ in range(1000):
            sound, called_s = card.piece(960)
            voice.push(sound, 16000, ORIGIN_S + called_s)
    assert tracemalloc.get_traced_memory()[0] < 500_000
    tracemalloc.stop()


@given(st.floats(-1000, 1000), st.floats(0, 0.05), st.integers(0, 10**6), st.integers(0, 99))
def test_the_clock_is_the_line_under_all_callbacks(ppm, jitter_s, before, seed):
    clock, true_hz = SampleClock(16000), 16000 * (1 + ppm * 1e-6)
    for index, late in enumerate(np.random.default_rng(seed).uniform(0, jitter_s, 2000)):
        count = (index + 1) * 320
        late = 0.0 if index % 40 == 0 else late  # one in a while is in time
        clock.observe(count, before + count / true_hz + late)
    assert clock.drift_ppm == pytest.approx(ppm, abs=30)
    assert clock.time_s(640_000) == pytest.approx(before + 640_000 / true_hz, abs=0.001)
    assert clock.count_at(clock.time_s(1234)) == pytest.approx(1234, abs=0.01)


def problem_of(times_s, piece_s):
    pace = Pace()
    for time_s in times_s:
        pace.observe(piece_s, time_s)
    return pace.problem


@pytest.mark.parametrize("rate", [0.87, 0.97, 1.2])
@pytest.mark.parametrize("piece_s", [0.02, 0.5])
def test_sound_that_comes_at_another_rate_than_time_passes_is_named_with_the_rate(rate, piece_s):
    jitter = np.random.default_rng(0)
    times_s = np.arange(0, 20, piece_s / rate) + jitter.uniform(0, 0.01, len(np.arange(0, 20, piece_s / rate)))
    way = "falls behind" if rate < 1 else "is ahead"
    assert problem_of(times_s, piece_s) == (
        f"sound comes at {rate:.2f} of real time: its sender {way}; pace it by the clock"
    )


@pytest.mark.parametrize("together", [15, 40])
def test_sound_in_bursts_is_named_with_their_distance(together):
    times_s = [0.02 * together * (index // together) for index in range(1000)]
    expected = f"sound comes in bursts, up to {20 * together} ms apart: send it as it is recorded"
    assert problem_of(times_s, 0.02) == expected


@given(st.sampled_from([0.01, 0.02, 0.1, 1.0]), st.floats(0, 0.06), st.floats(-200, 200), st.integers(0, 99))
def test_sound_in_its_time_is_not_named_whatever_its_pieces_and_pauses(piece_s, jitter_s, ppm, seed):
    rng = np.random.default_rng(seed)
    times_s = np.arange(0, 30, piece_s) * (1 + ppm * 1e-6) + rng.uniform(0, jitter_s, len(np.arange(0, 30, piece_s)))
    assert problem_of(times_s, piece_s) is None
    talks = np.sin(times_s * 3.0) > -0.8  # a caller whose pauses are not sent
    assert problem_of(times_s[talks], piece_s) is None or piece_s > 0.5
