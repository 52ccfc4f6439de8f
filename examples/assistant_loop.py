"""An assistant connected to a robot: it receives the robot's microphone, and the head moves with its speech.

Run `sfms-robot run --agent-audio tcp` in one terminal and this in another. docs/reference/protocol.md has the messages.
"""

import json
import struct
import sys
import time

import numpy as np
from websockets.sync.client import connect

HEADER = struct.Struct("<BBHIdd")  # kind, version, 0, samples a second; times of sending, and of recording or playback
SPEECH, RATE_HZ = 3, 24_000
HELLO = {"type": "hello", "version": 1, "name": "assistant", "feeds": ["speech"], "wants": ["microphone", "events"]}


def answer(seconds: float) -> bytes:
    """Return a tone as long as the speech, at most 2 s; put your recognition, language model and synthesis here."""
    tone = np.sin(2 * np.pi * 180 * np.arange(round(min(seconds, 2.0) * RATE_HZ)) / RATE_HZ)
    return (6000 * tone).astype("<i2").tobytes()


heard_s, quiet_s = 0.0, 0.0
with connect(sys.argv[1] if len(sys.argv) > 1 else "ws://127.0.0.1:8765") as robot:
    robot.send(json.dumps(HELLO))
    for message in robot:  # until the robot stops
        if isinstance(message, str):
            told = json.loads(message)
            print(told.get("state") or told.get("event") or told["type"], flush=True)
            continue
        sound = np.frombuffer(message, "<i2", offset=HEADER.size)
        loud = np.abs(sound.astype(float)).mean() > 300
        heard_s, quiet_s = (heard_s + 0.04, 0.0) if loud else (heard_s, quiet_s + 0.04)
        if heard_s > 0.5 and quiet_s > 0.3:  # the person has spoken and pauses
            now_s = time.monotonic()  # play it on your loudspeaker 0.2 s from now
            robot.send(HEADER.pack(SPEECH, 1, 0, RATE_HZ, now_s, now_s + 0.2) + answer(heard_s))
            heard_s = 0.0
