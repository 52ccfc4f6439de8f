"""Dyads played to a running listener, frame by frame as `run` does, and what it did and in which state it was."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfms_robot.corpora.clips import Dyad
from sfms_robot.corpora.states import UNKNOWN
from sfms_robot.frames import FRAME_SAMPLES, MOTION_DIM, Floats, SpeakerFrame
from sfms_robot.learning.rollout import frames_of
from sfms_robot.listeners.arig.stream import Memory
from sfms_robot.ports import Listener


@dataclass(frozen=True)
class Played:
    """What a listener made of a dyad: motion (N, 58), states (N,) int8, -1 before the first and for other kinds."""

    motion: Floats
    states: NDArray[np.int8]


def speaker_frames(dyad: Dyad) -> list[SpeakerFrame]:
    """Both tracks as a source gives them: frame i carries what the agent says in frame i + 1."""
    frames = frames_of(dyad.audio, dyad.speaker)
    if dyad.agent_audio is None:
        return frames
    said = np.concatenate([dyad.agent_audio, np.zeros(FRAME_SAMPLES, np.float32)])
    return [
        SpeakerFrame(frame.time_s, frame.audio, frame.face, said[(i + 1) * FRAME_SAMPLES : (i + 2) * FRAME_SAMPLES])
        for i, frame in enumerate(frames)
    ]


def play(listener: Listener, dyad: Dyad, seed: int) -> Played:
    """One dyad from its beginning; a plan counts until the next one."""
    frames = speaker_frames(dyad)
    memory = listener.start(seed)
    motion = np.zeros((len(frames) + listener.horizon, MOTION_DIM), np.float32)
    states = np.full(len(frames) + 1, UNKNOWN, np.int8)
    for index, frame in enumerate(frames):
        plan, memory = listener.step(frame, memory)
        if plan is not None:
            motion[index + 1 : index + 1 + listener.horizon] = plan.frames
        if isinstance(memory, Memory):
            states[index + 1] = memory.state
    return Played(motion[: len(frames)], states[: len(frames)])


def play_all(
    listener: Listener, dyads: Sequence[Dyad], seed: int, each: Callable[[], None] = lambda: None
) -> list[Played]:
    """Every dyad, each with a seed of its own; `each()` after every one."""
    out = []
    for number, dyad in enumerate(dyads):
        out.append(play(listener, dyad, seed + number))
        each()
    return out
