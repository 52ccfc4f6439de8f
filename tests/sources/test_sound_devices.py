"""Sound devices: the one that a name means, and blocks as PortAudio hands them over and takes them."""

import ctypes.util
import os
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from sfms_robot.errors import ConfigError, PortError
from sfms_robot.frames import FRAME_SAMPLES
from sfms_robot.sources.live_voice import LiveVoice
from sfms_robot.sources.playback import PlaybackStream, leaves_after_s
from sfms_robot.sources.sound_devices import Capture, SoundDevice, captured_s, choose_device, portaudio

FLAG = "--audio mic"
BUILT_IN = SoundDevice(name="HDA Intel PCH: ALC257 Analog (hw:0,0)", number=0, channels=2, rate_hz=44_100.0)
USB = SoundDevice(name="USB PnP Sound Device: Audio (hw:1,0)", number=4, channels=1, rate_hz=48_000.0)
ARRAY = SoundDevice(name="ReSpeaker 4 Mic Array: USB Audio (hw:2,0)", number=5, channels=6, rate_hz=16_000.0)
TWIN = SoundDevice(name="USB PnP Sound Device: Audio (hw:6,0)", number=9, channels=1, rate_hz=48_000.0)
SERVER = SoundDevice(name="pulse", number=8, channels=32, rate_hz=44_100.0, default=True)
SOURCE = SoundDevice(name="alsa_input.usb-PnP.mono", number=8, channels=32, rate_hz=44_100.0, of_server=True)
MONITOR = SoundDevice(name="robot.monitor", number=8, channels=32, rate_hz=44_100.0, of_server=True)
ALL = [BUILT_IN, USB, ARRAY, SERVER, SOURCE, MONITOR]


@pytest.mark.parametrize(
    ("wanted", "device"),
    [
        ("", SERVER),
        ("4", USB),
        ("8", SERVER),  # and none of its sources
        ("pulse", SERVER),
        ("respeaker", ARRAY),
        ("hw:0,0", BUILT_IN),
        ("robot.monitor", MONITOR),
        ("USB PnP Sound Device: Audio (hw:3,0)", USB),  # it was card 3 before it was plugged in again
    ],
)
def test_a_device_is_chosen_by_number_name_or_part_of_its_name(wanted, device):
    assert choose_device(ALL, wanted, FLAG) is device


@pytest.mark.parametrize(
    ("devices", "wanted", "error", "text"),
    [
        ([USB, TWIN], "PnP", ConfigError, r"^--audio mic:PnP: fits several devices \(4 USB PnP .*, 9 USB PnP .*\)$"),
        ([USB, MONITOR], "no", ConfigError, r"^--audio mic:no: no such device \(4 USB PnP .*, robot\.monitor\)$"),
        ([], "", PortError, r"^--audio mic: this computer has no microphone.*FILE\.wav, .*katie, none\)$"),
    ],
)
def test_a_name_that_means_no_device_or_several_is_refused_with_the_choices(devices, wanted, error, text):
    assert choose_device([USB, TWIN], TWIN.name, FLAG) is TWIN
    with pytest.raises(error, match=text):
        choose_device(devices, wanted, FLAG)


def test_a_source_of_the_sound_server_is_chosen_while_it_is_opened(monkeypatch):
    monkeypatch.setenv("PULSE_SOURCE", "mine")
    with MONITOR.selected():
        assert os.environ["PULSE_SOURCE"] == "robot.monitor"
    with USB.selected():
        assert os.environ["PULSE_SOURCE"] == "mine"
    assert os.environ["PULSE_SOURCE"] == "mine"
    monkeypatch.delenv("PULSE_SOURCE")
    with MONITOR.selected():
        pass
    assert "PULSE_SOURCE" not in os.environ


def test_without_portaudio_its_package_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "sounddevice", raising=False)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    with pytest.raises(ConfigError, match="^--audio mic needs PortAudio: sudo apt-get install libportaudio2$"):
        portaudio(FLAG)


@pytest.mark.parametrize(
    ("first_age_s", "expected_s"),
    [
        (0.03, 99.98),  # the newest of 10 ms is 20 ms old
        (None, 100.0),  # no time stamp
        (-0.005, 100.0),  # never after now
        (1e6, 100.0),  # of another clock
        (-1e6, 100.0),
        (float("nan"), 100.0),
    ],
)
def test_a_piece_came_when_its_device_says_so_where_that_can_be(first_age_s, expected_s):
    assert captured_s(100.0, first_age_s, 0.01) == pytest.approx(expected_s)


@pytest.mark.parametrize("channels", [1, 2, 16])
def test_of_many_channels_the_one_with_the_voice_is_heard(channels, caplog):
    """Pieces as PortAudio hands them over, at a rate that no voice needs, with what is no sound in one of them."""
    capture = Capture(SoundDevice(name="array", number=3, channels=channels, rate_hz=192_000.0), 192_000.0, channels)
    voice, origin_s = LiveVoice(name="array"), time.monotonic() - 0.5
    voice.start(origin_s)
    piece = np.zeros((9_600, channels), np.float32)
    piece[:, 0], piece[:, 1:] = 0.25, -0.05
    no_stamp = SimpleNamespace(currentTime=5.0, inputBufferAdcTime=0.0)
    for number in range(8):
        samples = piece.copy()
        if number == 2:
            samples[::2], samples[1::2] = np.nan, 1e-42
        capture._called(samples, len(samples), no_stamp, SimpleNamespace(input_overflow=False))
    capture.pass_on(voice, 0.0)
    told = voice.statistics()
    assert told["rate_hz"] == 192_000 and told["not_finite"] == 4_800 * channels
    heard = np.concatenate([frame for frame in map(voice.take, range(40)) if frame is not None])
    assert np.abs(heard).max() == pytest.approx(0.25, abs=0.06) and heard.any()
    line = f"array: the mean of {channels} channels loses the voice"
    assert caplog.text.count(line) == (channels > 1) and (line in voice.mix.line) == (channels > 1)


def test_a_device_that_gives_no_more_sound_went_away():
    capture = Capture(SoundDevice(name="array", number=3, channels=1, rate_hz=16_000.0), 16_000.0, 1)
    capture.pass_on(LiveVoice(), 0.0)
    capture._called_s -= 1.1 * capture.lost_s
    with pytest.raises(PortError, match="^array gives no more sound$"):
        capture.pass_on(LiveVoice(), 0.0)


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
    stamp = SimpleNamespace(outputBufferDacTime=5.2, currentTime=5.0)
    out = np.ones((480, channels), np.float32)
    stream._called(out, 480, stamp, SimpleNamespace(output_underflow=False))
    assert out[:, :2] == pytest.approx(np.full((480, min(channels, 2)), 0.25), abs=1e-5) and not out[:, 2:].any()
