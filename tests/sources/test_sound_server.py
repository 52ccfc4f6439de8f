"""`--audio mic` and `--play` on the real path: PortAudio, ALSA and a sound server, in real time."""

import logging
import time
from contextlib import closing

import numpy as np
import pytest
import soundfile
from recorded_sound import recorded_voice
from scipy.signal import fftconvolve
from scripted_worker import wait_for_message

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES
from sfms_robot.signals.audio import energy_db, read_audio
from sfms_robot.sources.live_voice import LiveVoice
from sfms_robot.sources.microphone import open_microphone
from sfms_robot.sources.playback import open_playback
from sfms_robot.sources.push import PushedSpeech
from sfms_robot.sources.registry import open_source
from sfms_robot.sources.sound_devices import Capture, sound_devices

pytestmark = pytest.mark.realtime

PATIENCE_S = 60.0  # on a computer with nothing to spare
CALLED_S = 4.0  # before it speaks


class Hearing:
    """A source that is read in real time; every wait is for what its worker sends."""

    def __init__(self, source, microphone, origin_s=None):
        self.source, self.microphone = source, microphone
        self.frames = []
        self.origin_s = time.monotonic() if origin_s is None else origin_s
        self.source.start(self.origin_s)

    def read(self):
        assert time.monotonic() < self.origin_s + PATIENCE_S
        wait_for_message(self.microphone._worker, FRAME_S / 4)
        self.frames += self.source.read(time.monotonic() - self.origin_s)

    def until(self, enough):
        """Read frames until `enough()`; returns those."""
        before = len(self.frames)
        while not enough():
            self.read()
        return self.frames[before:]

    def seconds(self, seconds):
        wanted = len(self.frames) + round(seconds / FRAME_S)
        return self.until(lambda: len(self.frames) >= wanted)


@pytest.fixture
def hear():
    """How to open `--audio` and `--agent-audio` and listen; all is closed afterwards."""
    sources = []

    def opened(audio="mic", origin_s=None, **how):
        source = open_source(audio, "none", **how)
        sources.append(source)
        return Hearing(source, source._voice, origin_s)

    yield opened
    for source in sources:
        source.close()


@pytest.fixture
def play(sound_server):
    """How to play a file to a sink; what still plays is ended afterwards."""
    players = []

    def played(sink, file):
        players.append(sound_server.play(sink, file))
        return players[-1]

    yield played
    for player in players:
        player.kill()
        player.wait()


def heard(frames):
    """(n,) whole, silence for what did not come in time."""
    silence = np.zeros(FRAME_SAMPLES, np.float32)
    return np.concatenate([frame.audio if len(frame.audio) else silence for frame in frames])


def found(said, whole, from_s):
    """By how many seconds the loud parts of what is said are later in the whole, and how well they correlate there.

    Each part is 50 ms: a clock that is still being learnt stretches sound by 1 %, which longer parts do not survive.
    """
    size, later_s, alike = AUDIO_HZ // 20, [], []
    energy = np.lib.stride_tricks.sliding_window_view(np.square(whole, dtype=float), size).sum(axis=1) + 1e-6
    for at in range(round(from_s * AUDIO_HZ), len(said) - size, size):
        if energy_db(part := said[at : at + size]) > -35.0:
            correlation = fftconvolve(whole, part[::-1], "valid") / np.sqrt(energy * (part**2).sum())
            later_s.append((int(correlation.argmax()) - at) / AUDIO_HZ)
            alike.append(correlation.max())
    return np.array(later_s), np.array(alike)


@pytest.mark.slow
def test_what_is_played_is_what_is_heard(hear, play, tmp_path):
    said = read_audio(data_dir("sim") / "speakers" / "katie" / "speech.flac")[: 3 * AUDIO_HZ]
    soundfile.write(tmp_path / "said.wav", said, AUDIO_HZ)
    hearing, player = hear("mic:person"), play("person", tmp_path / "said.wav")
    hearing.until(lambda: player.poll() is not None)
    hearing.seconds(0.4)
    assert [frame.time_s for frame in hearing.frames] == pytest.approx(FRAME_S * np.arange(1, len(hearing.frames) + 1))
    # A busy machine starves the player for a moment, or a frame is late: so both laws hold for most parts.
    later_s, alike = found(said, heard(hearing.frames), 0.0)
    assert np.median(alike) > 0.85
    assert np.median(np.abs(later_s - np.median(later_s))) < 0.05  # the card's clock is still being learnt
    told = hearing.source.statistics()["voice"]
    assert told["device"] == "person.monitor" and told["state"] == "running" and told["voice_frames"] > 25
    assert 0.0 < hearing.microphone.latency_s < 1.0


def called(seconds, said):
    """A loud noise, silence until `seconds` after its beginning, then what is said."""
    noise = 0.5 * np.random.default_rng(1).standard_normal(AUDIO_HZ // 10).clip(-1, 1)
    return np.concatenate([noise, np.zeros(round(seconds * AUDIO_HZ) - len(noise)), said]).astype(np.float32)


def heard_loud_s(hearing):
    """`time.monotonic` of the first loud frame, None as long as there was none."""
    loud = [frame.time_s for frame in hearing.frames if len(frame.audio) and energy_db(frame.audio) > -20.0]
    return hearing.origin_s + loud[0] - FRAME_S if loud else None


def read_both(ear, hearing, enough):
    """Read both in turn, as often as a run does: what the robot says is sent to the worker when a frame is read."""
    while not enough():
        ear.read()
        hearing.read()


def quieter_db(there, left):
    """Return by how much less is left of what is there, in the best second of speech.

    On a busy computer the sound server drops sound or delays it by another amount, and the canceller needs a moment
    after each; without a canceller every second is as loud as before.
    """
    at = {frame.time_s: frame.audio for frame in left if len(frame.audio)}
    both = [(frame.audio, at[frame.time_s]) for frame in there if frame.time_s in at and len(frame.audio)][25:]
    seconds = [np.concatenate(both[begin : begin + 25], 1) for begin in range(0, len(both) - 24, 25)]
    levels = [[energy_db(sound) for sound in second] for second in seconds]
    return max(before - after for before, after in levels if before > -40.0)


@pytest.mark.slow
@pytest.mark.parametrize("told_by", ["device", "program"])
def test_what_the_robot_says_is_taken_out_of_what_is_heard(hear, play, sound_server, tmp_path, told_by):
    """Its loudspeaker is heard by the microphone 50 ms later; nobody else speaks.

    When the player begins nobody knows on a busy computer. So it calls first, and what it says is told for a tenth of
    a second before it will be heard.
    """
    said = read_audio(data_dir("sim") / "speakers" / "katie" / "speech.flac")[: 6 * AUDIO_HZ]
    soundfile.write(tmp_path / "played.wav", called(CALLED_S, said), AUDIO_HZ)
    sound_server.plug("robot")
    sound_server.load("module-loopback", "source=robot.monitor", "sink=person", "latency_msec=50")
    speech = PushedSpeech()
    told = {"agent_audio": "device:robot.monitor"} if told_by == "device" else {"agent": speech}
    ear = hear("mic:person.monitor")
    hearing = hear("mic:person.monitor", ear.origin_s, **told)
    player = play("robot", tmp_path / "played.wav")
    read_both(ear, hearing, lambda: heard_loud_s(ear) is not None)
    told_s = heard_loud_s(ear) + CALLED_S - 0.1
    assert time.monotonic() < told_s, "this computer is too busy to be told in time"
    speech.say(said, AUDIO_HZ, told_s)
    read_both(ear, hearing, lambda: player.poll() is not None)
    assert quieter_db([each for each in ear.frames if each.time_s > told_s - ear.origin_s], hearing.frames) > 15.0
    assert any(frame.agent_audio is not None and frame.agent_audio.any() for frame in hearing.frames)


@pytest.mark.slow
def test_a_loudspeaker_is_heard_without_a_microphone_too(sound_server):
    with closing(open_source("none", "none", agent_audio="device:person.monitor", duration_s=60.0)) as source:
        hearing = Hearing(source, source._agent._recorder)
        hearing.until(lambda: sum(frame.agent_audio is not None for frame in hearing.frames) >= 5)
        assert not any(len(frame.audio) for frame in hearing.frames)


def test_a_device_that_is_not_there_is_one_line_with_the_choices(sound_server):
    labels = [device.label for device in sound_devices() if "hw:" not in device.name]
    assert labels == ["0 pulse", "1 default", "person.monitor"]
    for wanted, problem in (("nobody", "no such device"), ("7", "no such device"), ("p", "fits several devices")):
        with pytest.raises(ConfigError, match=f"--audio mic:{wanted}: {problem} .*person.monitor") as raised:
            open_microphone(wanted)
        assert "\n" not in str(raised.value)


def noise(seconds):
    return (0.3 * np.random.default_rng(0).uniform(-1, 1, round(seconds * AUDIO_HZ))).astype(np.float32)


@pytest.mark.slow
def test_what_is_told_to_leave_is_what_is_recorded_then(sound_server):
    """A sound server's own time stamps: of what is played, and of what its monitor records of it meanwhile."""
    said = read_audio(data_dir("sim") / "speakers" / "katie" / "speech.flac")[: 7 * AUDIO_HZ]
    taken, frames, monitor = [], [], LiveVoice()
    with (
        closing(open_playback("person", recorded_voice(said))) as played,
        closing(Capture.opened("person.monitor", "--audio mic")) as capture,
    ):
        origin_s = time.monotonic()
        monitor.start(origin_s)
        played.start(origin_s)
        while len(frames) < round(8.0 / FRAME_S):
            capture.pass_on(monitor, 0.02)
            while (time.monotonic() - origin_s) / FRAME_S >= len(taken):
                taken.append(played.take(len(taken)))
            frame = monitor.take(len(frames))
            if frame is not None:
                frames.append(frame)
            assert time.monotonic() < origin_s + PATIENCE_S
    assert played.device == "person"
    whole = np.concatenate([np.zeros(FRAME_SAMPLES, np.float32) if frame is None else frame for frame in taken])
    later_s, alike = found(whole[: 7 * AUDIO_HZ], np.concatenate(frames), 2.0)  # both clocks are being learnt before
    assert np.median(alike) > 0.85
    assert np.median(np.abs(later_s)) < 0.05


@pytest.mark.slow
def test_a_microphone_and_a_loudspeaker_that_were_unplugged_are_lost_and_come_back(hear, sound_server, caplog):
    caplog.set_level(logging.INFO, "sfms_robot")
    hearing = hear("mic:person.monitor", agent=recorded_voice(noise(60.0)), play="person")

    def both(frames):
        return any(len(each.audio) and each.agent_audio is not None and each.agent_audio.any() for each in frames)

    hearing.until(lambda: both(hearing.frames))
    sound_server.unplug("person")
    hearing.until(lambda: set(hearing.source.missing) == {"voice", "agent_audio"})
    assert not any(len(frame.audio) or frame.agent_audio.any() for frame in hearing.seconds(0.4)[-3:])
    sound_server.plug("person")
    hearing.until(lambda: not hearing.source.missing)
    back = len(hearing.frames)
    hearing.until(lambda: both(hearing.frames[back:]))
    assert [frame.time_s for frame in hearing.frames] == pytest.approx(FRAME_S * np.arange(1, len(hearing.frames) + 1))
    told = [record.getMessage() for record in caplog.records]
    assert "microphone: person.monitor gives no more sound; restarting" in told
    assert {"microphone: running again", "loudspeaker: running again"} <= set(told)


def test_a_loudspeaker_that_is_not_there_is_one_line_with_the_choices(sound_server):
    for wanted in ("nobody", "7"):
        with pytest.raises(ConfigError, match=f"^--play {wanted}: no such device .*person") as raised:
            open_playback(wanted, recorded_voice(noise(0.1)))
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("agent_audio", ["none", "device:robot.monitor"])
def test_what_is_not_said_here_is_not_played(agent_audio):
    with pytest.raises(ConfigError, match=f"^--play default: nothing to play of --agent-audio {agent_audio} .*tcp"):
        open_source("none", "none", agent_audio=agent_audio, play="default")


@pytest.mark.slow
def test_what_it_plays_is_taken_out_of_what_it_hears(hear, sound_server, tmp_path):
    """Its loudspeaker is heard by the microphone 50 ms later; nobody else speaks."""
    said = read_audio(data_dir("sim") / "speakers" / "katie" / "speech.flac")[: 6 * AUDIO_HZ]
    soundfile.write(tmp_path / "said.wav", said, AUDIO_HZ)
    sound_server.plug("robot")
    sound_server.load("module-loopback", "source=robot.monitor", "sink=person", "latency_msec=50")
    hearing = hear("mic:person.monitor", agent_audio=str(tmp_path / "said.wav"), play="robot")
    ear = hear("mic:person.monitor", hearing.origin_s)
    read_both(ear, hearing, lambda: len(ear.frames) >= 150)
    assert quieter_db(ear.frames, hearing.frames) > 15.0
