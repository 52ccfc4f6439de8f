"""Stream equals offline, later sound changes nothing before it, gain changes nothing at all."""

from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.frames import FRAME_S, FRAME_SAMPLES
from sfms_robot.signals import mel, phase, voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.signals.phase import GAP_FRAMES, SILENCE_KNOTS_S, SPEECH_KNOTS_S, SpeechPhase


def speech(seed=0, noise_db=-60.0, pattern=((0, 30), (1, 100), (0, 40), (1, 60), (0, 90))):
    """Swelling noise where the pattern says 1, over a noise floor; (n,) samples and truth (N,)."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate([np.full(frames, bool(on)) for on, frames in pattern])
    level = np.repeat(truth * rng.uniform(0.05, 0.2, len(truth)), FRAME_SAMPLES)
    audio = (level + 10 ** (noise_db / 20)) * rng.standard_normal(len(level))
    return np.clip(audio, -1, 1).astype(np.float32), truth


def step(frame, state):
    (row,), (after,) = phase.step_each([[energy_db(frame)]], [state])
    return row, after


def streamed(audio):
    state, rows = phase.start(), []
    for frame in audio[: len(audio) // FRAME_SAMPLES * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES):
        row, state = step(frame, state)
        rows.append(row)
    return np.array(rows)


@pytest.mark.parametrize("seed", range(3))
def test_streaming_equals_offline(seed):
    audio, _ = speech(seed)
    np.testing.assert_array_equal(streamed(audio), phase.of_audio(audio))


@pytest.mark.parametrize("gain", [0.1, 1.0, 4.0])
@pytest.mark.parametrize("noise_db", [-75, -45])
def test_speech_is_told_from_noise_as_it_comes(gain, noise_db):
    audio, truth = speech(noise_db=noise_db)
    heard = phase.hear(voice_activity.levels_db(np.asarray(gain * audio, np.float32)))
    assert (np.array(heard) == truth).mean() > 0.95


def test_samples_and_mel_rows_tell_the_same_story_and_hum_is_forgotten_within_a_minute():
    audio, truth = speech()
    rows, _ = mel.log_mel(audio, mel.start())
    heard = phase.hear(voice_activity.mel_levels_db(rows[: 4 * len(truth)].reshape(-1, 4, mel.MEL_BINS)))
    assert (np.array(heard) == truth[: len(heard)]).mean() > 0.95
    hum = 0.02 * np.random.default_rng(0).standard_normal(75 * 16_000)
    heard = phase.hear(voice_activity.levels_db(hum.astype(np.float32)))
    assert not any(heard[-15 * 25 :])


@pytest.mark.parametrize("level", [-100.0, float("nan"), float("-inf"), float("inf")])
def test_silence_and_nonsense_are_not_speech(level):
    state = phase.start()
    for _ in range(50):
        (row,), (state,) = phase.step_each([[level]], [state])
        assert np.isfinite(row).all()
    assert state.phase == SpeechPhase(0, 50, 0)


@given(st.lists(st.booleans(), max_size=120))
def test_times_are_those_of_the_pattern(active):
    """Against the plain definition, counted from scratch at the last frame."""
    if not active:
        assert phase.times(active).shape == (0, 3)
        return
    joined = "".join("x" if on else "." for on in active)
    trailing = len(joined) - len(joined.rstrip("."))
    phrases = [inside for piece in joined.split("." * GAP_FRAMES) if (inside := piece.strip("."))]
    ongoing = bool(phrases) and trailing < GAP_FRAMES
    expected_speech = len(phrases[-1]) + trailing if ongoing else 0
    done = phrases[:-1] if ongoing else phrases
    expected_last = len(done[-1]) if done else 0
    speech_s, silence_s, last_s = phase.times(active)[-1] / FRAME_S
    stream = [*accumulate(active, SpeechPhase.after, initial=SpeechPhase())][1:]
    np.testing.assert_allclose(phase.times(active), [one.times_s for one in stream], atol=1e-9)
    assert (round(speech_s), round(silence_s), round(last_s)) == (expected_speech, trailing, expected_last)


@given(st.floats(0, 100), st.floats(0, 100), st.floats(0, 100))
def test_hats_add_up_to_one_and_reproduce_knots(speech_s, silence_s, last_s):
    row = phase.features(np.array([[speech_s, silence_s, last_s]]))[0]
    a, b = len(SPEECH_KNOTS_S), len(SPEECH_KNOTS_S) + len(SILENCE_KNOTS_S)
    assert row.min() >= 0 and row[:a].sum() == pytest.approx(float(speech_s > 0), abs=1e-6)
    assert row[a:b].sum() == pytest.approx(1, abs=1e-6)
    assert row[b:].sum() == pytest.approx(float(last_s > 0), abs=1e-6)
