"""Attention of a person to the robot's head, from the direction of the person's head and eyes relative to a neutral.

Gaze is head plus eyes. A person looking at the camera from the side turns to it, so the direction to the camera is
subtracted first if the place of the eyes is known. The remaining gaze has a neutral that is not 0, because of a phone
that stands aside, a tracker's offset, or a camera next to the head. It is learned as a running median (every frame
moves it by the same small step, for any distance), quickly in the first seconds of a face and slowly after, so that
looks aside for less than half of the time do not become the neutral.

Laws: a blink changes nothing; attention is under 0.2 within 0.3 s of a look 30 degrees aside; a larger angle never has
more attention; there is no value without a face, or from a face whose head and eyes have not turned (a tracker of the
mouth alone).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sfms_robot.frames import BLINKS, YAW_PITCH, Doubles, FaceFrame, Floats
from sfms_robot.signals.gaze_kinematics import EYES_RAD, direction_to, directions

HALF_RAD: Final = math.radians(10.0)  # angle of attention 0.5: about twice the scatter of gaze from a face tracker
SLOPE_RAD: Final = math.radians(2.0)
SMOOTH_S: Final = 0.1
CLOSED: Final = 0.5  # value of eyeBlink; the eye channels of a closed eye are meaningless
BLINK_S: Final = 0.5  # eyes that are closed for longer look at nothing
NEUTRAL_START_RAD_S: Final = math.radians(6.0)
NEUTRAL_RAD_S: Final = math.radians(0.3)
SETTLE_S: Final = 4.0
FORGET_S: Final = 10.0  # a face that appears after this time counts as another person


@dataclass(frozen=True, kw_only=True)
class AttentionState:
    """Memory of a face.

    Attributes:
        time_s: time of the last face; None before the first.
        seen_s: total time with open eyes.
        neutral_rad: (2,) yaw and pitch of a gaze at the head.
        eyes_rad: (2,) direction of the last open eyes, at `open_s`.
        attention: attention of the last face.
        turns: True once head or eyes have not been at zero.
    """

    time_s: float | None = None
    seen_s: float = 0.0
    neutral_rad: Doubles = field(default_factory=lambda: np.zeros(2))
    eyes_rad: Doubles = field(default_factory=lambda: np.zeros(2))
    open_s: float = -math.inf
    attention: float = 0.0
    turns: bool = False


def attend(face: FaceFrame, place_m: Floats | None, state: AttentionState) -> tuple[float | None, AttentionState]:
    """Return the attention (0..1) of a face, None if unknown, and the state after it.

    `place_m` (3,): see `frames.Sighting`. A face that is not newer than the last one changes nothing.
    """
    if state.time_s is not None and face.time_s <= state.time_s:
        return state.attention if state.turns else None, state
    first = state.time_s is None or face.time_s - state.time_s > FORGET_S
    before = AttentionState(open_s=face.time_s) if first else state
    dt_s = 0.0 if before.time_s is None else face.time_s - before.time_s
    motion = face.motion
    closed = float(motion[BLINKS].mean()) > CLOSED
    eyes_rad = before.eyes_rad if closed else directions(motion, EYES_RAD).mean(axis=0)
    gaze_rad = motion[YAW_PITCH] + eyes_rad
    if place_m is not None:  # a person at the camera's left turns to their own left, and one above it looks down
        gaze_rad = gaze_rad - direction_to(np.asarray(place_m, np.float64)) * [1.0, -1.0]
    neutral_rad, seen_s, open_s = before.neutral_rad, before.seen_s, before.open_s
    if not closed:  # one step of a running median
        speed_rad_s = NEUTRAL_RAD_S + (NEUTRAL_START_RAD_S - NEUTRAL_RAD_S) * math.exp(-seen_s / SETTLE_S)
        off_rad = gaze_rad - neutral_rad
        neutral_rad = neutral_rad + off_rad * min(1.0, speed_rad_s * dt_s / max(float(np.hypot(*off_rad)), 1e-9))
        seen_s, open_s = seen_s + dt_s, face.time_s
    looks = _at(float(np.hypot(*(gaze_rad - neutral_rad)))) if face.time_s - open_s <= BLINK_S else 0.0
    attention = looks if first else looks + (before.attention - looks) * math.exp(-dt_s / SMOOTH_S)
    turns = before.turns or bool(motion[YAW_PITCH].any() or directions(motion, EYES_RAD).any())
    after = AttentionState(
        time_s=face.time_s,
        seen_s=seen_s,
        neutral_rad=neutral_rad,
        eyes_rad=eyes_rad,
        open_s=open_s,
        attention=attention,
        turns=turns,
    )
    return attention if turns else None, after


def _at(angle_rad: float) -> float:
    """Return the attention of a gaze that is `angle_rad` away from the head, falling with the angle."""
    return 1.0 / (1.0 + math.exp((angle_rad - HALF_RAD) / SLOPE_RAD))
