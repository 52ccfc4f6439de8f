"""Direction of gaze: the person, looks aside, and eyes that hold a point while the head moves.

`GazeTarget` decides where to look. The aim is a direction in space: to the person's eyes if their place is known,
otherwise straight ahead, and now and then aside. It is added to the listener's own motion of head and eyes, so that
nods and tilts stay. The listener's own looks aside count toward the number that people make.

    place      the median over the last 0.4 s, in the frame of the base: a tracker's noise does not reach the head, and
               the eyes start some 0.2 s after the person, as human eyes do
    eyes       fixate, and jump to the place when it has left a dead zone
    head       follows with its share of the direction, half of it after 0.3 s; the eyes compensate for its motion
    away       a look aside, and back: as often, as long and as far as people do it while they listen or talk
    gone       two seconds without a face: the head goes back to its middle, slowly, and looks around

Looks aside are measured on 14 people in conversation (Dembinsky et al., ETRA 2024, Apache-2.0, fixations at github
psyberlab/eye-gaze-during-conversation-dataset e156145): the gaze is within 5 degrees of the other's face for 95 % of
listening and 60 % of speaking, with 7 and 49 shifts of 5 degrees or more a minute. A look aside is two shifts, so it
lasts 0.86 and 0.98 s in the mean, and a stay near the face 16.3 and 1.47 s. Distances are quantiles (0, 1/4, 1/2, 3/4,
9/10, 1) of those beyond 5 degrees. Three of four are more sideways than vertical; three of four go up, not down.

`GazeHold` holds a direction in space: eye + neck_gain x head. While it is held, the eyes compensate for every degree
that the head turns (the vestibulo-ocular reflex), so that a nod does not shake the gaze. The turn of the head is the
one that the neck will show, not the requested one, because the eyes need not compensate for a turn that intensity or
range removes. The eyes follow the listener only when its gaze has really moved: when both its eyes and its direction in
space have left the dead zone, for a moment. Then they jump, in the time that a human eye takes, and hold again. (If
only the eyes were compared, they would jump at every nod of a listener that already turns its eyes against the head; if
only the direction in space, at every nod of a listener that does not.) If compensation has turned the eyes too far from
those of the listener, they jump back. Lids need no rule: their drives follow eyeLookUp and eyeLookDown, which are
written here.

Random numbers come from the seed and a counter. Every decision takes effect at the latest instant of its tick, so that
no joint jumps, whatever its lead.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from sfms_robot.config import CameraMount, Gaze, Person
from sfms_robot.frames import YAW_PITCH, Doubles, Floats
from sfms_robot.ports import Watched
from sfms_robot.signals.gaze_kinematics import Jump, direction_to, directions, turn
from sfms_robot.signals.rotations import rotation

MEDIAN_S: Final = 0.4
DEAD_ZONE_RAD: Final = math.radians(3.0)
PAUSE_S: Final = 0.12  # shortest pause between two jumps
GONE_S: Final = 2.0
TALKING_S: Final = 0.6  # talking ends this long after the last loud sample: it includes pauses between words
FARTHEST_RAD: Final = np.radians([70.0, 35.0])  # limit of the direction to a person
EYES_KEEP_RAD: Final = np.radians([15.0, 10.0])  # largest turn of the eyes; the neck makes the rest, as in people
HEAD_RATE: Final = 9.0  # 1/s
SLOW_HEAD_RATE: Final = 4.0
EYELESS_AWAY: Final = 0.5  # share of a look aside that a head without eyes makes with its neck
AWAY_RAD: Final = math.radians(5.0)
BACK_RAD: Final = math.radians(3.0)
COUNTED_S: Final = 60.0  # time over which the listener's own looks aside are counted
_QUANTILES: Final = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)


@dataclass(frozen=True)
class Manner:
    """Statistics of looks aside: mean seconds at the face and aside, and quantiles of their angle [deg]."""

    home_s: float
    away_s: float
    far_deg: tuple[float, ...]


LISTENING: Final = Manner(16.3, 0.86, (5.5, 6.9, 10.3, 13.9, 17.9, 20.0))
SPEAKING: Final = Manner(1.47, 0.98, (5.5, 13.2, 18.2, 22.5, 26.4, 30.0))
SEEKING: Final = Manner(2.5, 1.8, (8.0, 12.0, 18.0, 24.0, 28.0, 30.0))  # without a person: chosen, not measured


@dataclass(frozen=True)
class HeadTurn:
    """A turn of the head to `end_rad` (2,) through three equal lags in a row, continuous in speed and acceleration.

    `start` (3, 2): angle, speed and acceleration at `began_s`.
    """

    start: Doubles
    end_rad: Doubles
    began_s: float
    rate: float

    def at(self, times_s: Doubles) -> Doubles:
        """Return angles (N, 2); before the turn those of its start."""
        return self.states(times_s)[:, 0]

    def states(self, times_s: Doubles) -> Doubles:
        """Return angle, speed and acceleration (N, 3, 2)."""
        t = np.maximum(times_s - self.began_s, 0.0)[:, None, None]
        off, slope, bend = self._off
        out: Doubles = (off + (slope + bend * t) * t) * np.exp(-self.rate * t)
        out[:, 0] += self.end_rad
        return out

    @cached_property
    def _off(self) -> tuple[Doubles, Doubles, Doubles]:
        """Constants (3, 2) of the way to the end, exp(A t) (start - end) = (off + slope t + bend t^2) exp(-rate t).

        All poles of A lie at -rate, so the cube of A + rate is 0.
        """
        rate = self.rate
        nilpotent = np.array([[rate, 1.0, 0.0], [0.0, rate, 1.0], [-(rate**3), -3.0 * rate**2, -2.0 * rate]])
        off = self.start.copy()
        off[0] -= self.end_rad
        slope = nilpotent @ off
        return off, slope, 0.5 * (nilpotent @ slope)

    def to(self, end_rad: Doubles, now_s: float, rate: float) -> HeadTurn:
        """Return the turn to another end from now on."""
        return HeadTurn(self.states(np.array([now_s]))[0], end_rad, now_s, rate)


@dataclass(frozen=True)
class Aim:
    """Aim of a tick: directions (N, 2) in space, and the head's part of them (N, 2) [rad]."""

    gaze_rad: Doubles
    head_rad: Doubles


def turned(motion: Floats, aim: Aim) -> Floats:
    """Return a copy of the motion (N, 58) with the head's part of the aim added."""
    out = motion.copy()
    out[:, YAW_PITCH] += aim.head_rad.astype(np.float32)
    return out


@dataclass(frozen=True, kw_only=True)
class AimState:
    """Memory of `GazeTarget` between ticks.

    Attributes:
        gaze: the last jump, in space.
        head, head_before: the turn in force, and the one before it, for earlier instants.
        seen: (time, direction (2,)) to the person over the last 0.4 s, from the base.
        shown: (time, pose (6,)) of the neck over the last half second, for a camera that moves with it.
        person_rad: (2,) direction to the person; changes only when the person leaves the dead zone around it.
        aside_rad: (2,) the look aside, 0 at the face.
        left: time left of this stay, in mean stays of its kind.
        listener_hz: rate of the listener's own looks aside; `listener_away` is True during one.
        draws: number of random draws.
    """

    now_s: float
    gaze: Jump
    head: HeadTurn
    head_before: HeadTurn
    left: float
    seen: tuple[tuple[float, Doubles], ...] = ()
    shown: tuple[tuple[float, Doubles], ...] = ()
    person_rad: Doubles = field(default_factory=lambda: np.zeros(2))
    aside_rad: Doubles = field(default_factory=lambda: np.zeros(2))
    listener_hz: float = 1.0 / LISTENING.home_s
    listener_away: bool = False
    draws: int = 1


class Camera:
    """Conversion of places (..., 3) [m] from the camera's frame (x out of its lens, y left, z up) to that of the base.

    The frame of the head's base has its origin in the middle of the head at home, and stays while the neck moves. A
    camera on the head moves with `pose` (6,), which the neck shows at that instant, so turning the neck does not move
    the person. For a camera on the base `pose` is not used.
    """

    def __init__(self, mount: CameraMount) -> None:
        self.on_head = mount.on == "head"
        self._at_m = np.array(mount.at_m)
        self._turned = rotation(np.radians(mount.rpy_deg))

    def to_base(self, place_m: Floats | Doubles, pose: Doubles) -> Doubles:
        mounted: Doubles = np.asarray(place_m, np.float64) @ self._turned.T + self._at_m
        if not self.on_head:
            return mounted
        return mounted @ rotation(pose[:3]).T + pose[3:]


class GazeTarget:
    """Choice of where to look. `gaze` None: a head without eyes; `camera` None: places of people are not known."""

    def __init__(self, config: Person, gaze: Gaze | None, camera: CameraMount | None, seed: int) -> None:
        self.camera = Camera(camera) if camera else None
        self._full_rad = gaze.full_rad if gaze else np.zeros(2)
        self._eyeless = gaze is None
        self._neck = gaze is None or gaze.neck_gain > 0
        self._share = 1.0 if gaze is None else config.head_share
        self._often = config.look_away
        self._seed = seed % 2**63  # numpy accepts no negative seed

    def step(
        self, motion: Floats, times_s: Doubles, now_s: float, watched: Watched, state: AimState | None
    ) -> tuple[Aim, AimState]:
        """Return the aim at (N,) instants, for the listener's motion (N, 58), row 0 at `now_s`, and the next state."""
        if state is None:
            still = HeadTurn(np.zeros((3, 2)), np.zeros(2), now_s, HEAD_RATE)
            gaze = Jump.between(np.zeros(2), np.zeros(2), now_s)
            state = AimState(now_s=now_s, gaze=gaze, head=still, head_before=still, left=self._stay(1, False))
        gone = watched.seen_s is not None and now_s - watched.seen_s > GONE_S
        state = self._located(watched, now_s, state)
        state = self._counted(motion[0], now_s - state.now_s, watched, state)
        manner = SEEKING if gone else SPEAKING if now_s - watched.said_s < TALKING_S else LISTENING
        state = self._looked_away(manner, now_s, watched.by_hand, state)
        state = self._decided(times_s, gone, watched.by_hand, replace(state, now_s=now_s))
        head_rad, before = state.head.at(times_s), times_s < state.head.began_s
        if before.any():
            head_rad[before] = state.head_before.at(times_s[before])
        return Aim(state.gaze.at(times_s), head_rad), state

    def remember(self, now_s: float, pose: Doubles, state: AimState) -> AimState:
        """Return the state with the pose (6,) that the neck shows at `now_s`, from which a camera on the head sees."""
        return replace(state, shown=(*(each for each in state.shown if now_s - each[0] <= 0.5), (now_s, pose)))

    def _located(self, watched: Watched, now_s: float, state: AimState) -> AimState:
        """Return the state with the newest sighting and the direction to the person after it."""
        if self.camera is None:
            return state
        if state.seen and now_s - state.seen[-1][0] > GONE_S:
            state = replace(state, seen=(), person_rad=np.zeros(2))
        seen_s, last_s = watched.seen_s, state.seen[-1][0] if state.seen else now_s - GONE_S
        if watched.place_m is None or seen_s is None or seen_s <= last_s:
            return state
        poses = [pose for time_s, pose in state.shown if time_s <= seen_s + 1e-9] or [np.zeros(6)]
        there = direction_to(self.camera.to_base(watched.place_m, poses[-1]))
        near = (each for each in state.seen if seen_s - each[0] <= MEDIAN_S)
        seen = (*near, (seen_s, np.clip(there, -FARTHEST_RAD, FARTHEST_RAD)))
        median_rad = np.median([direction for _, direction in seen], axis=0)
        moved = math.dist(median_rad, state.person_rad) > DEAD_ZONE_RAD
        return replace(state, seen=seen, person_rad=median_rad if moved else state.person_rad)

    def _counted(self, listener: Floats, dt_s: float, watched: Watched, state: AimState) -> AimState:
        """Return the state after counting a look aside of the listener itself; `listener` (58,) is its motion."""
        looks_rad = listener[YAW_PITCH].astype(np.float64)
        if not self._eyeless:
            looks_rad = looks_rad + directions(listener, self._full_rad).mean(axis=0)
        away = math.hypot(*looks_rad) > (BACK_RAD if state.listener_away else AWAY_RAD)
        began = away and not state.listener_away and not watched.by_hand
        hz = state.listener_hz * math.exp(-dt_s / COUNTED_S) + (1.0 / COUNTED_S if began else 0.0)
        return replace(state, listener_hz=hz, listener_away=away)

    def _looked_away(self, manner: Manner, now_s: float, by_hand: bool, state: AimState) -> AimState:
        """Return the state with the look aside of this tick, or without one."""
        away = bool(state.aside_rad.any())
        if by_hand or not self._often:
            return replace(state, aside_rad=np.zeros(2)) if away else state
        dt_s = now_s - state.now_s
        wanted_hz = self._often / manner.home_s
        lacking = max(1.0 - state.listener_hz / wanted_hz, 0.0)
        left = state.left - (dt_s / manner.away_s if away else dt_s * wanted_hz * lacking)
        if left > 0 or (state.listener_away and not away):
            return replace(state, left=left)
        draws = state.draws + 1
        aside_rad = np.zeros(2) if away else self._aside(manner, draws)
        return replace(state, left=self._stay(draws, not away), aside_rad=aside_rad, draws=draws)

    def _stay(self, draw: int, away: bool) -> float:
        """Return the length of the next stay, in units of the mean stay: 1 in the mean."""
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
        """Return the state with eyes and head on their way to the target."""
        latest_s, earliest_s = float(times_s.max()), float(times_s.min())
        person_rad = np.zeros(2) if by_hand else state.person_rad
        gaze_rad = person_rad + state.aside_rad
        over = latest_s - state.gaze.end_s >= max(PAUSE_S, latest_s - earliest_s)
        if over and not np.array_equal(gaze_rad, state.gaze.end_rad):
            state = replace(state, gaze=Jump.between(state.gaze.end_rad, gaze_rad, latest_s))
        if not self._neck:
            head_rad = np.zeros(2)
        elif self._eyeless:
            head_rad = person_rad + (1.0 if gone else EYELESS_AWAY) * state.aside_rad * [1.0, 0.0]
        else:
            left_rad = gaze_rad - self._share * (gaze_rad if gone else person_rad)
            head_rad = gaze_rad - np.clip(left_rad, -EYES_KEEP_RAD, EYES_KEEP_RAD)
        if earliest_s >= state.head.began_s and not np.array_equal(head_rad, state.head.end_rad):
            turn = state.head.to(head_rad, latest_s, SLOW_HEAD_RATE if gone else HEAD_RATE)
            state = replace(state, head=turn, head_before=state.head)
        return state


# --- Holding ----------------------------------------------------------------------------------------------------------

ShownPose = Callable[[Floats], Doubles]  # motion (N, 58) -> the pose (N, 6) that the neck will show


@dataclass(frozen=True)
class HoldState:
    """Memory of `GazeHold` between ticks.

    Attributes:
        jump: the last jump, in space; its end is the held direction.
        eyes_rad: (2,) direction of the listener's eyes when the jump was decided.
        away_since_s: time since which the listener's gaze has been elsewhere.
    """

    jump: Jump
    eyes_rad: Doubles
    away_since_s: float | None = None


class GazeHold:
    """Fixations and saccades in place of the eye channels of a motion."""

    def __init__(self, config: Gaze) -> None:
        self._gain = config.neck_gain
        self._dead_zone_rad = math.radians(config.dead_zone_deg)
        self._recentre_rad = math.radians(config.recentre_deg)
        self._settle_s = config.settle_ms / 1e3
        self._pause_s = config.pause_ms / 1e3
        self.full_rad = config.full_rad

    def step(
        self,
        motion: Floats,
        times_s: Doubles,
        state: HoldState | None,
        shown_pose: ShownPose,
        aim: Aim | None,
    ) -> tuple[Floats, HoldState]:
        """Return motion (N, 58) at (N,) instants with new eyes; `state` None begins by holding the present gaze.

        `aim`: added to the held direction; the head turns by its part.
        """
        both_rad = directions(motion, self.full_rad)  # (N, eye, axis)
        eyes_rad = 0.5 * (both_rad[:, 0] + both_rad[:, 1])
        head_rad = self._head(motion, times_s, shown_pose)
        last = int(np.argmax(times_s))
        state = self._decided(eyes_rad[last], head_rad[last], times_s, state)
        apart_rad = both_rad - eyes_rad[:, None]  # the listener's vergence is kept
        held_rad = state.jump.at(times_s)
        out = motion.copy()
        if aim is not None:
            held_rad = held_rad + aim.gaze_rad
            if aim.head_rad.any():
                out = turned(motion, aim)
                head_rad = self._head(out, times_s, shown_pose)
        turn(out, (held_rad - head_rad)[:, None] + apart_rad, self.full_rad)
        return out, state

    def _head(self, motion: Floats, times_s: Doubles, shown_pose: ShownPose) -> Doubles:
        """Return yaw and pitch (N, 2) that the eyes compensate for. Joints share leads: each instant is solved once."""
        if self._gain == 0:
            pose: Floats | Doubles = motion
        else:
            _, first, which = np.unique(times_s, return_index=True, return_inverse=True)
            pose = shown_pose(motion[first])[which]
        return self._gain * pose.take(YAW_PITCH, axis=-1).astype(np.float64)

    def _decided(self, eyes_rad: Doubles, head_rad: Doubles, times_s: Doubles, state: HoldState | None) -> HoldState:
        """Return the state for the listener's gaze at the latest of the instants."""
        now_s = float(times_s.max())
        target_rad = eyes_rad + head_rad
        if state is None:
            return HoldState(Jump.between(target_rad, target_rad, now_s), eyes_rad)
        held_rad = state.jump.end_rad
        off_rad = math.dist(target_rad, held_rad)
        shifted = min(off_rad, math.dist(eyes_rad, state.eyes_rad)) > self._dead_zone_rad
        if not shifted and off_rad <= self._recentre_rad:
            return replace(state, away_since_s=None)
        since_s = now_s if state.away_since_s is None else state.away_since_s
        spread_s = now_s - float(times_s.min())  # the last jump has to be over at the earliest instant
        free = now_s - state.jump.end_s >= max(self._pause_s, spread_s)
        if not free or now_s - since_s < self._settle_s - 1e-9:
            return replace(state, away_since_s=since_s)
        return HoldState(Jump.between(held_rad, target_rad, now_s), eyes_rad)
