"""Motion of eyes and head from gaze targets, one 40 ms frame at a time, and eye channels as angles.

The eyes leave first and arrive 40 to 120 ms later (the main sequence of saccades). The head follows with its share,
which is near 0 below 8 degrees and grows with the angle of the target, on a minimum-jerk path (bell-shaped speed), and
ends later. Throughout, the eyes compensate for the head (vestibulo-ocular reflex): the angle of an eye in the head is
gaze minus head, also while the head nods or sways. The eyes wander over a target in fixations of 228 ms (median) with
steps of 0.9 degrees (median), as people's do while they listen; a larger step is a gaze shift, decided elsewhere.

Laws: N frames at once equal the N frames one by one. Gaze (head and eyes together) is within 3 degrees of the target
200 ms after a shift of up to 30 degrees between targets that eyes can reach, and within 1.5 degrees during a nod of 8
degrees. The head's angle and speed never jump; on a still target the head's part is constant. Mirrored targets yield a
mirrored head, and mirrored eyes if they do not wander. Values that are not finite are refused.

Lids are not moved here: heads couple them with eyeLookUp and eyeLookDown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, POSE, Doubles, Floats, changed
from sfms_robot.signals.minimum_jerk import ease, minimum_jerk

EYE_PAN_RAD: Final = math.radians(30)  # angle of an eyeLook channel of 1, sideways
EYE_TILT_RAD: Final = math.radians(20)
EYES_RAD: Final = np.array([EYE_PAN_RAD, EYE_TILT_RAD])
# Columns of a motion row that are set here for the eyes.
EYE_CHANNELS: Final = tuple(
    CHANNEL_INDEX[f"eyeLook{way}{side}"] for side in ("Left", "Right") for way in ("Down", "In", "Out", "Up")
)
PURSUIT_RAD: Final = math.radians(1)  # a smaller move of the target is followed; a larger one causes a gaze shift

_EYES_ALONE_RAD: Final = math.radians(10)  # approximate angle that is left to the eyes
_SHARES: Final = (0.5, 0.75)  # the head's share of the remaining angle, from person to person
_TILT_SHARE: Final = 0.8  # factor of the head's share for pitch, which is smaller than for yaw
_ROLL: Final = -0.08  # share of the yaw
_SACCADE_S: Final = (0.021, 0.0022, 0.04, 0.12)  # duration at 0, increase per degree, least, most
_HEAD_S: Final = (0.3, 0.012)  # duration at 0, increase per degree of its turn
_SPOT_RAD: Final = (math.radians(0.55), math.radians(1.3))  # deviation from the target, and its limit including drift
_DRIFT_RAD_S: Final = math.radians(0.2)
_FIXATION_S: Final = (0.228, 0.48, 0.11)  # median, deviation of its logarithm, least

Pair = tuple[float, float]  # yaw, pitch
Axis = tuple[float, float, float]  # angle, speed, acceleration


@dataclass(frozen=True, kw_only=True)
class GazeState:
    """State of eyes and head between two frames. Angles are in space, (yaw, pitch).

    Attributes:
        seed: seed of the fixations.
        wanders: True if the eyes move over their target.
        share: the head's share of the angle that is not left to the eyes.
        target_rad: the last target.
        gaze_rad: direction of head and eyes together.
        from_rad, shift_s, since_s: start, duration and elapsed time of the shift in progress.
        number, spot_rad, drift_rad_s, left_s: number of the fixation, offset from the target, drift, time left.
        head: the head's part, yaw and pitch.
        head_left_s: time until the head arrives.
    """

    seed: int
    wanders: bool
    share: float
    target_rad: Pair = (0.0, 0.0)
    gaze_rad: Pair = (0.0, 0.0)
    from_rad: Pair = (0.0, 0.0)
    shift_s: float = 0.04
    since_s: float = 1.0
    number: int = 0
    spot_rad: Pair = (0.0, 0.0)
    drift_rad_s: Pair = (0.0, 0.0)
    left_s: float = 0.0
    head: tuple[Axis, Axis] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    head_left_s: float = 0.0


def start(seed: int, wanders: bool = True) -> GazeState:
    """Return the state of a look straight ahead; the head's share of a look is drawn from `seed`."""
    return GazeState(seed=seed, wanders=wanders, share=float(np.random.default_rng(seed).uniform(*_SHARES)))


def follow(targets_rad: ArrayLike, poses: ArrayLike, state: GazeState) -> tuple[Floats, Floats, list[GazeState]]:
    """Return the gaze of N frames of 40 ms: the head's part (N, 3), the eyes (N, 8), and the state after each.

    Args:
        targets_rad: (N, 2) yaw and pitch in space, (0, 0) at the person; from the beginning of each frame on.
        poses: (N, 6) poses of the head without its part of the look, at the end of each frame.

    The head's part is roll, pitch, yaw [rad]; the eyes are values of `EYE_CHANNELS`, 0..1. Raises ValueError for a
    value that is not finite.
    """
    targets, heads = np.asarray(targets_rad, np.float64), np.asarray(poses, np.float64)[:, POSE]
    if not (np.isfinite(targets).all() and np.isfinite(heads[:, 1:3]).all()):
        raise ValueError("gaze targets or head poses are not finite")
    turns: list[tuple[float, ...]] = []
    looks: list[tuple[float, ...]] = []
    states = []
    for (yaw, pitch), (tilted, turned) in zip(targets.tolist(), heads[:, 1:3].tolist(), strict=True):
        head, eyes, state = _step((yaw, pitch), (turned, tilted), state)
        turns.append(head)
        looks.append(eyes)
        states.append(state)
    found = np.array(turns, np.float32).reshape(-1, 3), np.array(looks, np.float32).reshape(-1, len(EYE_CHANNELS))
    return *found, states


def head_part(gaze_rad: ArrayLike) -> Floats:
    """Return the head's part (N, 3) of looking in directions (N, 2), yaw and pitch, for an average person.

    It separates looks from other motion of the head. A direction that is not finite counts as straight ahead.
    """
    gaze = np.nan_to_num(np.asarray(gaze_rad, np.float64), posinf=0.0, neginf=0.0)
    if not len(gaze):
        return np.zeros((0, 3), np.float32)
    yaw, pitch = gaze[0].tolist()
    state = changed(start(0, wanders=False), share=sum(_SHARES) / 2, target_rad=(yaw, pitch), gaze_rad=(yaw, pitch))
    head, _, _ = follow(gaze, np.zeros((len(gaze), 6)), state)
    return head


def _step(target: Pair, body: Pair, state: GazeState) -> tuple[tuple[float, ...], tuple[float, ...], GazeState]:
    """Return the head's part (roll, pitch, yaw), the eyes (`EYE_CHANNELS`), and the state after one frame."""
    state = _aimed(target, state)
    since_s, left_s = state.since_s + FRAME_S, max(0.0, state.left_s - FRAME_S)
    part = minimum_jerk(min(1.0, since_s / state.shift_s))
    goal = head_share(target, state.share)
    yaw = _towards(state.head[0], goal[0], state.head_left_s)
    pitch = _towards(state.head[1], goal[1], state.head_left_s)
    head = (yaw[0] + body[0], pitch[0] + body[1])
    begun, spot, drift = state.from_rad, state.spot_rad, state.drift_rad_s
    pan = begun[0] + part * (target[0] + spot[0] + drift[0] * since_s - begun[0]) - head[0]
    tilt = begun[1] + part * (target[1] + spot[1] + drift[1] * since_s - begun[1]) - head[1]
    pan, tilt = max(-EYE_PAN_RAD, min(pan, EYE_PAN_RAD)), max(-EYE_TILT_RAD, min(tilt, EYE_TILT_RAD))
    after = changed(
        state,
        gaze_rad=(head[0] + pan, head[1] + tilt),
        since_s=since_s,
        left_s=left_s,
        head=(yaw, pitch),
        head_left_s=max(0.0, state.head_left_s - FRAME_S),
    )
    left, right = max(0.0, pan) / EYE_PAN_RAD, max(0.0, -pan) / EYE_PAN_RAD
    down, up = max(0.0, tilt) / EYE_TILT_RAD, max(0.0, -tilt) / EYE_TILT_RAD
    return (_ROLL * yaw[0], pitch[0], yaw[0]), (down, right, left, up, down, left, right, up), after


def _aimed(target: Pair, state: GazeState) -> GazeState:
    """Return the state with the shift that begins now, if any: to another target, or to the next spot on this one."""
    moved = 0.0 if target == state.target_rad else math.dist(target, state.target_rad)
    if moved > 0:
        turn_rad = math.dist(head_share(target, state.share), (state.head[0][0], state.head[1][0]))
        state = changed(state, target_rad=target, head_left_s=_HEAD_S[0] + _HEAD_S[1] * math.degrees(turn_rad))
    if moved > PURSUIT_RAD or (state.wanders and state.left_s <= 1e-9):
        state = _fixated(state) if state.wanders else state
    elif moved == 0:
        return state
    far = math.dist((target[0] + state.spot_rad[0], target[1] + state.spot_rad[1]), state.gaze_rad)
    first, each, least, most = _SACCADE_S
    shift_s = max(least, min(first + each * math.degrees(far), most))
    return changed(state, from_rad=state.gaze_rad, shift_s=shift_s, since_s=0.0)


def _fixated(state: GazeState) -> GazeState:
    """Return the state with the next fixation, whose spot, drift and length depend on the seed and its number alone."""
    spread, most = _SPOT_RAD
    x, y, drift_x, drift_y, long = _drawn(state.seed, state.number)
    narrow = spread * min(1.0, most / max(spread * math.hypot(x, y), 1e-9))
    median_s, deviation, least_s = _FIXATION_S
    left_s = max(least_s, median_s * math.exp(deviation * long))
    spot, drift = (narrow * x, narrow * y), (_DRIFT_RAD_S * drift_x, _DRIFT_RAD_S * drift_y)
    last = (spot[0] + drift[0] * left_s, spot[1] + drift[1] * left_s)
    far = math.hypot(*last)
    if far > most:  # a straight drift between two points within the limit stays within it
        drift = ((last[0] * most / far - spot[0]) / left_s, (last[1] * most / far - spot[1]) / left_s)
    return changed(state, number=state.number + 1, spot_rad=spot, drift_rad_s=drift, left_s=left_s)


@lru_cache(maxsize=1024)  # plans overlap: most fixations are needed by several plans
def _drawn(seed: int, number: int) -> tuple[float, ...]:
    """Return the random numbers of one fixation."""
    return tuple(np.random.default_rng((seed, number)).standard_normal(5).tolist())


def head_share(target_rad: Pair, share: float) -> Pair:
    """Return the head's part (yaw, pitch) of a look at the target: near 0 for small angles, then rising by `share`."""
    far = math.hypot(*target_rad)
    if far < 1e-9:
        return 0.0, 0.0
    part = share * (math.hypot(far, _EYES_ALONE_RAD) - _EYES_ALONE_RAD) / far
    return part * target_rad[0], _TILT_SHARE * part * target_rad[1]


def _towards(axis: Axis, goal: float, left_s: float) -> Axis:
    """Return angle, speed and acceleration a frame later on the minimum-jerk path that rests at `goal` in `left_s`."""
    if left_s <= FRAME_S + 1e-9:
        return goal, 0.0, 0.0
    x, v, a = axis
    d, v_t, a_t = goal - x, v * left_s, a * left_s**2
    c3, c4, c5 = (20 * d - 12 * v_t - 3 * a_t) / 2, (-30 * d + 16 * v_t + 3 * a_t) / 2, (12 * d - 6 * v_t - a_t) / 2
    s = FRAME_S / left_s
    return (
        x + s * (v_t + s * (a_t / 2 + s * (c3 + s * (c4 + s * c5)))),
        (v_t + s * (a_t + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / left_s,
        (a_t + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))) / left_s**2,
    )


# --- Eye channels as angles and back: (yaw, pitch), yaw + to the head's left, pitch + down ----------------------------

# Yaw and pitch of the left eye, then of the right one.
_PLUS = np.array([CHANNEL_INDEX[f"eyeLook{way}"] for way in ("OutLeft", "DownLeft", "InRight", "DownRight")])
_MINUS = np.array([CHANNEL_INDEX[f"eyeLook{way}"] for way in ("InLeft", "UpLeft", "OutRight", "UpRight")])


def directions(motion: Floats, full_rad: Doubles) -> Doubles:
    """Return the directions (..., 2, 2) of motion (..., 58): left and right eye, yaw and pitch [rad].

    `full_rad` (2,): angles for a channel of 1.
    """
    turned = motion.take(_PLUS, axis=-1).astype(np.float64) - motion.take(_MINUS, axis=-1)
    return turned.reshape(*motion.shape[:-1], 2, 2) * full_rad


def turn(motion: Floats, directions_rad: Doubles, full_rad: Doubles) -> None:
    """Write directions (..., 2, 2) into `motion` (..., 58), limited to the range of the channels."""
    share = (directions_rad / full_rad).reshape(*motion.shape[:-1], 4)
    motion[..., _PLUS] = np.minimum(np.maximum(share, 0.0), 1.0)
    motion[..., _MINUS] = np.minimum(np.maximum(-share, 0.0), 1.0)


def direction_to(place_m: Doubles) -> Doubles:
    """Return yaw and pitch (..., 2) [rad] of a look from the origin to the place (..., 3)."""
    x, y, z = np.moveaxis(place_m, -1, 0)
    return np.stack([np.arctan2(y, x), -np.arctan2(z, np.hypot(x, y))], axis=-1)


@dataclass(frozen=True)
class Jump:
    """A saccade: directions (2,) [rad] at its start and end, and its time."""

    start_rad: Doubles
    end_rad: Doubles
    began_s: float
    duration_s: float

    @classmethod
    def between(cls, start_rad: Doubles, end_rad: Doubles, began_s: float) -> Jump:
        """Return a jump of human duration: 25 ms and 2.35 ms per degree ("Eyes Alive", Lee et al. 2002)."""
        size_deg = math.degrees(float(np.hypot(*(end_rad - start_rad))))
        return cls(start_rad, end_rad, began_s, 0.025 + 0.00235 * size_deg)

    @property
    def end_s(self) -> float:
        return self.began_s + self.duration_s

    def at(self, times_s: Doubles) -> Doubles:
        """Return directions (N, 2) at (N,) instants."""
        share = ease((times_s - self.began_s) / self.duration_s)[:, None]
        return self.start_rad + share * (self.end_rad - self.start_rad)
