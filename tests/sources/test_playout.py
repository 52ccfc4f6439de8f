"""What leaves a loudspeaker at an instant is what is due then, whatever its device's clock does; silence is told."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES
from sfms_robot.sources.playback import Playout

ORIGIN_S = 1000.0
TONE_HZ = 40.0  # of which an instant can be told to a few milliseconds


def tone(samples):
    return np.sin(2 * np.pi * TONE_HZ / AUDIO_HZ * np.asarray(samples)).astype(np.float32)


class VirtualDevice:
    """A sound card with a clock of its own: what it is handed leaves sample by sample, `latency_s` later.

    Attributes:
        left_s, left: when each sample left, in loop time, and what it was.
    """

    def __init__(self, rate_hz, ppm=0.0, latency_s=0.06, begins_s=-0.5, jitter=None, says=tone):
        self.playout, self._says = Playout(rate_hz), says
        self._true_hz = rate_hz * (1 + ppm * 1e-6)
        self._latency_s, self._jitter = latency_s, jitter or (lambda: 0.0)
        self._n = round(rate_hz * 0.01)
        self._leaves_s = begins_s + latency_s  # of the next sample, loop time
        self._dry = False
        self.left_s, self.left = np.zeros(0), np.zeros(0, np.float32)

    def starve(self, for_s):
        """It had nothing to play for so long, and says so with the next block."""
        self._leaves_s += for_s
        self._dry = True

    def play(self, until_s, ahead_s=0.4):
        """Blocks until loop time `until_s`; the tone is told so far ahead of what leaves."""
        said_s = [], []
        while self._leaves_s - self._latency_s < until_s:
            now_s = self._leaves_s - self._latency_s
            first = max(0, math.floor(now_s / FRAME_S))
            frames = max(1, round(ahead_s / FRAME_S))
            said = self._says(np.arange(first * FRAME_SAMPLES, (first + frames) * FRAME_SAMPLES))
            self.playout.tell(first, said.astype(np.float32))
            stamp_s = ORIGIN_S + self._leaves_s + self._jitter()
            block = self.playout.block(self._n, stamp_s, self._dry)
            said_s[0].append(self._leaves_s + np.arange(self._n) / self._true_hz)
            said_s[1].append(block)
            self._leaves_s, self._dry = self._leaves_s + self._n / self._true_hz, False
        self.left_s, self.left = np.concatenate(said_s[0]), np.concatenate(said_s[1])
        return self

    def off_s(self, after_s):
        """How far what left is from what was due, as time, at worst, from loop time `after_s` on."""
        late = self.left_s > after_s
        error = np.abs(self.left[late] - tone(self.left_s[late] * AUDIO_HZ))
        return float(error.max()) / (2 * np.pi * TONE_HZ)


@pytest.mark.parametrize("rate_hz", [16_000, 44_100, pytest.param(48_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("ppm", [-300.0, 0.0, 300.0])
def test_a_device_that_drifts_is_followed(rate_hz, ppm):
    """300 ppm are 0.6 s in half an hour; 30 s of it here. Nothing jumps, nothing is silent."""
    device = VirtualDevice(rate_hz, ppm)
    device.playout.start(ORIGIN_S)
    device.play(30.0)
    assert device.off_s(after_s=0.1) < 0.004
    assert device.off_s(after_s=15.0) < 0.0005
    told = device.playout.statistics()
    assert (told["underruns"], told["jumps"]) == (0, 0)
    assert told["drift_ppm"] == pytest.approx(ppm, abs=10)
    assert [silence.first for silence in device.playout.silences] == []


@given(seed=st.integers(0, 1000), latency_s=st.floats(0.01, 0.3))
def test_stamps_that_come_late_change_little(seed, latency_s):
    rng = np.random.default_rng(seed)
    device = VirtualDevice(16_000, 50.0, latency_s, jitter=lambda: rng.exponential(0.004))
    device.play(0.0)  # a device runs before the loop does
    device.playout.start(ORIGIN_S)
    device.play(6.0)
    assert device.off_s(after_s=0.0) < 0.002
    assert device.playout.statistics()["jumps"] == 0


def test_what_was_due_before_a_late_start_is_silence():
    device = VirtualDevice(48_000, begins_s=0.7, latency_s=0.1)
    device.playout.start(ORIGIN_S)
    device.play(3.0)
    (silence,) = device.playout.silences
    assert silence.first == 0 and silence.last == pytest.approx(0.8 * AUDIO_HZ, abs=2)
    assert device.off_s(after_s=0.0) < 0.001


@given(for_s=st.floats(0.005, 2.0))
def test_a_device_that_ran_dry_was_silent_and_is_on_time_again(for_s):
    device = VirtualDevice(16_000)
    device.playout.start(ORIGIN_S)
    device.play(2.0)
    ended_s = device.left_s[-1]
    device.starve(for_s)
    device.play(2.0 + for_s + 2.0)
    (silence,) = device.playout.silences
    assert silence.first / AUDIO_HZ == pytest.approx(ended_s, abs=0.001)
    assert (silence.last - silence.first) / AUDIO_HZ == pytest.approx(for_s, abs=0.001)
    assert device.off_s(after_s=0.0) < 0.001
    assert device.playout.statistics()["underruns"] == 1


def test_a_gap_that_the_device_does_not_speak_of_is_found():
    device = VirtualDevice(16_000)
    device.playout.start(ORIGIN_S)
    device.play(2.0)
    device.starve(0.3)
    device._dry = False
    device.play(4.0)
    assert device.playout.statistics()["underruns"] == 1 and len(device.playout.silences) == 1
    assert device.off_s(after_s=0.0) < 0.001


def test_what_is_told_too_late_is_silence():
    device = VirtualDevice(16_000, latency_s=0.06)
    device.playout.start(ORIGIN_S)
    device.play(1.0, ahead_s=FRAME_S)  # of a frame of 40 ms the device wants the end 60 ms before it leaves
    silent = sum(each.last - each.first for each in device.playout.silences)
    assert silent > 0.5 * AUDIO_HZ


def test_a_stream_that_is_far_off_jumps_to_its_place():
    """Its stamps were wrong by 60 ms, all of them, for long."""
    wrong_s = 0.06
    device = VirtualDevice(16_000, jitter=lambda: wrong_s)
    device.playout.start(ORIGIN_S)
    device.play(2.0)
    wrong_s = 0.0
    device.play(6.0)
    assert device.playout.statistics()["jumps"] == 1
    assert device.off_s(after_s=4.0) < 0.001


def test_in_silence_it_is_put_right_at_once():
    """Its first stamp was 15 ms late, which is less than a jump; the first word is in its place all the same."""
    stamps_s = iter([0.015, *[0.0] * 1000])
    device = VirtualDevice(
        16_000, jitter=lambda: next(stamps_s), begins_s=0.0, says=lambda at: tone(at) * (at > 0.5 * AUDIO_HZ)
    )
    device.playout.start(ORIGIN_S)
    device.play(2.0)
    assert device.off_s(after_s=0.9) < 0.0005
    assert not device.playout.silences and device.playout.statistics()["jumps"] == 0


def test_before_the_loop_begins_it_plays_nothing():
    playout = Playout(16_000)
    playout.tell(0, np.ones(FRAME_SAMPLES, np.float32))
    assert not playout.block(160, 5.0).any()
    playout.start(6.0)
    assert not playout.block(160, 5.01).any()
    assert not playout.silences
