"""`--play` in virtual time: what leaves the device at an instant is what is due then, and everything goes by it."""

import math
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recorded_sound import recorded_voice

from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES
from sfms_robot.signals.echo import ECHO_LATENCY_SAMPLES
from sfms_robot.sources.live_voice import GAP_S
from sfms_robot.sources.microphone import Microphone
from sfms_robot.sources.paired import PairedSource
from sfms_robot.sources.playback import EARLY_S, HUSH_S, MARGIN_S, PlaybackOpened, PlayedVoice, Playout
from sfms_robot.sources.push import PushedSpeech

TICK_S = 0.01
LATENCY_S = 0.06
ORIGIN_S = 1000.0
TONE_HZ = 40.0  # of which an instant can be told to a few milliseconds


def tone(samples):
    return np.sin(2 * np.pi * TONE_HZ / AUDIO_HZ * np.asarray(samples)).astype(np.float32)


class VirtualDevice:
    """A sound card with a clock of its own: what it is handed leaves sample by sample, `latency_s` later.

    Attributes:
        left_s, left: when each sample of the last run left, in loop time, and what it was.
    """

    def __init__(self, rate_hz, ppm=0.0, latency_s=LATENCY_S, begins_s=-0.5, jitter=None, says=tone):
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

    def run(self, until_s, before=lambda now_s: None):
        """Blocks until loop time `until_s`, `before(now)` each of them."""
        left_s, left = [np.zeros(0)], [np.zeros(0, np.float32)]
        while self._leaves_s - self._latency_s < until_s:
            before(self._leaves_s - self._latency_s)
            left.append(self.playout.block(self._n, ORIGIN_S + self._leaves_s + self._jitter(), self._dry))
            left_s.append(self._leaves_s + np.arange(self._n) / self._true_hz)
            self._leaves_s, self._dry = self._leaves_s + self._n / self._true_hz, False
        self.left_s, self.left = np.concatenate(left_s), np.concatenate(left)

    def play(self, until_s, ahead_s=0.4):
        """Run until `until_s`; the tone is told so far ahead of what leaves."""

        def tell(now_s):
            first = max(0, math.floor(now_s / FRAME_S))
            frames = max(1, round(ahead_s / FRAME_S))
            said = self._says(np.arange(first * FRAME_SAMPLES, (first + frames) * FRAME_SAMPLES))
            self.playout.tell(first, said.astype(np.float32))

        self.run(until_s, tell)

    def off_s(self, after_s):
        """How far what left is from what was due, as time, at worst, from loop time `after_s` on."""
        late = self.left_s > after_s
        error = np.abs(self.left[late] - tone(self.left_s[late] * AUDIO_HZ))
        return float(error.max()) / (2 * np.pi * TONE_HZ)


@pytest.mark.parametrize("rate_hz", [16_000, 44_100, 48_000])
@pytest.mark.parametrize("ppm", [-300.0, 0.0, 300.0])
def test_a_device_that_drifts_is_followed(rate_hz, ppm):
    """300 ppm are 0.6 s in half an hour; 30 s of it here. Nothing jumps, nothing is silent."""
    device = VirtualDevice(rate_hz, ppm)
    device.playout.start(ORIGIN_S)
    device.play(30.0)
    assert device.off_s(after_s=0.1) < 0.004 and device.off_s(after_s=15.0) < 0.0005
    told = device.playout.statistics()
    assert (told["underruns"], told["jumps"]) == (0, 0) and told["drift_ppm"] == pytest.approx(ppm, abs=10)
    assert [silence.first for silence in device.playout.silences] == []


@given(seed=st.integers(0, 1000), latency_s=st.floats(0.01, 0.3))
def test_stamps_that_come_late_change_little(seed, latency_s):
    rng = np.random.default_rng(seed)
    device = VirtualDevice(16_000, 50.0, latency_s, jitter=lambda: rng.exponential(0.004))
    device.play(0.0)  # a device runs before the loop does
    device.playout.start(ORIGIN_S)
    device.play(6.0)
    assert device.off_s(after_s=0.0) < 0.002 and device.playout.statistics()["jumps"] == 0


def test_what_is_due_before_a_late_start_or_told_too_late_or_before_the_loop_begins_is_silence():
    device = VirtualDevice(48_000, begins_s=0.7, latency_s=0.1)
    device.playout.start(ORIGIN_S)
    device.play(3.0)
    (silence,) = device.playout.silences
    assert silence.first == 0 and silence.last == pytest.approx(0.8 * AUDIO_HZ, abs=2)
    assert device.off_s(after_s=0.0) < 0.001
    device = VirtualDevice(16_000, latency_s=0.06)
    device.playout.start(ORIGIN_S)
    device.play(1.0, ahead_s=FRAME_S)  # of a frame of 40 ms the device wants the end 60 ms before it leaves
    assert sum(each.last - each.first for each in device.playout.silences) > 0.5 * AUDIO_HZ
    playout = Playout(16_000)
    playout.tell(0, np.ones(FRAME_SAMPLES, np.float32))
    assert not playout.block(160, 5.0).any()
    playout.start(6.0)
    assert not playout.block(160, 5.01).any() and not playout.silences


@given(for_s=st.floats(0.005, 2.0), says_so=st.booleans())
def test_a_device_that_ran_dry_was_silent_and_is_on_time_again(for_s, says_so):
    """It says so with the next block; a gap of more than `GAP_S` is found without."""
    device = VirtualDevice(16_000)
    device.playout.start(ORIGIN_S)
    device.play(2.0)
    ended_s = device.left_s[-1]
    for_s += 0.0 if says_so else GAP_S
    device.starve(for_s)
    device._dry = says_so
    device.play(2.0 + for_s + 2.0)
    (silence,) = device.playout.silences
    assert silence.first / AUDIO_HZ == pytest.approx(ended_s, abs=0.001)
    assert (silence.last - silence.first) / AUDIO_HZ == pytest.approx(for_s, abs=0.001)
    assert device.off_s(after_s=0.0) < 0.001 and device.playout.statistics()["underruns"] == 1


def test_a_stream_that_is_far_off_jumps_to_its_place():
    """Its stamps were wrong by 60 ms, all of them, for long."""
    wrong_s = 0.06
    device = VirtualDevice(16_000, jitter=lambda: wrong_s)
    device.playout.start(ORIGIN_S)
    device.play(2.0)
    wrong_s = 0.0
    device.play(6.0)
    assert device.playout.statistics()["jumps"] == 1 and device.off_s(after_s=4.0) < 0.001


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


class VirtualLoudspeaker:
    """`playback.Loudspeaker` on a sound card of 16 kHz, in virtual time.

    Attributes:
        left: what left, from loop time 0 on.
    """

    def __init__(self):
        self.now_s, self.lost = ORIGIN_S, False
        self.device = VirtualDevice(AUDIO_HZ, begins_s=0.0)
        self._messages = [PlaybackOpened("virtual", LATENCY_S)]
        self._told = None
        self.left = np.zeros(20 * AUDIO_HZ, np.float32)

    def tell(self, value):
        if self._told is None:
            self.device.playout.start(value.origin_s)
        self._told = value
        self.device.playout.tell(value.first, value.samples)

    def messages(self, now_s):
        silences = self.device.playout.silences
        told, self._messages = [*self._messages, *silences], []
        silences.clear()
        return told

    def statistics(self):
        return {"state": "running"}

    def close(self):
        self.lost = True

    def tick(self):
        self.now_s += TICK_S
        self.device.run(self.now_s - ORIGIN_S)
        self.left[np.rint(self.device.left_s * AUDIO_HZ).astype(int)] = self.device.left


class Desk:
    """A loop in virtual time: ticks of 10 ms, and `take` a frame early, as `PairedSource` does, `late_s` after that.

    Attributes:
        frames: what was taken, frame by frame, from frame 1 on; frame 0 is over before anybody can ask.
    """

    def __init__(self, spoken, late_s=0.0, clock=None):
        self.loudspeaker = VirtualLoudspeaker()
        if clock is not None:
            clock.append(self.loudspeaker)
        self.voice = PlayedVoice(self.loudspeaker, spoken, lambda: self.loudspeaker.now_s)
        spoken.played_by(self.voice)
        self.voice.start(self.loudspeaker.now_s)
        self._late_s = late_s
        self.frames = [None]

    @property
    def loop_s(self):
        return self.loudspeaker.now_s - ORIGIN_S

    def until(self, loop_s):
        while self.loop_s < loop_s - 1e-9:
            self.loudspeaker.tick()
            while self.loop_s >= len(self.frames) * FRAME_S + self._late_s - 1e-9:
                self.frames.append(self.voice.take(len(self.frames)))
        return self

    @property
    def taken(self):
        silence = np.zeros(FRAME_SAMPLES, np.float32)
        return np.concatenate([silence if frame is None else frame for frame in self.frames])

    @property
    def left(self):
        return self.loudspeaker.left[: len(self.frames) * FRAME_SAMPLES]


def noise(seconds, seed=0):
    return (0.3 * np.random.default_rng(seed).uniform(-1, 1, round(seconds * AUDIO_HZ))).astype(np.float32)


def talk():
    """Return speech that a program pushes, in the desk's time, and the desk."""
    clock = []
    spoken = PushedSpeech(lambda: clock[0].now_s)
    return spoken, Desk(spoken, clock=clock)


@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_of_a_recording_what_is_taken_a_frame_early_is_what_leaves(late_s):
    said = noise(2.0)
    desk = Desk(recorded_voice(said), late_s).until(3.0)
    np.testing.assert_allclose(desk.taken[FRAME_SAMPLES:], desk.left[FRAME_SAMPLES:], atol=1e-5)
    begins = round(desk.voice.delay_s * AUDIO_HZ)
    np.testing.assert_allclose(desk.left[begins : begins + len(said)], said, atol=1e-5)
    assert desk.voice.delay_s == pytest.approx(LATENCY_S + MARGIN_S)
    assert desk.voice.duration_s == pytest.approx(2.0 + desk.voice.delay_s)
    assert desk.voice.statistics()["unsaid_ms"] == 0.0


@given(at_s=st.floats(0.0, 1.0), seconds=st.floats(0.05, 0.5))
def test_speech_leaves_as_soon_as_it_can_and_is_taken_when_it_does(at_s, seconds):
    spoken, desk = talk()
    desk.until(at_s)
    assert not any(frame is not None for frame in desk.frames)
    said = noise(seconds)
    spoken.say(said, AUDIO_HZ)
    begins = round((desk.loop_s + FRAME_S + desk.voice.delay_s) * AUDIO_HZ)
    desk.until(desk.loop_s + 1.5)
    np.testing.assert_allclose(desk.left[begins : begins + len(said)], said, atol=1e-5)
    assert np.count_nonzero(desk.left) <= len(said) + 40
    np.testing.assert_allclose(desk.taken[FRAME_SAMPLES:], desk.left[FRAME_SAMPLES:], atol=1e-5)


@pytest.mark.parametrize("at_s", [None, 0.9])
def test_a_sentence_in_pieces_is_one_sentence_and_leaves_at_its_time(at_s):
    spoken, desk = talk()
    said = noise(0.3)
    for at in range(0, len(said), 320):
        spoken.say(said[at : at + 320], AUDIO_HZ, at_s and ORIGIN_S + at_s + at / AUDIO_HZ)
        desk.until(desk.loop_s + TICK_S)  # twice as fast as it is spoken
    desk.until(2.0)
    begins = round((at_s or FRAME_S + desk.voice.delay_s) * AUDIO_HZ)
    np.testing.assert_allclose(desk.left[begins : begins + len(said)], said, atol=1e-5)


@given(at=st.integers(30, 90))
def test_a_hush_is_heard_as_soon_as_the_device_can_and_the_next_sentence_after_it(at):
    spoken, desk = talk()
    spoken.say(noise(5.0), AUDIO_HZ)
    desk.until(at * TICK_S)
    spoken.hush()
    hushed = round(desk.loop_s * AUDIO_HZ)
    desk.until(2.0)
    silent = hushed + round((LATENCY_S + HUSH_S + 0.006) * AUDIO_HZ)
    assert np.abs(desk.left[hushed:silent]).max() > 0.2 and not desk.left[silent + 40 :].any()
    again = noise(0.3, 1)
    spoken.say(again, AUDIO_HZ)
    begins = round((desk.loop_s + FRAME_S + desk.voice.delay_s) * AUDIO_HZ)
    desk.until(3.0)
    np.testing.assert_allclose(desk.left[begins : begins + len(again)], again, atol=1e-5)
    np.testing.assert_allclose(desk.taken[FRAME_SAMPLES:], desk.left[FRAME_SAMPLES:], atol=1e-5)
    assert desk.voice.statistics()["unsaid_ms"] == 0.0


def test_a_device_that_runs_dry_is_a_silence_that_is_told_and_counted(caplog):
    said = noise(3.0)
    desk = Desk(recorded_voice(said)).until(1.0)
    desk.loudspeaker.device.starve(0.2)
    desk.until(2.5)
    assert desk.voice.statistics()["unsaid_ms"] == pytest.approx(200.0, abs=1.0)
    (line,) = [record.getMessage() for record in caplog.records]
    assert line == "loudspeaker: virtual had nothing to play for 200 ms while the robot spoke (said once)"
    on_time, begins = round(1.5 * AUDIO_HZ), round(desk.voice.delay_s * AUDIO_HZ)
    np.testing.assert_allclose(desk.left[on_time:], said[on_time - begins :][: len(desk.left) - on_time], atol=1e-4)
    np.testing.assert_allclose(desk.taken[on_time:], desk.left[on_time:], atol=1e-4)
    assert not desk.left[round(1.061 * AUDIO_HZ) : round(1.259 * AUDIO_HZ)].any()
    assert not desk.taken[round(1.24 * AUDIO_HZ) : round(1.259 * AUDIO_HZ)].any()  # the first frame after it is known


def test_where_nobody_hears_it_the_robot_says_nothing():
    desk = Desk(recorded_voice(noise(3.0))).until(1.0)
    desk.loudspeaker.lost = True
    assert desk.voice.lost and not desk.voice.take(26).any()
    desk.loudspeaker.lost = False
    assert desk.voice.take(26).any()


def test_threads_that_speak_and_hush_do_not_hold_up_the_loop():
    """All of them for a thousand turns: nothing is raised, and the loop has its frames."""
    spoken = PushedSpeech()
    voice = PlayedVoice(VirtualLoudspeaker(), spoken)
    spoken.played_by(voice)
    voice.start(time.monotonic())

    def speak():
        for _ in range(200):
            spoken.say(noise(0.02), AUDIO_HZ)
            spoken.hush()

    with ThreadPoolExecutor(2) as threads:
        speakers = [threads.submit(speak) for _ in range(2)]
        taken = [voice.take(index) for index in range(1000)]
    assert not any(each.exception() for each in speakers)
    assert all(frame is None or frame.shape == (FRAME_SAMPLES,) for frame in taken)


def test_programs_behind_what_is_said_are_told_also_where_it_is_played():
    spoken = PushedSpeech()
    spoken.outlet = object()
    played = PlayedVoice(VirtualLoudspeaker(), spoken)
    assert list(PairedSource(None, None, played).outlets) == [spoken.outlet]


class Sent(list):
    """A microphone's worker that keeps what it is sent."""

    tell, lost = list.append, False

    def messages(self, now_s):
        return []


def test_the_echo_canceller_is_told_every_frame_and_a_little_early():
    """It asks, the frame before the newest too, before the microphone's frame is there."""
    desk, sent = Desk(recorded_voice(noise(2.0))), Sent()
    source = PairedSource(Microphone(sent, EARLY_S), None, desk.voice)
    source.start(desk.loudspeaker.now_s)
    for index in range(1, 26):
        desk.until(index * FRAME_S)
        source.read(desk.loop_s)
    ends = [each.first + len(each.said) // FRAME_SAMPLES for each in sent[1:]]
    assert ends == list(range(2, 27))
    first, told = sent[-1].first, sent[-1].said
    early = round(EARLY_S * AUDIO_HZ)
    assert early + ECHO_LATENCY_SAMPLES <= FRAME_SAMPLES
    left = desk.left[first * FRAME_SAMPLES + early :][: len(told) - early]
    np.testing.assert_allclose(told[:-early], left, atol=1e-5)
