"""Sound in memory as a recorded voice, through a file that holds exactly the samples (n,)."""

import tempfile

import soundfile

from sfms_robot.frames import AUDIO_HZ
from sfms_robot.signals.audio import AudioFile
from sfms_robot.sources.recording import RecordedVoice


def recorded_voice(samples, loop=False):
    with tempfile.NamedTemporaryFile(suffix=".wav") as file:
        soundfile.write(file.name, samples, AUDIO_HZ, "FLOAT")
        return RecordedVoice(AudioFile(file.name), loop)
