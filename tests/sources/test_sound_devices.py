"""Which device a name means, and what is said where it means none."""

import ctypes.util
import os
import sys

import pytest

from sfms_robot.errors import ConfigError, PortError
from sfms_robot.sources.sound_devices import SoundDevice, choose_device, portaudio

FLAG = "--audio mic"
BUILT_IN = SoundDevice(name="HDA Intel PCH: ALC257 Analog (hw:0,0)", number=0, channels=2, rate_hz=44_100.0)
USB = SoundDevice(name="USB PnP Sound Device: Audio (hw:1,0)", number=4, channels=1, rate_hz=48_000.0)
ARRAY = SoundDevice(name="ReSpeaker 4 Mic Array: USB Audio (hw:2,0)", number=5, channels=6, rate_hz=16_000.0)
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


def test_one_of_two_like_devices_is_told_by_its_card():
    twin = SoundDevice(name="USB PnP Sound Device: Audio (hw:6,0)", number=9, channels=1, rate_hz=48_000.0)
    assert choose_device([USB, twin], twin.name, FLAG) is twin
    with pytest.raises(ConfigError, match=r"^--audio mic:PnP: fits several devices \(4 USB PnP .*, 9 USB PnP .*\)$"):
        choose_device([USB, twin], "PnP", FLAG)


def test_what_is_not_there_is_said_with_what_is():
    with pytest.raises(ConfigError, match=r"^--audio mic:nobody: no such device \(4 USB PnP .*, robot\.monitor\)$"):
        choose_device([USB, MONITOR], "nobody", FLAG)


def test_where_nothing_records_what_else_there_is_to_hear_is_said():
    with pytest.raises(PortError, match=r"^--audio mic: this computer has no microphone.*FILE\.wav, .*katie, none\)$"):
        choose_device([], "", FLAG)


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
