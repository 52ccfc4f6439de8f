"""Whom the head looks at, and how it looks away.

What is aimed at is a direction in space: to the person's eyes where their place is known, else straight ahead, and now
and then beside it. It is added to what the listener does with head and eyes, so that nods and tilts stay, and looks
aside that the listener itself asks for count among those that people make.

    place      the median over the last 0.4 s, in the frame of the base: a tracker's noise does not reach the head, and
               the eyes start some 0.2 s after the person, as human eyes do
    eyes       fixate, and jump to the place when it has left a dead zone
    head       follows with its share of the direction, half of it after 0.3 s; the eyes give back what it brings
    away       a look aside, and back: as often, as long and as far as people do it while they listen or talk
    gone       two seconds without a face: the head goes back to its middle, slowly, and looks around

How people look away is measured on 14 people in conversation (Dembinsky et al., ETRA 2024, Apache-2.0, fixations at
github psyberlab/eye-gaze-during-conversation-dataset e156145): within 5 degrees of the other's face for 95 % of
listening and 60 % of speaking, 7 and 49 shifts of 5 degrees or more a minute. A look aside is two shifts, so it lasts
0.86 and 0.98 s in the mean, and stays near the face 16.3 and 1.47 s. How far it goes are quantiles (0, 1/4, 1/2, 3/4,
9/10, 1) of what lies beyond 5 degrees; mostly sideways (three of four), mostly up (three of four).

Chance comes from the seed and a counter. Whatever is decided begins at the latest instant of the tick, so that no
joint, whatever its lead, jumps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from sfms_robot.config import CameraMount, Gaze, Person
from sfms_robot.frames import YAW_PITCH, Doubles, Floats
from sfms_robot.ports import Watched
from sfms_robot.signals.eye_angles import Jump, direction_to, directions
from sfms_robot.signals.rotations import rotation

MEDIAN_S: Final = 0.4
DEAD_ZONE_RAD: Final = math.radians(3.0)
PAUSE_S: Final = 0.12  # between two jumps
GONE_S: Final = 2.0
TALKING_S: Final = 0.6  # after the last loud sample: pauses between words are part of talking
FARTHEST_RAD: Final = np.radians([70.0, 35.0])  # a person beyond is looked at as far as this
EYES_KEEP_RAD: Final = np.radians([15.0, 10.0])  # what is left over the neck takes, as people's does
HEAD_RATE: Final = 9.0  # 1/s
SLOW_HEAD_RATE: Final = 4.0
EYELESS_AWAY: Final = 0.5  # of a look aside, for a head that has only its neck to do it with
AWAY_RAD: Final = math.radians(5.0)
BACK_RAD: Final = math.radians(3.0)
COUNTED_S: Final = 60.0  # over which the listener's own looks aside are counted
_QUANTILES: Final = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)


@dataclass(frozen=True)
class Manner:
    """How somebody looks away: mean seconds at the face and aside, and how far aside [deg]."""

    home_s: float
    away_s: float
    far_deg: tuple[float, ...]


LISTENING: Final = Manner(16.3, 0.86, (5.5, 6.9, 10.3, 13.9, 17.9, 20.0))
SPEAKING: Final = Manner(1.47, 0.98, (5.5, 13.2, 18.2, 22.5, 26.4, 30.0))
SEEKING: Final = Manner(2.5, 1.8, (8.0, 12.0, 18.0, 24.0, 28.0, 30.0))  # nobody there: chosen, not measured


@dataclass(frozen=True)
class HeadTurn:
    """A head that goes to `end_rad` (2,) as three equal lags in a row do: speed and acceleration go on where they were.

    `start` (3, 2): angle, speed and acceleration at `began_s`.
    """

    start: Doubles
    end_rad: Doubles
    began_s: float
    rate: float

    def at(self, times_s: Doubles) -> Doubles:
        """Angles (N, 2); before it began as at its start."""
        if not self.start.any() and not self.end_rad.any():
            return np.zeros((len(times_s), 2))
        t = np.maximum(times_s - self.began_s, 0.0)[:, None]
        off, slope, bend = self._lags()
        angles: Doubles = self.end_rad + (off + (slope + bend * t) * t) * np.exp(-self.rate * t)
        return angles

    def state_at(self, now_s: float) -> Doubles:
        """Angle, speed and acceleration (3, 2)."""
        t = max(now_s - self.began_s, 0.0)
        off, slope, bend = self._lags()
        off, slope, bend = off + (slope + bend * t) * t, slope + 2 * bend * t, 2 * bend
        faded = [off, slope - self.rate * off, bend - 2 * self.rate * slope + self.rate**2 * off]
        state: Doubles = np.array(faded) * math.exp(-self.rate * t)
        state[0] += self.end_rad
        return state

    def _lags(self) -> tuple[Doubles, Doubles, Doubles]:
        """The way to the end is (off + slope t + bend t^2) exp(-rate t): a cubic pole, its three constants (2,)."""
        angle, speed, acceleration = self.start
        off = angle - self.end_rad
        slope = speed + self.rate * off
        return off, slope, 0.5 * (acceleration + 2 * self.rate * speed + self.rate**2 * off)

    def to(self, end_rad: Doubles, now_s: float, rate: float) -> HeadTurn:
        """On to another end from now on."""
        return HeadTurn(self.state_at(now_s), end_rad, now_s, rate)


@dataclass(frozen=True)
class Aim:
    """Where a tick looks: directions (N, 2) in space, and what of them the head turns (N, 2) [rad]."""

    gaze_rad: Doubles
    head_rad: Doubles


def turned(motion: Floats, aim: Aim) -> Floats:
    """Motion (N, 58) with the head's part of the aim; a copy."""
    out = motion.copy()
    out[:, YAW_PITCH] += aim.head_rad.astype(np.float32)
    return out


def _nowhere() -> Doubles:
    return np.zeros(2)


@dataclass(frozen=True)
class AimState:
    """What is remembered between ticks.

    Attributes:
        gaze: the last jump, in space.
        head, head_before: the turn in force, and the one that instants before it belong to.
        seen: (time, direction (2,)) to the person over the last 0.4 s, from the base.
        shown: (time, pose (6,)) of the neck over the last half second, for a camera that goes with it.
        person_rad: (2,) where they are looked for; the last that left the dead zone.
        aside_rad: (2,) the look aside, 0 at the face.
        left: what is left of this stay, in mean stays of its kind.
        listener_hz: the listener's own looks aside; `listener_away` while one lasts.
        draws: how often chance was asked.
    """

    now_s: float
    gaze: Jump
    head: HeadTurn
    head_before: HeadTurn
    left: float
    seen: tuple[tuple[float, Doubles], ...] = ()
    shown: tuple[tuple[float, Doubles], ...] = ()
    person_rad: Doubles = field(default_factory=_nowhere)
    aside_rad: Doubles = field(default_factory=_nowhere)
    listener_hz: float = 1.0 / LISTENING.home_s
    listener_away: bool = False
    draws: int = 1


class Camera:
    """Places (..., 3) [m] in the camera's frame (x out of its lens, y left, z up) <-> in that of the base.

    The frame of the head's base has its origin in the middle of the head at home, and stays while the neck moves. A
    camera on the head goes with `pose` (6,), which the neck shows at that instant, so turning the neck does not move
    the person; a camera on the base does not use it.
    """

    def __init__(self, mount: CameraMount) -> None:
        self.on_head = mount.on == "head"
        self._at_m = np.array(mount.at_m)
        self._turned = rotation(np.radians(mount.rpy_deg))

    def to_base(self, place_m: Floats | Doubles, pose: Doubles) -> Doubles:
        mounted: Doubles = np.asarray(place_m, np.float64) @ self._turned.T + self._at_m
        if not self.on_head:
            return mounted
        moved: Doubles = mounted @ rotation(pose[:3]).T + pose[3:]
        return moved

    def from_base(self, place_m: Floats | Doubles, pose: Doubles) -> Doubles:
        mounted = np.asarray(place_m, np.float64)
        if self.on_head:
            mounted = (mounted - pose[3:]) @ rotation(pose[:3])
        seen: Doubles = (mounted - self._at_m) @ self._turned
        return seen


class GazeTarget:
    """Decides where to look. `gaze` None: a head without eyes; `camera` None: a place cannot be told."""

    def __init__(self, config: Person, gaze: Gaze | None, camera: CameraMount | None, seed: int) -> None:
        self.camera = Camera(camera) if camera else None
        self._full_rad = gaze.full_rad if gaze else np.zeros(2)
        self._eyeless = gaze is None
        self._neck = gaze is None or gaze.neck_gain > 0
        self._share = 1.0 if gaze is None else config.head_share
        self._often = config.look_away
        self._seed = seed % 2**63  # numpy takes no negative seed

    def step(
        self, motion: Floats, times_s: Doubles, now_s: float, watched: Watched, state: AimState | None
    ) -> tuple[Aim, AimState]:
        """Where to look at (N,) instants, for what a listener asks (N, 58), row 0 at `now_s`."""
        if state is None:
            still = HeadTurn(np.zeros((3, 2)), _nowhere(), now_s, HEAD_RATE)
            state = AimState(now_s, Jump.between(_nowhere(), _nowhere(), now_s), still, still, self._stay(1, False))
        gone = watched.seen_s is not None and now_s - watched.seen_s > GONE_S
        state = self._located(watched, now_s, state)
        state = self._counted(motion[0], now_s - state.now_s, watched, state)
        state = self._looked_away(_manner(watched, now_s, gone), now_s, watched.by_hand, state)
        state = self._decided(times_s, gone, watched.by_hand, replace(state, now_s=now_s))
        head_rad, before = state.head.at(times_s), times_s < state.head.began_s
        if before.any():
            head_rad[before] = state.head_before.at(times_s[before])
        return Aim(state.gaze.at(times_s), head_rad), state

    def remember(self, now_s: float, pose: Doubles, state: AimState) -> AimState:
        """`pose` (6,) is what the neck shows at `now_s`: a camera on it sees from there."""
        kept = tuple(each for each in state.shown if now_s - each[0] <= 0.5)
        return replace(state, shown=(*kept, (now_s, pose)))

    def _located(self, watched: Watched, now_s: float, state: AimState) -> AimState:
        """The state with the newest sighting, and where the person is looked for after it."""
        if self.camera is None:
            return state
        if state.seen and now_s - state.seen[-1][0] > GONE_S:
            state = replace(state, seen=(), person_rad=_nowhere())
        seen_s, last_s = watched.seen_s, state.seen[-1][0] if state.seen else now_s - GONE_S
        if watched.place_m is None or seen_s is None or seen_s <= last_s:
            return state
        poses = [pose for time_s, pose in state.shown if time_s <= seen_s + 1e-9] or [np.zeros(6)]
        there = direction_to(self.camera.to_base(watched.place_m, poses[-1]))
        near = tuple(each for each in state.seen if seen_s - each[0] <= MEDIAN_S)
        seen = (*near, (seen_s, np.clip(there, -FARTHEST_RAD, FARTHEST_RAD)))
        median_rad = np.median([direction for _, direction in seen], axis=0)
        moved = math.dist(median_rad, state.person_rad) > DEAD_ZONE_RAD
        return replace(state, seen=seen, person_rad=median_rad if moved else state.person_rad)

    def _counted(self, listener: Floats, dt_s: float, watched: Watched, state: AimState) -> AimState:
        """The state after seeing where the listener looks, one row (58,)."""
        looks_rad = listener[YAW_PITCH].astype(np.float64)
        if not self._eyeless:
            looks_rad = looks_rad + directions(listener, self._full_rad).mean(axis=0)
        away = math.hypot(*looks_rad) > (BACK_RAD if state.listener_away else AWAY_RAD)
        began = away and not state.listener_away and not watched.by_hand
        hz = state.listener_hz * math.exp(-dt_s / COUNTED_S) + (1.0 / COUNTED_S if began else 0.0)
        return replace(state, listener_hz=hz, listener_away=away)

    def _looked_away(self, manner: Manner, now_s: float, by_hand: bool, state: AimState) -> AimState:
        """The state with this tick's look aside, or none."""
        away = bool(state.aside_rad.any())
        if by_hand or not self._often:
            return replace(state, aside_rad=_nowhere()) if away else state
        dt_s = now_s - state.now_s
        wanted_hz = self._often / manner.home_s
        lacking = min(max(1.0 - state.listener_hz / wanted_hz, 0.0), 1.0)
        left = state.left - (dt_s / manner.away_s if away else dt_s * wanted_hz * lacking)
        if left > 0 or (state.listener_away and not away):
            return replace(state, left=left)
        draws = state.draws + 1
        aside_rad = _nowhere() if away else self._aside(manner, draws)
        return replace(state, left=self._stay(draws, not away), aside_rad=aside_rad, draws=draws)

    def _stay(self, draw: int, away: bool) -> float:
        """Mean stays that the next one lasts: 1 in the mean."""
        rng = np.random.default_rng([self._seed, draw, 1])
        return float(rng.gamma(2.0, 0.5)) if away else 0.1 + 0.9 * float(rng.exponential())

    def _aside(self, manner: Manner, draw: int) -> Doubles:
        rng = np.random.default_rng([self._seed, draw, 2])
        far_rad = math.radians(float(np.interp(rng.uniform(), _QUANTILES, manner.far_deg)))
        slope_rad = math.radians(60.0) * float(rng.uniform())  # from the horizon: under 45 degrees in three of four
        yaw = far_rad * math.cos(slope_rad) * (1.0 if rng.uniform() < 0.5 else -1.0)
        pitch = far_rad * math.sin(slope_rad) * (1.0 if rng.uniform() < 0.27 else -1.0)
        return np.array([yaw, min(max(pitch, -EYES_KEEP_RAD[1]), EYES_KEEP_RAD[1])])

    def _decided(self, times_s: Doubles, gone: bool, by_hand: bool, state: AimState) -> AimState:
        """The state with eyes and head on their way to what is to be looked at."""
        latest_s, earliest_s = float(times_s.max()), float(times_s.min())
        person_rad = _nowhere() if by_hand else state.person_rad
        gaze_rad = person_rad + state.aside_rad
        over = latest_s - state.gaze.end_s >= max(PAUSE_S, latest_s - earliest_s)
        if over and not np.array_equal(gaze_rad, state.gaze.end_rad):
            state = replace(state, gaze=Jump.between(state.gaze.end_rad, gaze_rad, latest_s))
        head_rad = self._head_of(person_rad, state.aside_rad, gone)
        if earliest_s >= state.head.began_s and not np.array_equal(head_rad, state.head.end_rad):
            turn = state.head.to(head_rad, latest_s, SLOW_HEAD_RATE if gone else HEAD_RATE)
            state = replace(state, head=turn, head_before=state.head)
        return state

    def _head_of(self, person_rad: Doubles, aside_rad: Doubles, gone: bool) -> Doubles:
        """What of these directions the neck turns."""
        if not self._neck:
            return _nowhere()
        if self._eyeless:
            return person_rad + (1.0 if gone else EYELESS_AWAY) * aside_rad * [1.0, 0.0]
        wanted_rad = person_rad + aside_rad
        head_rad = self._share * (wanted_rad if gone else person_rad)
        kept_rad: Doubles = np.clip(wanted_rad - head_rad, -EYES_KEEP_RAD, EYES_KEEP_RAD)
        return wanted_rad - kept_rad


def _manner(watched: Watched, now_s: float, gone: bool) -> Manner:
    if gone:
        return SEEKING
    return SPEAKING if now_s - watched.said_s < TALKING_S else LISTENING
