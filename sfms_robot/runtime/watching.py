"""What the loop tells a head's life of the person: where they were seen, and whether the robot itself talks."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, Floats, SpeakerFrame
from sfms_robot.ports import Watched
from sfms_robot.signals.audio import energy_db

SPEECH_DB: Final = -40.0  # the robot's own voice, a clean signal, is louder than this when it talks
_TURNING: Final = [CHANNEL_INDEX[name] for name in CHANNELS if name in ("yaw", "pitch") or name.startswith("eyeLook")]


def watch(frame: SpeakerFrame, watched: Watched) -> Watched:
    """What is known of the person after one more frame. One without a face leaves them where they were seen."""
    if frame.agent_audio is not None and energy_db(frame.agent_audio) > SPEECH_DB:
        watched = replace(watched, said_s=frame.time_s)
    if frame.face is None:
        return watched
    return replace(watched, seen_s=frame.face.time_s, place_m=frame.place_m, attention=frame.attention)


def turned_by_hand(planned: Floats, asked: Floats) -> bool:
    """Whether what is asked (N, 58) turns head or eyes otherwise than the listener planned (N, 58)."""
    return asked is not planned and not np.array_equal(asked[:, _TURNING], planned[:, _TURNING])
