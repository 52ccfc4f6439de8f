"""`--play`: everybody goes by what leaves the loudspeaker. First in virtual time, then on a sound server."""

import threading
import time
from contextlib import closing

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from scripted_worker import wait_for_message

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES
from sfms_robot.signals.audio import energy_db, read_audio
from sfms_robot.signals.echo import ECHO_LATENCY_SAMPLES
from sfms_robot.sources.live_voice import LiveVoice
from sfms_robot.sources.microphone import Microphone
from sfms_robot.sources.paired import PairedSource
from sfms_robot.sources.playback import (
    EARLY_S,
    HUSH_S,
    MARGIN_S,
    PlaybackOpened,
    PlaybackStream,
    PlayedVoice,
    Playout,
    leaves_after_s,
    open_playback,
)
from sfms_robot.sources.push import PushedSpeech
from sfms_robot.sources.recording import RecordedVoice
from sfms_robot.sources.registry import open_source
from sfms_robot.sources.sound_devices import Capture, SoundDevice

pytestmark = pytest.mark.realtime

PATIENCE_S = 60.0  # on a computer with nothing to spare
TICK_S = 0.01
LATENCY_S = 0.06


class VirtualLoudspeaker:
    """`playback.Loudspeaker` on a sound card of 16 kHz, in virtual time.

    Attributes:
        left: what left, from loop time 0 on.
    """

    def __init__(self):
        self.now_s = self._origin_s = 50.0
        self._playout = Playout(AUDIO_HZ)
        self._messages = [PlaybackOpened("virtual", AUDIO_HZ, LATENCY_S)]
        self._leaves_s = self.now_s + LATENCY_S
        self._dry = False
        self._told = None
        self.lost = False
        self.left = np.zeros(20 * AUDIO_HZ, np.float32)

    def tell(self, value):
        if self._told is None:
            self._playout.start(value.origin_s)
        self._told = value
        self._playout.tell(value.first, value.samples)

    def messages(self, now_s):
        told, self._messages = [*self._messages, *self._playout.silences], []
        self._playout.silences.clear()
        return told

    def statistics(self):
        return {"state": "running"}

    def close(self):
        self.lost = True

    def starve(self, for_s):
        self._leaves_s += for_s
        self._dry = True

    def tick(self):
        self.now_s += TICK_S
        while self._leaves_s - LATENCY_S < self.now_s:
            block = self._playout.block(160, self._leaves_s, self._dry)
            at = round((self._leaves_s - self._origin_s) * AUDIO_HZ)
            self.left[at : at + 160] = block
            self._leaves_s, self._dry = self._leaves_s + 0.01, False


class Desk:
    """A loop in virtual time: ticks of 10 ms, and `take` a frame early, as `PairedSource` does, `late_s` after that.

    Attributes:
        frames: what was taken, frame by frame, from frame 1 on; frame 0 is over before anybody can ask.
    """

    def __init__(self, spoken, late_s=0.0):
        self.loudspeaker = VirtualLoudspeaker()
        self.voice = PlayedVoice(self.loudspeaker, spoken, lambda: self.loudspeaker.now_s)
        spoken.played_by(self.voice)
        self.voice.start(self.loudspeaker.now_s)
        self._late_s = late_s
        self.frames = [None]

    @property
    def loop_s(self):
        return self.loudspeaker.now_s - 50.0

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


@pytest.fixture
def talk():
    """A robot that is told what to say, and the desk that it speaks at."""
    now_s = [50.0]
    spoken = PushedSpeech(lambda: now_s[0])
    desk = Desk(spoken)
    tick = desk.loudspeaker.tick

    def both():
        tick()
        now_s[0] = desk.loudspeaker.now_s

    desk.loudspeaker.tick = both
    return spoken, desk


@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_of_a_recording_what_is_taken_a_frame_early_is_what_leaves(late_s):
    said = noise(2.0)
    desk = Desk(RecordedVoice(said), late_s).until(3.0)
    np.testing.assert_allclose(desk.taken[FRAME_SAMPLES:], desk.left[FRAME_SAMPLES:], atol=1e-5)
    begins = round(desk.voice.delay_s * AUDIO_HZ)
    np.testing.assert_allclose(desk.left[begins : begins + len(said)], said, atol=1e-5)
    assert desk.voice.delay_s == pytest.approx(LATENCY_S + MARGIN_S)
    assert desk.voice.duration_s == pytest.approx(2.0 + desk.voice.delay_s)
    assert desk.voice.statistics()["unsaid_ms"] == 0.0


@given(at_s=st.floats(0.0, 1.0), seconds=st.floats(0.05, 0.5))
def test_what_is_said_leaves_as_soon_as_it_can_and_is_told_when_it_does(at_s, seconds):
    now_s = [50.0]
    spoken = PushedSpeech(lambda: now_s[0])
    desk = Desk(spoken)
    desk.until(at_s)
    now_s[0] = desk.loudspeaker.now_s
    assert not any(frame is not None for frame in desk.frames)
    said = noise(seconds)
    spoken.say(said, AUDIO_HZ)
    begins = round((now_s[0] - 50.0 + FRAME_S + desk.voice.delay_s) * AUDIO_HZ)
    for _ in range(150):
        desk.until(desk.loop_s + TICK_S)
        now_s[0] = desk.loudspeaker.now_s
    np.testing.assert_allclose(desk.left[begins : begins + len(said)], said, atol=1e-5)
    assert np.count_nonzero(desk.left) <= len(said) + 40
    np.testing.assert_allclose(desk.taken[FRAME_SAMPLES:], desk.left[FRAME_SAMPLES:], atol=1e-5)


def test_a_sentence_in_pieces_is_one_sentence(talk):
    spoken, desk = talk
    said = noise(1.0)
    for at in range(0, len(said), 320):
        spoken.say(said[at : at + 320], AUDIO_HZ)
        desk.until(desk.loop_s + TICK_S)  # twice as fast as it is spoken
    desk.until(2.0)
    begins = round((FRAME_S + desk.voice.delay_s) * AUDIO_HZ)
    np.testing.assert_allclose(desk.left[begins : begins + len(said)], said, atol=1e-5)


def test_a_time_is_when_it_leaves_the_loudspeaker(talk):
    spoken, desk = talk
    said = noise(0.3)
    spoken.say(said, AUDIO_HZ, at_s=50.0 + 0.9)
    desk.until(2.0)
    np.testing.assert_allclose(desk.left[round(0.9 * AUDIO_HZ) :][: len(said)], said, atol=1e-5)


@given(at=st.integers(30, 90))
def test_a_hush_is_heard_as_soon_as_the_device_can(at):
    now_s = [50.0]
    spoken = PushedSpeech(lambda: now_s[0])
    desk = Desk(spoken)
    spoken.say(noise(5.0), AUDIO_HZ)
    for tick in range(200):
        desk.until(desk.loop_s + TICK_S)
        now_s[0] = desk.loudspeaker.now_s
        if tick == at:
            spoken.hush()
            hushed = round(desk.loop_s * AUDIO_HZ)
    silent = hushed + round((LATENCY_S + HUSH_S + 0.006) * AUDIO_HZ)
    assert np.abs(desk.left[hushed:silent]).max() > 0.2
    assert not desk.left[silent + 40 :].any()
    np.testing.assert_allclose(desk.taken[FRAME_SAMPLES:], desk.left[FRAME_SAMPLES:], atol=1e-5)
    assert desk.voice.statistics()["unsaid_ms"] == 0.0


def test_after_a_hush_it_speaks_again(talk):
    spoken, desk = talk
    spoken.say(noise(3.0), AUDIO_HZ)
    desk.until(0.6)
    spoken.hush()
    again = noise(0.3, 1)
    spoken.say(again, AUDIO_HZ)
    desk.until(2.0)
    begins = round((0.6 + FRAME_S + desk.voice.delay_s) * AUDIO_HZ)
    np.testing.assert_allclose(desk.left[begins : begins + len(again)], again, atol=1e-5)
    assert not desk.left[begins + len(again) + 40 :].any()


def test_a_device_that_runs_dry_is_a_silence_that_is_told_and_counted(caplog):
    said = noise(3.0)
    desk = Desk(RecordedVoice(said)).until(1.0)
    desk.loudspeaker.starve(0.2)
    desk.until(2.5)
    told = desk.voice.statistics()
    assert told["unsaid_ms"] == pytest.approx(200.0, abs=1.0)
    (line,) = [record.getMessage() for record in caplog.records]
    assert line == "loudspeaker: virtual had nothing to play for 200 ms while the robot spoke (said once)"
    on_time = round(1.5 * AUDIO_HZ)
    begins = round(desk.voice.delay_s * AUDIO_HZ)
    np.testing.assert_allclose(desk.left[on_time:], said[on_time - begins :][: len(desk.left) - on_time], atol=1e-4)
    np.testing.assert_allclose(desk.taken[on_time:], desk.left[on_time:], atol=1e-4)
    assert not desk.left[round(1.061 * AUDIO_HZ) : round(1.259 * AUDIO_HZ)].any()
    assert not desk.taken[round(1.24 * AUDIO_HZ) : round(1.259 * AUDIO_HZ)].any()  # the first frame after it is known


def test_where_nobody_hears_it_the_robot_says_nothing():
    desk = Desk(RecordedVoice(noise(3.0))).until(1.0)
    desk.loudspeaker.lost = True
    assert desk.voice.lost and not desk.voice.take(26).any()
    desk.loudspeaker.lost = False
    assert desk.voice.take(26).any()


def test_threads_that_speak_and_hush_do_not_hold_up_the_loop():
    """All of them for a thousand turns: nothing is raised, and the loop has its frames."""
    spoken = PushedSpeech()
    loudspeaker = VirtualLoudspeaker()
    voice = PlayedVoice(loudspeaker, spoken)
    spoken.played_by(voice)
    voice.start(time.monotonic())
    over = threading.Event()

    def speak():
        while not over.is_set():
            spoken.say(noise(0.02), AUDIO_HZ)
            spoken.hush()

    threads = [threading.Thread(target=speak) for _ in range(2)]
    for thread in threads:
        thread.start()
    taken = [voice.take(index) for index in range(1000)]
    over.set()
    for thread in threads:
        thread.join()
    assert all(frame is None or frame.shape == (FRAME_SAMPLES,) for frame in taken)


# --- the device -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ahead_s", "expected_s"), [(0.03, 0.03), (None, 0.05), (-0.01, 0.05), (1e6, 0.05), (float("nan"), 0.05)]
)
def test_a_block_leaves_when_its_device_says_so_where_that_can_be(ahead_s, expected_s):
    assert leaves_after_s(ahead_s, 0.05) == expected_s


@pytest.mark.parametrize("channels", [1, 2, 8])
def test_of_many_channels_the_first_two_speak(channels):
    stream = PlaybackStream(SoundDevice(name="room", number=3, channels=channels, rate_hz=48_000.0), 48_000.0, channels)
    stream.playout.start(time.monotonic())
    stream.playout.tell(0, np.full(50 * FRAME_SAMPLES, 0.25, np.float32))
    stamp = type("Stamp", (), {"outputBufferDacTime": 5.2, "currentTime": 5.0})
    out = np.ones((480, channels), np.float32)
    stream._called(out, 480, stamp, type("Status", (), {"output_underflow": False}))
    assert out[:, :2] == pytest.approx(np.full((480, min(channels, 2)), 0.25), abs=1e-5)
    assert not out[:, 2:].any()


# --- a sound server -------------------------------------------------------------------------------------------------


def pause(played):
    """Wait until its worker has sent something."""
    wait_for_message(played._loudspeaker, FRAME_S)


def recorded(seconds, begin):
    """What `person.monitor` records meanwhile, on the grid that begins now, and what `begin(origin)` gave."""
    heard = LiveVoice()
    with Capture.opened("person.monitor", "--audio mic") as capture:
        origin_s = time.monotonic()
        heard.start(origin_s)
        step = begin(origin_s)
        frames = []
        while len(frames) < round(seconds / FRAME_S):
            capture.pass_on(heard, 0.02)
            step()
            frame = heard.take(len(frames))
            if frame is not None:
                frames.append(frame)
            assert time.monotonic() < origin_s + PATIENCE_S
    return np.concatenate(frames)


def found(part, whole):
    """Where a part lies in the whole, in samples, and how well it correlates with what is there."""
    size = len(part) + len(whole)
    together = np.fft.irfft(np.fft.rfft(whole, size) * np.fft.rfft(part, size).conj(), size)
    begin = int(together[: len(whole) - len(part)].argmax())
    there = whole[begin : begin + len(part)]
    return begin, float(together[begin] / np.sqrt((part**2).sum() * (there**2).sum()))


@pytest.mark.slow
def test_what_is_told_to_leave_is_what_is_recorded_then(sound_server):
    """A sound server's own time stamps: of what is played, and of what its monitor records of it."""
    said = read_audio(data_dir("sim") / "speakers" / "katie" / "speech.flac")[: 7 * AUDIO_HZ]
    with closing(open_playback("person", RecordedVoice(said))) as played:
        taken = []

        def begin(origin_s):
            played.start(origin_s)

            def step():
                while (time.monotonic() - origin_s) / FRAME_S >= len(taken):
                    taken.append(played.take(len(taken)))

            return step

        heard = recorded(8.0, begin)
    assert played.device == "person"
    whole = np.concatenate([np.zeros(FRAME_SAMPLES, np.float32) if frame is None else frame for frame in taken])
    begins = range(2 * AUDIO_HZ, 6 * AUDIO_HZ, AUDIO_HZ)  # both clocks are being learnt before
    places, likenesses = zip(*(found(whole[at : at + AUDIO_HZ], heard) for at in begins), strict=True)
    assert np.median(likenesses) > 0.8
    assert np.median(np.abs(np.array(places) - np.array(begins))) / AUDIO_HZ < 0.05


@pytest.mark.slow
def test_a_hush_silences_the_sound_server(sound_server):
    spoken = PushedSpeech()
    with closing(open_playback("person", spoken)) as played:
        asked = []

        def begin(origin_s):
            played.start(origin_s)
            spoken.say(noise(10.0), AUDIO_HZ)

            def step():
                loop_s = time.monotonic() - origin_s
                played.take(int(loop_s / FRAME_S) + 1)
                if loop_s > 1.5 and not asked:
                    asked.append(loop_s)
                    spoken.hush()

            return step

        heard = recorded(2.5, begin)
    levels = [energy_db(frame) for frame in heard.reshape(-1, FRAME_SAMPLES)]
    assert max(levels[20:30]) > -20.0
    ended_s = max(index for index, level in enumerate(levels) if level > -60.0) * FRAME_S
    assert asked[0] - 0.05 < ended_s < asked[0] + 0.6


@pytest.mark.slow
def test_a_loudspeaker_that_was_unplugged_is_found_again(sound_server, caplog):
    said = noise(60.0)
    with closing(open_source("none", "none", agent=RecordedVoice(said), play="person")) as source:
        origin_s = time.monotonic()
        source.start(origin_s)
        frames = []

        def until(enough):
            before = len(frames)
            while not enough(frames[before:]):
                assert time.monotonic() < origin_s + PATIENCE_S
                frames.extend(source.read(time.monotonic() - origin_s))
                pause(source._agent)

        until(lambda new: any(frame.agent_audio is not None and frame.agent_audio.any() for frame in new))
        sound_server.unplug("person")
        until(lambda _: "agent_audio" in source.missing)
        until(lambda new: len(new) > 5 and not any(frame.agent_audio.any() for frame in new[-3:]))
        sound_server.plug("person")
        until(lambda _: not source.missing)
        until(lambda new: any(frame.agent_audio.any() for frame in new))
    told = [record.getMessage() for record in caplog.records]
    assert told[0].startswith("loudspeaker: person, ") and told[-1] == "loudspeaker: running again"


def test_a_loudspeaker_that_is_not_there_is_one_line_with_the_choices(sound_server):
    for wanted in ("nobody", "7"):
        with pytest.raises(ConfigError, match=f"^--play {wanted}: no such device .*person") as raised:
            open_playback(wanted, RecordedVoice(noise(0.1)))
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("agent_audio", ["none", "device:robot.monitor"])
def test_what_is_not_said_here_is_not_played(agent_audio):
    with pytest.raises(ConfigError, match=f"^--play default: nothing is played of --agent-audio {agent_audio} .*tcp"):
        open_source("none", "none", agent_audio=agent_audio, play="default")


@pytest.mark.slow
def test_what_it_plays_is_taken_out_of_what_it_hears(sound_server, tmp_path):
    """Its loudspeaker is heard by the microphone 50 ms later; nobody else speaks."""
    said = read_audio(data_dir("sim") / "speakers" / "katie" / "speech.flac")[: 6 * AUDIO_HZ]
    soundfile.write(tmp_path / "said.wav", said, AUDIO_HZ)
    sound_server.plug("robot")
    sound_server.load("module-loopback", "source=robot.monitor", "sink=person", "latency_msec=50")
    with closing(
        open_source("mic:person.monitor", "none", agent_audio=str(tmp_path / "said.wav"), play="robot")
    ) as one:
        origin_s, frames = time.monotonic(), []
        one.start(origin_s)
        while len(frames) < 150:
            assert time.monotonic() < origin_s + PATIENCE_S
            frames += one.read(time.monotonic() - origin_s)
            pause(one._agent)
    settled = [frame for frame in frames[75:] if len(frame.audio) and frame.agent_audio.any()]
    heard, own = (
        [energy_db(part) for part in parts]
        for parts in ([frame.audio for frame in settled], [frame.agent_audio for frame in settled])
    )
    # Frame by frame: on a busy computer the sound server drops some, and the canceller needs a moment after each.
    assert np.median(own) > -40.0
    assert np.median(heard) < np.median(own) - 15.0


def test_programs_behind_what_is_said_are_told_also_where_it_is_played():
    spoken = PushedSpeech()
    spoken.outlet = object()
    played = PlayedVoice(VirtualLoudspeaker(), spoken)
    assert list(PairedSource(None, None, played).outlets) == [spoken.outlet]


class Sent(list):
    """A microphone's worker that keeps what it is sent."""

    tell = list.append

    def messages(self, now_s):
        return []


def test_the_echo_canceller_is_told_every_frame_and_a_little_early():
    """It asks, the frame before the newest too, before the microphone's frame is there."""
    desk, sent = Desk(RecordedVoice(noise(2.0))), Sent()
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
    np.testing.assert_allclose(
        told[:-early], desk.left[first * FRAME_SAMPLES + early :][: len(told) - early], atol=1e-5
    )
