"""Events are found where they are, and the phrase-end ratio of chance is 1."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.lab.evaluation.phrase_timing import (
    find_gaze_shifts,
    listening_mask,
    near,
    nods_per_minute,
    phrase_end_ratio,
    phrase_ends,
    rank_auc,
    voice_activity,
)
from sfms_robot.signals.events import find_blinks, find_nods, find_smiles, runs

RATE = 25


def still(seconds):
    return np.zeros(int(seconds * RATE))


def nod(pitch, start_s, cycles, hz, peak_to_peak_deg):
    """Adds a nod: nose down first, back to where it was."""
    times = np.arange(len(pitch)) / RATE - start_s
    inside = (times >= 0) & (times <= cycles / hz)
    return pitch + np.deg2rad(peak_to_peak_deg) * inside * (0.5 - 0.5 * np.cos(2 * np.pi * hz * times))


@given(
    start=st.floats(2, 7),
    cycles=st.integers(1, 4),
    hz=st.floats(1.6, 3.8),
    size=st.floats(3, 12),
    sign=st.sampled_from([-1, 1]),
)
def test_a_nod_is_found_once_when_and_as_large_as_it_is(start, cycles, hz, size, sign):
    found = find_nods(sign * nod(still(12), start, cycles, hz, size), RATE)
    assert len(found) == 1
    begin, end, amplitude = found[0]
    assert abs(begin - start) < 0.25
    assert abs(end - (start + cycles / hz)) < 0.4
    assert np.rad2deg(amplitude) == pytest.approx(size, rel=0.25)


def test_nods_far_apart_are_two():
    assert len(find_nods(nod(nod(still(10), 2, 1, 2, 5), 5, 2, 2.5, 4), RATE)) == 2


def test_a_nod_on_a_moving_head_is_found():
    times = np.arange(20 * RATE) / RATE
    drift = np.deg2rad(4) * np.sin(2 * np.pi * 0.15 * times)
    assert len(find_nods(nod(drift, 8, 2, 2.2, 5), RATE)) == 1


@pytest.mark.parametrize("hz", [0.05, 0.2, 0.4])
def test_slow_drift_is_no_nod(hz):
    times = np.arange(30 * RATE) / RATE
    assert find_nods(np.deg2rad(8) * np.sin(2 * np.pi * hz * times), RATE) == []


@pytest.mark.parametrize("size_deg", [4, 8, 15])
def test_a_look_down_and_back_after_two_seconds_is_no_nod(size_deg):
    step = np.deg2rad(size_deg) * np.r_[np.zeros(100), np.ones(50), np.zeros(100)]
    kernel = np.hanning(14) / np.hanning(14).sum()
    assert find_nods(np.convolve(step, kernel, "same"), RATE) == []


def test_tremor_below_a_degree_and_a_half_is_no_nod():
    assert find_nods(nod(still(10), 3, 3, 2.5, 1.2), RATE) == []


def test_too_short_a_track_holds_no_nods():
    assert find_nods(still(0.5), RATE) == []


@given(frame=st.integers(1, 98), frames=st.integers(1, 8))
def test_a_blink_of_any_length_anywhere_is_found(frame, frames):
    lids = np.full(120, 0.1)
    lids[frame : frame + frames] = 0.9
    found = find_blinks(lids, RATE)
    assert len(found) == 1
    assert found[0][0] <= frame / RATE <= found[0][1] + 1 / RATE


def test_eyes_shut_for_a_second_are_no_blink():
    assert find_blinks(np.r_[np.zeros(30), np.ones(25), np.zeros(30)], RATE) == []


def test_two_blinks_in_a_row_are_two():
    lids = np.zeros(50)
    lids[[10, 11, 18, 19]] = 0.8
    assert len(find_blinks(lids, RATE)) == 2


def test_a_smile_is_found_and_a_twitch_is_not():
    level = np.zeros(200)
    level[50:90] = 0.5
    level[150:154] = 0.5
    assert find_smiles(level, RATE) == [(2.0, 3.6, 0.5)]


@given(st.lists(st.booleans(), max_size=40))
def test_runs_cover_exactly_what_is_true(mask):
    again = np.zeros(len(mask), bool)
    for start, end in runs(mask):
        again[start:end] = True
    assert again.tolist() == mask


def test_a_phrase_ends_where_a_fifth_of_a_second_of_silence_follows():
    voice = np.zeros(100, bool)
    voice[10:30] = voice[34:50] = voice[55:80] = True  # gaps of 4 and 5 frames
    assert phrase_ends(voice, RATE).tolist() == [2.0, 3.2]


def test_silence_before_the_first_word_ends_no_phrase():
    assert phrase_ends(np.r_[np.zeros(20, bool), np.ones(20, bool)], RATE).tolist() == []


def test_listening_lasts_two_seconds_after_the_last_word_and_not_while_speaking():
    other = np.zeros(200, bool)
    other[20:40] = True
    own = np.zeros(200, bool)
    own[60:70] = True
    assert np.flatnonzero(listening_mask(other, RATE, own)).tolist() == [*range(20, 60), *range(70, 90)]


def test_rate_counts_only_listening_time():
    listening = np.r_[np.ones(60 * RATE, bool), np.zeros(60 * RATE, bool)]
    assert nods_per_minute([1.0, 30.0, 90.0], listening, RATE) == 2.0


def test_rate_without_listening_is_nan():
    assert np.isnan(nods_per_minute([1.0], still(5) > 0, RATE))


def test_ratio_of_onsets_everywhere_is_one():
    every_frame = np.arange(0, 600 * RATE) / RATE
    ends = np.arange(5, 590, 10.0)
    assert phrase_end_ratio(every_frame, ends, np.ones(600 * RATE, bool), RATE) == pytest.approx(1)


@given(seed=st.integers(0, 2**32 - 1))
def test_ratio_of_random_onsets_is_near_one(seed):
    rng = np.random.default_rng(seed)
    length_s = 20_000
    ends = np.sort(rng.uniform(0, length_s, 2000))
    ratio = phrase_end_ratio(rng.uniform(0, length_s, 40_000), ends, np.ones(length_s * RATE, bool), RATE)
    assert 0.85 < ratio < 1.18


def test_ratio_of_nods_right_after_phrase_ends_is_large():
    ends = np.arange(5, 590, 10.0)
    onsets = np.r_[ends + 0.4, ends[::4] + 2]
    ratio = phrase_end_ratio(onsets, ends, np.ones(600 * RATE, bool), RATE)
    assert ratio == pytest.approx(4 * 1.5 / 0.8, rel=0.1)


@pytest.mark.parametrize("gain", [0.02, 0.2, 1.0])
@pytest.mark.parametrize("noise_db", [-80, -30])
def test_speech_is_told_from_noise_at_any_gain(gain, noise_db):
    rng = np.random.default_rng(0)
    truth = np.repeat([False, True, False, True, False], [25, 100, 15, 50, 40])
    swell = np.repeat(truth * rng.uniform(0.15, 0.5, len(truth)), 640)
    audio = gain * (swell + 10 ** (noise_db / 20)) * rng.standard_normal(len(swell))
    assert (voice_activity(audio) == truth).mean() > 0.97


def test_digital_silence_and_nothing_are_not_speech():
    assert not voice_activity(np.zeros(16_000)).any()
    assert len(voice_activity(np.zeros(100))) == 0


@given(
    st.lists(st.integers(0, 5), min_size=1, max_size=20),
    st.lists(st.integers(0, 5), min_size=1, max_size=20),
)
def test_auc_is_the_chance_that_a_positive_scores_higher(positive, negative):
    scores = np.array(positive + negative, float)
    index = np.arange(len(scores))
    pairs = [(p > n) + 0.5 * (p == n) for p in positive for n in negative]
    found = rank_auc(scores, index[: len(positive)], index[len(positive) :])
    assert found == pytest.approx(np.mean(pairs))
    assert rank_auc(-scores, index[: len(positive)], index[len(positive) :]) == pytest.approx(1 - found)


def test_auc_of_one_kind_alone_is_nan():
    assert np.isnan(rank_auc([1.0, 2.0], [True, True], [False, False]))


def test_near_is_as_wide_as_it_is_told():
    assert np.flatnonzero(near([(2.0, 3.0)], 200, RATE, 0.2)).tolist() == list(range(45, 81))
    assert np.flatnonzero(near([(0.0, 0.1), (7.9, 9.0)], 200, RATE, 0.04)).tolist() == [0, 1, 2, 3, *range(197, 200)]
    assert not near(np.zeros((0, 2)), 200, RATE, 1.0).any()


@given(start=st.floats(1, 7), size=st.floats(0.2, 0.7), angle=st.floats(0, 6.28))
def test_a_glance_is_two_shifts_where_it_begins_and_ends(start, size, angle):
    away = np.zeros(10 * RATE)
    away[round(start * RATE) : round((start + 1.5) * RATE)] = size
    found = find_gaze_shifts(np.cos(angle) * away, np.sin(angle) * away, RATE)
    assert found == pytest.approx([start, start + 1.5], abs=0.2)


def test_small_wandering_and_slow_turns_are_no_gaze_shifts():
    rng = np.random.default_rng(0)
    wander = np.repeat(rng.normal(0, np.deg2rad(0.7), 40), RATE // 2)
    turn = np.deg2rad(60) * np.linspace(0, 1, len(wander))
    assert find_gaze_shifts(wander + turn, wander, RATE) == []
    assert find_gaze_shifts(np.zeros(5), np.zeros(5), RATE) == []
