"""Spontaneous motion of a head, added to the sampled face before it is mapped: sway, gaze, glances and blinks.

`HeadLife` applies the parts in this order, because the eyes hold their point against the idle head motion as well as
against the listener's, and a glance leaves from the held point. The aim is kept apart from the direction in which the
listener looks, because the hold judges the listener alone.

`IdleFiller` adds blinks, small head motion and glances where the listener makes none. Each kind watches its own
channels of the listener. Head motion and glances fade in while those channels are still and fade out four times as fast
when they move. A clock decides when the next blink is due. It runs only as far as the listener's rate, over about the
last five blinks, is below the wanted rate. At the start the listener counts as if it had made enough motion.

Head motion is a sum of slow sines. Glances and blinks are events that begin at or after the latest instant of a tick,
so every instant can be evaluated independently, whatever the lead of a joint. Random numbers come from the seed and a
counter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sfms_robot.config import CameraMount, Gaze, Idle, Life
from sfms_robot.frames import BLINKS, CHANNEL_INDEX, Doubles, Floats
from sfms_robot.ports import Watched
from sfms_robot.retarget.gaze import AimState, GazeHold, GazeTarget, HoldState, ShownPose, turned
from sfms_robot.signals.gaze_kinematics import Jump, directions, turn
from sfms_robot.signals.minimum_jerk import ease

ENOUGH = 0.8  # no blinks are added to a listener with this share of the wanted ones
CLOSING_S, CLOSED_S, OPENING_S = 0.08, 0.04, 0.18  # a spontaneous blink, whole and a little slow for lid servos
_HEAD = slice(CHANNEL_INDEX["roll"], CHANNEL_INDEX["yaw"] + 1)
_SWING = np.array([0.35, 0.6, 1.0])  # roll, pitch, yaw, as shares of head_deg
_HZ = np.array([[0.05, 0.11, 0.17], [0.06, 0.13, 0.21], [0.04, 0.09, 0.19]])
_SIZES = np.array([0.5, 0.3, 0.2])
_BLINK_ON, _BLINK_OFF = 0.5, 0.25
_CLEAR_S = 1.0  # no blink is added this soon after one of the listener


@dataclass(frozen=True, kw_only=True)
class BlinkState:
    """Memory of blinks: the listener's rate per second, the clock, its value when a blink is due, the last blink."""

    rate: float
    due_at: float
    clock: float = 0.0
    closed: bool = False
    seen_s: float = -math.inf
    began_s: float = -math.inf


@dataclass(frozen=True, kw_only=True)
class IdleState:
    """Memory of `IdleFiller` between ticks.

    Attributes:
        now_s, head_rad, eyes_rad: the listener at the tick before, (3,) and (2,).
        head, eyes: how far idle motion of each has faded in, 0..1.
        glance: the last glance, relative to the listener's gaze; `glance_s`: time at which the next is due.
        draws: number of random draws.
    """

    now_s: float
    head_rad: Doubles
    eyes_rad: Doubles
    blink: BlinkState
    glance: Jump
    glance_s: float
    head: float = 0.0
    eyes: float = 0.0
    draws: int = 1


class IdleFiller:
    """Idle motion in place of motion that the listener lacks. `full_rad` (2,): the eye's angles for a channel of 1."""

    def __init__(self, config: Idle, full_rad: Doubles, seed: int) -> None:
        self._blinks_per_s = config.blinks_per_minute / 60.0
        self._head_rad = math.radians(config.head_deg) * _SWING
        self._glance_rad = math.radians(config.glance_deg)
        self._still_rad_s = math.radians(config.still_deg_s)
        self._fade_s = config.fade_s
        self._full_rad = full_rad
        self._seed = seed % 2**63  # numpy accepts no negative seed
        self._phases = np.random.default_rng([self._seed, 0]).uniform(0, 2 * math.pi, _HZ.shape)

    def watch(self, motion: Floats, times_s: Doubles, now_s: float, state: IdleState | None) -> IdleState:
        """Return the state after the listener's motion (N, 58) at (N,) instants, row 0 for `now_s`."""
        head_rad = motion[0, _HEAD].astype(np.float64)
        eyes_rad = directions(motion[0], self._full_rad).mean(axis=0)
        if state is None:
            nowhere = Jump.between(np.zeros(2), np.zeros(2), now_s)
            blink = BlinkState(rate=self._blinks_per_s, due_at=self._until_blink(1))
            return IdleState(
                now_s=now_s, head_rad=head_rad, eyes_rad=eyes_rad, blink=blink, glance=nowhere, glance_s=now_s
            )
        dt_s = max(now_s - state.now_s, 0.0)
        state = replace(
            state,
            head=self._faded(state.head, float(np.abs(head_rad - state.head_rad).max()), dt_s),
            eyes=self._faded(state.eyes, float(np.abs(eyes_rad - state.eyes_rad).max()), dt_s),
            now_s=now_s,
            head_rad=head_rad,
            eyes_rad=eyes_rad,
        )
        return self._glanced(self._blinked(motion, times_s, dt_s, state), times_s)

    def sway(self, motion: Floats, times_s: Doubles, state: IdleState) -> Floats:
        """Return the motion with small head motion added."""
        if not (state.head and self._head_rad.any()):
            return motion
        waves = np.sin(2 * math.pi * _HZ * times_s[:, None, None] + self._phases) @ _SIZES  # (N, 3)
        out = motion.copy()
        out[:, _HEAD] += (float(ease(np.array(state.head))) * self._head_rad * waves).astype(np.float32)
        return out

    def look(self, motion: Floats, times_s: Doubles, state: IdleState) -> Floats:
        """Return the motion with glances and blinks added."""
        since_s = times_s - state.blink.began_s
        open_eyed = since_s.min() >= CLOSING_S + CLOSED_S + OPENING_S
        if open_eyed and not (state.eyes and self._glance_rad):
            return motion
        out = motion.copy()
        if state.eyes and self._glance_rad:
            aside_rad = float(ease(np.array(state.eyes))) * state.glance.at(times_s)
            turn(out, directions(motion, self._full_rad) + aside_rad[:, None], self._full_rad)
        if open_eyed:
            return out
        opening = ease((since_s - CLOSING_S - CLOSED_S) / OPENING_S)
        lid = (ease(since_s / CLOSING_S) - opening).astype(np.float32)
        out[:, BLINKS] = np.maximum(out[:, BLINKS], lid[:, None])
        return out

    def _faded(self, before: float, moved_rad: float, dt_s: float) -> float:
        still = moved_rad <= self._still_rad_s * dt_s
        return min(max(before + (dt_s if still else -4.0 * dt_s) / self._fade_s, 0.0), 1.0)

    def _blinked(self, motion: Floats, times_s: Doubles, dt_s: float, state: IdleState) -> IdleState:
        wanted = self._blinks_per_s
        if not wanted:
            return state
        blink, level = state.blink, float(motion[0, BLINKS].max())
        onset = level > _BLINK_ON and not blink.closed
        closed = level > (_BLINK_OFF if blink.closed else _BLINK_ON)
        rate = blink.rate * math.exp(-dt_s * wanted / 5) + (wanted / 5 if onset else 0.0)
        lacking = max(1.0 - rate / (ENOUGH * wanted), 0.0)
        clock = 0.0 if onset else blink.clock + dt_s * wanted * lacking
        seen_s = state.now_s if closed else blink.seen_s
        blink = replace(blink, rate=rate, clock=clock, closed=closed, seen_s=seen_s)
        clear = state.now_s - seen_s >= _CLEAR_S and float(motion[:, BLINKS].max()) < _BLINK_OFF
        if clock < blink.due_at or not clear:
            return replace(state, blink=blink)
        draws = state.draws + 1
        blink = replace(blink, clock=0.0, due_at=self._until_blink(draws), began_s=float(times_s.max()))
        return replace(state, blink=blink, draws=draws)

    def _until_blink(self, draw: int) -> float:
        """Return the time to the next blink in mean intervals: 1 in the mean, never under 0.4."""
        return 0.4 + 0.6 * float(np.random.default_rng([self._seed, draw]).exponential())

    def _glanced(self, state: IdleState, times_s: Doubles) -> IdleState:
        now_s = float(times_s.max())
        if not self._glance_rad or now_s < state.glance_s:
            return state
        draws = state.draws + 1
        rng = np.random.default_rng([self._seed, draws])
        aside = rng.uniform(-1, 1, 2) * [self._glance_rad, self._glance_rad / 2]
        target_rad = np.zeros(2) if rng.uniform() < 0.5 else aside  # half of the glances go back to the person's face
        jump = Jump.between(state.glance.end_rad, target_rad, now_s)
        return replace(state, glance=jump, glance_s=now_s + 0.8 + float(rng.exponential(1.8)), draws=draws)


@dataclass(frozen=True)
class LifeState:
    """Memory of `HeadLife`; None before the first step."""

    gaze: HoldState | None = None
    idle: IdleState | None = None
    aim: AimState | None = None


class HeadLife:
    """Spontaneous motion of one head. Parts that the configuration leaves out do nothing.

    `camera`: the head's camera; None: places of people are not known, and the head looks straight ahead.
    """

    def __init__(self, config: Life, seed: int, camera: CameraMount | None = None) -> None:
        self._gaze = GazeHold(config.gaze) if config.gaze else None
        self._idle = IdleFiller(config.idle, (config.gaze or Gaze()).full_rad, seed) if config.idle else None
        self._target = GazeTarget(config.person, config.gaze, camera, seed) if config.person else None

    def step(
        self,
        motion: Floats,
        times_s: Doubles,
        now_s: float,
        state: LifeState,
        shown_pose: ShownPose,
        watched: Watched,
    ) -> tuple[Floats, LifeState]:
        """Return motion (N, 58) at (N,) instants, row 0 at `now_s`, with spontaneous motion. Never changes its input.

        `shown_pose`: motion (N, 58) -> the pose (N, 6) that the neck will show.
        """
        gaze, idle, aim_state, aim = state.gaze, state.idle, state.aim, None
        if self._idle:
            idle = self._idle.watch(motion, times_s, now_s, idle)
            motion = self._idle.sway(motion, times_s, idle)
        if self._target:
            aim, aim_state = self._target.step(motion, times_s, now_s, watched, aim_state)
        if self._gaze:
            motion, gaze = self._gaze.step(motion, times_s, gaze, shown_pose, aim)
        elif aim is not None and aim.head_rad.any():
            motion = turned(motion, aim)
        if self._idle and idle:
            motion = self._idle.look(motion, times_s, idle)
        if self._target and aim_state and self._target.camera and self._target.camera.on_head:
            aim_state = self._target.remember(now_s, shown_pose(motion[:1])[0], aim_state)
        return motion, LifeState(gaze, idle, aim_state)
