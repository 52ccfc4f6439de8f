"""What a listener takes from the other's face as it comes: they nod, they smile, they laugh, their mouth moves.

Trackers lie: a face may be upside down, stuck, saturated or all noise. So everything is judged against the face's own
last second or running neutral, which a constant becomes; turns count modulo a whole one; and what stands out from how
the head swings anyway, by talking or by noise, is a nod. What is taken for a laugh is a broad smile over a mouth that
opens and closes: somebody who talks and beams at once is taken for laughing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, SMILE_CORNERS, FaceFrame, changed

NOD_RAD: Final = math.radians(2.0)  # a swing there, within a second, and most of it back
BACK: Final = 0.6
WINDOW: Final = 25  # frames
NODS_APART: Final = 30  # frames; more than a window, so that no swing counts twice
STANDS_OUT: Final = 4.0  # times as far as the head swung over the last seconds, on average
SMILE: Final = 0.25  # over the neutral
BEAM: Final = 0.35
HELD_FRAMES: Final = 6
OPENING: Final = 0.02  # mean change of jawOpen per frame of a mouth that moves
_SMOOTH: Final = 0.5  # share of a new value
_NEUTRAL_RISE: Final = 0.02 * FRAME_S  # of the smile's neutral: somebody who always beams is neutral within a minute
_NEUTRAL_FALL: Final = 0.1
_MOTION: Final = 0.12
_SWAY: Final = FRAME_S / 8.0  # of the mean swing: some eight seconds
_CORNERS: Final = [CHANNEL_INDEX[name] for name in SMILE_CORNERS]
_JAW: Final = CHANNEL_INDEX["jawOpen"]
_PITCH: Final = CHANNEL_INDEX["pitch"]


@dataclass(frozen=True)
class Signs:
    """Of one frame: a nod has just been seen; the person smiles, laughs; the mouth moves as in speech."""

    nods: bool = False
    smiles: bool = False
    laughs: bool = False
    mouth_moves: bool = False


@dataclass(frozen=True)
class FaceState:
    """What is remembered of a face.

    Attributes:
        frame: how many have been asked for.
        pitch_rad: smoothed, unwrapped, of the last second.
        nodded: frame of the newest nod; sway_rad: mean swing of the last seconds.
        neutral, held: of the smile: its neutral, and for how many frames it has been up.
        jaw, opening: jawOpen, and how much it changes per frame.
    """

    frame: int = 0
    pitch_rad: tuple[float, ...] = ()
    nodded: int = -NODS_APART
    sway_rad: float = 0.0
    neutral: float | None = None
    held: int = 0
    jaw: float = 0.0
    opening: float = 0.0


def read_signs(face: FaceFrame | None, state: FaceState) -> tuple[Signs, FaceState]:
    """One frame of 40 ms. Without a face, or with one that holds what is not finite, nothing is seen."""
    motion = None if face is None else face.motion
    if motion is None or not np.isfinite(motion).all():
        return Signs(), changed(state, frame=state.frame + 1, pitch_rad=(), held=0, opening=0.0)
    pitch, left, right, jaw = (motion.item(channel) for channel in (_PITCH, *_CORNERS, _JAW))
    nods, state = _nod(pitch, state)
    smiles, beams, state = _smile(_within((left + right) / 2), state)
    jaw = _within(jaw)
    opening = state.opening + _MOTION * (abs(jaw - state.jaw) - state.opening)
    moves = opening > OPENING
    return Signs(nods, smiles, beams and moves, moves), changed(state, frame=state.frame + 1, jaw=jaw, opening=opening)


def _within(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _nod(pitch_rad: float, state: FaceState) -> tuple[bool, FaceState]:
    before = state.pitch_rad
    smoothed = before[-1] + _SMOOTH * math.remainder(pitch_rad - before[-1], 2 * math.pi) if before else pitch_rad
    pitch = (*before, smoothed)[-WINDOW:]
    swing = max(_swing(pitch), _swing([-p for p in pitch]))
    stands_out = swing >= max(NOD_RAD, STANDS_OUT * state.sway_rad)
    new = stands_out and state.frame - state.nodded >= NODS_APART
    sway = state.sway_rad + _SWAY * (swing - state.sway_rad)
    return new, changed(state, pitch_rad=pitch, nodded=state.frame if new else state.nodded, sway_rad=sway)


def _swing(values: tuple[float, ...] | list[float]) -> float:
    """How far up it went, if by now it is most of the way back; else 0."""
    top = max(values)
    risen = top - min(values[: values.index(top) + 1])
    return risen if top - values[-1] >= BACK * risen else 0.0


def _smile(level: float, state: FaceState) -> tuple[bool, bool, FaceState]:
    """Smiles, beams; after it has been up for a quarter of a second."""
    neutral = level if state.neutral is None else state.neutral
    neutral += _NEUTRAL_FALL * (level - neutral) if level < neutral else min(_NEUTRAL_RISE, level - neutral)
    over = level - neutral
    held = state.held + 1 if over > SMILE * (0.6 if state.held >= HELD_FRAMES else 1.0) else 0
    smiles = held >= HELD_FRAMES
    return smiles, smiles and over > BEAM, changed(state, neutral=neutral, held=held)
