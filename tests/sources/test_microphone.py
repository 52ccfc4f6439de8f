"""Pieces of a microphone in, frames of the loop out; time is an argument."""

from types import SimpleNamespace

import numpy as np
import pytest

from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES
from sfms_robot.signals.echo import ECHO_LATENCY_SAMPLES
from sfms_robot.sources.live_voice import LiveVoice
from sfms_robot.sources.microphone import LINES, LONGEST_WAIT_S, REFERENCE_WAIT_S, FrontEnd, Microphone, SpeechFrames

ORIGIN_S = 1000.0
PIECE_S = 0.01
CLOSE = 0.05  # of a tone of 0.2 at 300 Hz: two samples


def tone(time_s):
    return (0.2 * np.sin(2 * np.pi * 300 * time_s)).astype(np.float32)


def record(front_end, seconds, rate_hz=AUDIO_HZ, tell=None, begins_s=-0.2):
    """Frames of a tone that began before the loop, in pieces of 10 ms."""
    frames = []
    front_end.start(ORIGIN_S, ORIGIN_S)
    for piece in range(round((seconds - begins_s) / PIECE_S)):
        end_s = begins_s + (piece + 1) * PIECE_S
        times_s = end_s - (np.arange(round(rate_hz * PIECE_S))[::-1] + 1) / rate_hz
        front_end.mic.push(tone(times_s), rate_hz, ORIGIN_S + end_s)
        if tell is not None:
            tell(end_s)
        frames += front_end.frames(ORIGIN_S + end_s)
    return frames


def silence_until(speech, ahead_s=0.05):
    def tell(now_s):
        known = max(0, int((now_s + ahead_s) / FRAME_S))
        speech.set(max(0, known - 12), np.zeros(min(known, 12) * FRAME_SAMPLES, np.float32))

    return tell


def deviation(frames):
    """How far frames are from the tone of their own time."""
    times_s = [frame.index * FRAME_S + np.arange(FRAME_SAMPLES) / AUDIO_HZ for frame in frames]
    return np.abs(np.concatenate([frame.audio for frame in frames]) - tone(np.concatenate(times_s))).max()


@pytest.mark.parametrize("rate_hz", [8_000, 16_000, 44_100, 48_000, 192_000])
@pytest.mark.parametrize("reference", [False, True])
def test_frames_are_those_of_the_loop_with_and_without_echo_cancellation(rate_hz, reference):
    speech = SpeechFrames() if reference else None
    frames = record(FrontEnd(speech), 1.0, rate_hz, silence_until(speech) if speech else None)
    assert [frame.index for frame in frames] == list(range(len(frames))) and len(frames) >= 23
    assert deviation(frames[1:]) < CLOSE


@pytest.mark.parametrize("begins", [0, 2500])
def test_a_frame_waits_for_its_microphone_no_longer_than_the_loop_does(begins):
    """A worker that begins late begins with the frame of that moment."""
    front_end = FrontEnd()
    front_end.start(ORIGIN_S, ORIGIN_S + begins * FRAME_S)
    assert front_end.frames(ORIGIN_S + (begins + 10) * FRAME_S) == []
    assert front_end._next == begins + 10 - round(LONGEST_WAIT_S / FRAME_S + 0.5)


def test_a_frame_whose_reference_does_not_come_is_given_without_and_counted():
    front_end = FrontEnd(SpeechFrames())
    frames = record(front_end, 1.0)
    assert frames and deviation(frames[1:]) < CLOSE
    late_s = [frame.known_s - ORIGIN_S - (frame.index + 1) * FRAME_S for frame in frames]
    assert min(late_s) >= REFERENCE_WAIT_S - 1e-9
    assert front_end.statistics()["without_reference"] == len(frames)


def test_a_device_that_records_the_loudspeaker_is_told_beside_the_microphone():
    reference = LiveVoice()
    front_end = FrontEnd(reference)

    def tell(now_s):
        times_s = now_s - np.arange(480)[::-1] / 48_000
        reference.push(tone(times_s + 0.001), 48_000, ORIGIN_S + now_s)

    frames = record(front_end, 1.0, tell=tell)
    assert all(frame.said is not None and frame.said.any() for frame in frames[2:])
    told = front_end.statistics()
    assert told["own_voice_frames"] >= len(frames) - 2 and "drift_ppm" in told["reference"]


@pytest.mark.parametrize("first", [0, 3])
def test_told_speech_is_given_as_late_as_the_echo_canceller_needs_it(first):
    said = np.random.default_rng(0).normal(size=8 * FRAME_SAMPLES).astype(np.float32)
    speech = SpeechFrames()
    speech.set(first, said)
    taken = [speech.take(index) for index in range(first, first + 7)]
    np.testing.assert_array_equal(np.concatenate(taken), said[ECHO_LATENCY_SAMPLES:][: 7 * FRAME_SAMPLES])
    assert speech.take(first + 7) is None
    if first:
        assert not speech.take(0).any()


def test_what_is_no_voice_is_turned_down_while_joints_move_and_passes_while_they_stand():
    levels = []
    for speed_rad_s in (0.0, 5.0):
        front_end = FrontEnd()
        front_end.speed_rad_s = speed_rad_s
        frames = record(front_end, 1.0)
        levels.append(np.abs(np.concatenate([frame.audio for frame in frames[5:]])).max())
    assert levels[0] > 0.15 and levels[1] < 0.01


def test_what_is_wrong_with_a_device_is_logged_once_in_the_run(caplog):
    slow = {"mix": "", "pace": "cheap: gives 0.90 s of sound a second"}
    told = ["cheap", {"pace": 0.9, LINES: slow}, {"pace": 0.91, LINES: {**slow, "pace": "cheap: gives 0.91 s"}}]
    sent = iter([told])
    microphone = Microphone(SimpleNamespace(messages=lambda now_s: next(sent, []), statistics=dict))
    assert [record.getMessage() for record in caplog.records] == [f"{slow['pace']} (said once)"]
    assert microphone.statistics()["pace"] == 0.91 and LINES not in microphone.statistics()
