"""The sound server of the tests: the emulated microphone of the package."""

from sfms_robot.emulator.sound_server import ALSA, DEBIAN, SoundServer

__all__ = ["ALSA", "DEBIAN", "SoundServer"]
