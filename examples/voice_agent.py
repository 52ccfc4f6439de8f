"""A voice agent: sound from your microphone or call, sound to your loudspeaker, and a head that listens."""

import sys
import time

import numpy as np
import soundfile

import sfms_robot as sr
from sfms_robot.data import data_dir

RATE_HZ, PIECE_S = 48_000, 0.02  # as browsers or telephone calls deliver it


def microphone(seconds: float) -> np.ndarray:
    """Return a recorded person, int16; put your microphone here."""
    voice, rate_hz = soundfile.read(data_dir("sim") / "speakers" / "katie" / "speech.flac", dtype="int16")
    return voice[(np.arange(round(seconds * RATE_HZ)) * rate_hz / RATE_HZ).astype(int) % len(voice)]


def text_to_speech(text: str) -> np.ndarray:
    """Return half a second of a tone, float -1..1 at 24 kHz; put your synthesis here."""
    return 0.1 * np.sin(2 * np.pi * 180 * np.arange(12_000) / 24_000)


heard = microphone(float(sys.argv[1]) if len(sys.argv) > 1 else 15.0)
piece = round(RATE_HZ * PIECE_S)
with sr.Robot("face28", port="sim", listener="sfms-small") as robot:
    robot.on("nod", lambda nod: robot.say(text_to_speech("mm-hm"), rate_hz=24_000))  # play it 40 ms later
    begin_s = time.monotonic()
    for start in range(0, len(heard), piece):
        robot.hear(heard[start : start + piece], rate_hz=RATE_HZ)
        due_s = begin_s + (start + piece) / RATE_HZ  # paced by the clock, or it lags; an audio callback paces itself
        if robot.wait(due_s - time.monotonic()):
            break
report = robot.report()
print(report["frames"], "frames heard,", report["motion"])
