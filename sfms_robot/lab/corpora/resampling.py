"""Dyads of other frame rates at 25 fps: what a listener that is streamed through them asks for."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_HZ, FRAME_S, Floats
from sfms_robot.lab.corpora.clips import Dyad, at_rate, samples_of
from sfms_robot.signals.mel import ROWS_PER_FRAME
from sfms_robot.signals.tracks import Track, resample

SPACE: Final = "arkit58"  # in other spaces a frame between two is not always what lies between their numbers


def at_frame_rate(dyad: Dyad) -> Dyad:
    """The dyad at 25 fps, cut to whole frames: motion linear in time, what is counted in frames the newest known.

    Raises ConfigError for other rates in spaces other than arkit58, and for less than one frame.
    """
    if dyad.fps == FRAME_HZ:
        return dyad
    if dyad.space != SPACE:
        raise ConfigError(f"{dyad.name}: {dyad.fps:g} fps in {dyad.space}, a listener is streamed at {FRAME_HZ}")
    frames = int(len(dyad.listener) * FRAME_HZ / dyad.fps + 1e-6)
    if not frames:
        raise ConfigError(f"{dyad.name}: lasts {len(dyad.listener) / dyad.fps:.3f} s, not one frame of {FRAME_S:g} s")

    def voice(samples: Floats | None) -> Floats | None:
        return None if samples is None else samples[: samples_of(frames, FRAME_HZ)]

    def newest(rows: Floats) -> Floats:
        return at_rate(rows, dyad.fps, frames, FRAME_HZ)

    return replace(
        dyad,
        audio=voice(dyad.audio),
        agent_audio=voice(dyad.agent_audio),
        speaker=_motion(dyad.speaker, dyad.fps, frames),
        listener=_motion(dyad.listener, dyad.fps, frames),
        listening=at_rate(dyad.listening, dyad.fps, frames, FRAME_HZ),
        states=None if dyad.states is None else at_rate(dyad.states, dyad.fps, frames, FRAME_HZ),
        mel=None if dyad.mel is None else _mel(dyad.mel, dyad.fps, frames),
        features={name: newest(rows) for name, rows in dyad.features.items()},
        fps=float(FRAME_HZ),
    )


def _mel(rows: Floats, fps: float, frames: int) -> Floats:
    """(4N, 128) at four rows a frame -> (4 * frames, 128): of each time the newest row."""
    return at_rate(rows, ROWS_PER_FRAME * fps, ROWS_PER_FRAME * frames, ROWS_PER_FRAME * FRAME_HZ)


def _motion(motion: Floats, fps: float, frames: int) -> Floats:
    """(N, 58) -> (frames, 58). A frame stands for its end, (i + 1) / rate; the first also for what was before it."""
    ends_s = (np.arange(len(motion)) + 1) / fps
    found = resample(Track(ends_s, motion, frozenset(CHANNELS)), FRAME_HZ, FRAME_S).motion[:frames]
    found[(np.arange(frames) + 1) * FRAME_S < ends_s[0] - 1e-6] = motion[0]
    return found
