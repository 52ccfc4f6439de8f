"""Joining of plans, and their playback at any instant with continuous speed and acceleration.

A plan has a face every 40 ms; servos need one every tick, at tick time plus their own lead. Between two frames
every channel follows a quintic that matches value, slope and curvature at both ends, so that the jerk
limiter behind it has nothing to correct. Two rules for slope and curvature at a frame:

- pose: central differences of fourth order (second order where frames are unevenly spaced or too few). The head
  may swing a little past a frame, as a head does.
- blendshapes: the harmonic-mean slopes of Fritsch and Carlson (1980), no curvature next to a flat stretch, and the
  curve kept between the two frames' values: it never overshoots, so 0 stays 0 and a closed lid stays closed.

A blink is two frames long; a peak that falls between two ticks would be cut off, and a lid servo that is slower
than the blink would turn back before it has closed. The blink channels are therefore widened by half a frame on
either side: the lid starts a little early and stays closed for a whole frame.

A newer plan replaces the older one from its first time on. Where both have a frame they are blended over two frames,
blinks by maximum. Instants that were played already (leads included), and the piece of curve in play, do not change:
a late plan changes the future, but never makes the present face jump. Past the last frame the curve continues for one
frame at most, then holds. A plan that comes too late for all its frames still sets the next target of the face. After
half a second without a plan the face eases to neutral.

A lead needs the future of the plan in force, which is limited: the part that is left when the next plan comes is
measured, and leads are cut to it (`lead_limit_s`). The limit follows slowly, so that time neither jumps nor stands
still.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sfms_robot.frames import (
    BLINKS,
    CHANNEL_INDEX,
    FRAME_S,
    JAW_FULL_OPEN_RAD,
    MOTION_DIM,
    POSE,
    SHAPES,
    Doubles,
    Floats,
    Indices,
    Plan,
    clip_shapes,
)
from sfms_robot.signals.minimum_jerk import ease

BLEND_FRAMES = 2
STALL_S = 0.5  # without a plan for this long, ease to neutral
EASE_S = 1.0
HISTORY = 8  # frames kept before the one in play
LEAD_S = 0.25  # limit of leads before anything is measured, and highest value of `left_s`
FALL, RISE = 0.25, 0.02  # s per s by which the limit falls and rises: it stays near the shortest time that was left
_EVEN = 1e-3  # frames count as evenly spaced within this share of a frame
_FARTHEST = 1e6  # m or rad
_JAW_OPEN = CHANNEL_INDEX["jawOpen"]


class _Knots(NamedTuple):
    """Frames with slope and curvature: times (K,), the others (K, 58), per second."""

    times_s: Doubles
    values: Doubles
    slopes: Doubles
    bends: Doubles

    def part(self, first: int, stop: int) -> _Knots:
        return _Knots(*(each[first:stop] for each in self))


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A piecewise quintic. The last knot is extrapolated by one frame, then follows rest.

    Attributes:
        knots: K frames; the curve is known up to `end_s`, the last but one.
        coefficients: (K-1, 6, 58) of the powers 0..5 of the position in the piece, 0..1.
        low, high: (K-1, 58) bounds of each piece.
        made_at_s: time at which the newest plan was made.
        delay_s: one frame for plans of a single frame, which could not be interpolated otherwise.
    """

    knots: _Knots
    coefficients: Doubles
    low: Doubles
    high: Doubles
    made_at_s: float
    delay_s: float

    @property
    def end_s(self) -> float:
        return float(self.knots.times_s[-2])


@dataclass(frozen=True, kw_only=True)
class TimelineState:
    """Memory of the timeline, of bounded size.

    Attributes:
        curve: None before the first plan.
        played_s: latest instant of the curve that was sampled.
        held: samples that ran past the horizon and one frame more.
        eased: samples on the way to neutral, or at neutral, because there was no plan.
        late: plans whose frames were all in the past.
        refused: discarded plans: not finite, or older than the one before.
        now_s: time of the last tick.
        until_s: last time of the plan in force.
        left_s: time left of the plan in force at the last tick before a newer one came.
        lead_limit_s: follows `left_s`, never below 0.
    """

    curve: Curve | None = None
    played_s: float = -math.inf
    held: int = 0
    eased: int = 0
    late: int = 0
    refused: int = 0
    now_s: float = -math.inf
    until_s: float = -math.inf
    left_s: float = LEAD_S
    lead_limit_s: float = LEAD_S


class PlanTimeline:
    """The timeline of a run (`ports.Timeline`).

    Args:
        tick_s: period at which the timeline is sampled; blinks are widened by half of it where it is longer than
            a frame.
    """

    def __init__(self, tick_s: float) -> None:
        self._widening_s = max(tick_s, FRAME_S) / 2

    def start(self) -> TimelineState:
        return TimelineState()

    def accept(self, plan: Plan, state: TimelineState) -> TimelineState:
        """Return the state with `plan` joined on; an unusable plan is counted in `refused` and raises nothing."""
        old, usable = state.curve, _usable(plan)
        if usable is None or (old is not None and plan.made_at_s < old.made_at_s):
            return replace(state, refused=state.refused + 1)
        times_s, frames = usable
        step_s = float(times_s[1] - times_s[0]) if len(times_s) > 1 else FRAME_S

        delay_s = FRAME_S if len(times_s) == 1 else 0.0
        played_s = state.played_s if old is not None else state.played_s - delay_s

        past, broken = _past(old, played_s, float(times_s[0]), step_s)
        new = times_s > past.times_s[-1] + step_s / 4
        late = not new.any()
        if late:
            times_s, frames = past.times_s[-1:] + step_s, frames[-1:]
        else:
            times_s, frames = times_s[new], frames[new]
        for i in range(min(BLEND_FRAMES, len(times_s))):
            if broken or (old is not None and times_s[i] <= old.end_s + step_s / 4):
                frames[i] = _blend(_motion(old, times_s[i : i + 1])[0], frames[i], (i + 1) / (BLEND_FRAMES + 1))
        knots = _joined(past, times_s, frames, step_s, played_s)
        curve = _curve(knots, plan.made_at_s, delay_s)
        left_s = state.left_s if old is None else min(state.until_s + old.delay_s - state.now_s, LEAD_S)
        until_s = float(plan.times_s[-1])
        return replace(state, curve=curve, played_s=played_s, late=state.late + late, until_s=until_s, left_s=left_s)

    def lead_limit_s(self, state: TimelineState) -> float:
        """Return the longest lead after a tick [s] with which `sample` does not run past the plan in force."""
        return state.lead_limit_s

    def sample(self, times_s: Doubles, now_s: float, state: TimelineState) -> tuple[Floats, TimelineState]:
        """Return motion (N, 58) at (N,) instants, in any order, and the state; neutral before the first plan.

        `now_s` is the time of the tick; instants after it are leads.
        """
        # The limit of leads moves a little toward the time that was left of the last plan.
        dt_s = max(now_s - state.now_s, 0.0) if math.isfinite(state.now_s) else 0.0
        limit_s = min(max(state.left_s, state.lead_limit_s - FALL * dt_s), state.lead_limit_s + RISE * dt_s)
        curve, limit_s = state.curve, max(limit_s, 0.0)
        played_s = max(state.played_s, float(times_s.max()) - (curve.delay_s if curve else 0.0))
        if curve is None:
            after = replace(state, played_s=played_s, now_s=now_s, lead_limit_s=limit_s)
            return np.zeros((len(times_s), MOTION_DIM), np.float32), after
        instants_s, which = _distinct(times_s)
        asked_s = instants_s - curve.delay_s
        around_s = np.concatenate([asked_s, asked_s - self._widening_s, asked_s + self._widening_s])
        motion = _motion(curve, around_s)
        blinks = motion[:, BLINKS].reshape(3, len(asked_s), -1).max(axis=0)
        motion[: len(asked_s), BLINKS] = np.maximum(blinks, self._near(curve, asked_s))
        held = state.held + bool(played_s > curve.knots.times_s[-1])
        eased = state.eased + (now_s - curve.delay_s - curve.made_at_s > STALL_S)
        after = replace(state, played_s=played_s, held=held, eased=eased, now_s=now_s, lead_limit_s=limit_s)
        return motion.astype(np.float32).take(which, axis=0), after

    def _near(self, curve: Curve, asked_s: Doubles) -> Doubles:
        """Return the blink (N, 2) of a frame close enough to be widened to each instant, 0 without one."""
        times_s = curve.knots.times_s
        nearest = times_s.searchsorted(asked_s + self._widening_s, side="right") - 1
        frame = np.maximum(nearest, 0)
        near = np.abs(times_s[frame] - asked_s) <= self._widening_s
        blinks: Doubles = curve.knots.values[frame, BLINKS]
        return blinks * (near & (nearest >= 0) & (asked_s - curve.made_at_s < STALL_S))[:, None]


def _distinct(times_s: Doubles) -> tuple[Doubles, Indices]:
    """Return the distinct instants, and the index of each of (N,) among them. Joints share their leads."""
    seen: dict[float, int] = {}
    which = [seen.setdefault(time_s, len(seen)) for time_s in times_s.tolist()]
    return np.array(list(seen)), np.array(which, dtype=np.intp)


def _blend(before: Doubles, after: Doubles, share: float) -> Doubles:
    """Blend two motions (58,), with `share` of the later one; blinks by maximum."""
    blend = (1 - share) * before + share * after
    blend[BLINKS] = np.maximum(before[BLINKS], after[BLINKS])
    return blend


def _usable(plan: Plan) -> tuple[Doubles, Doubles] | None:
    """Return times (H,) and frames (H, 58) of a plan; None unless it is finite, in time order and 58 wide.

    Blendshapes are clipped to 0..1, and the jaw pose, if any, replaces jawOpen. A pose is clipped to `_FARTHEST`, so
    that no curve through it overflows.
    """
    times_s, frames = np.asarray(plan.times_s, dtype=np.float64), np.array(plan.frames, dtype=np.float64)
    if times_s.ndim != 1 or not len(times_s) or frames.shape != (len(times_s), MOTION_DIM):
        return None
    numbers = (times_s, frames, np.asarray(plan.made_at_s), np.zeros(0) if plan.jaw_rad is None else plan.jaw_rad)
    if not all(np.isfinite(each).all() for each in numbers) or (np.diff(times_s) <= 0).any():
        return None
    if plan.jaw_rad is not None:  # axis-angle; y points left, so + about y lowers the chin
        frames[:, _JAW_OPEN] = plan.jaw_rad[:, 1] / JAW_FULL_OPEN_RAD
    clip_shapes(frames)
    frames[:, POSE] = np.clip(frames[:, POSE], -_FARTHEST, _FARTHEST)
    return times_s, frames


def _past(old: Curve | None, played_s: float, first_s: float, step_s: float) -> tuple[_Knots, bool]:
    """Return the knots that a plan starting at `first_s` continues, and whether the old curve had run out before."""
    if old is not None and played_s <= old.knots.times_s[-1]:
        times_s = old.knots.times_s
        in_play = int(np.searchsorted(times_s, played_s, side="left"))  # the knot that ends the piece in play
        if in_play == len(times_s) - 1:  # that knot is extrapolated: leave the piece at its present point
            known, here = old.knots.part(max(0, in_play - HISTORY), in_play), _here(old, played_s)
            return _Knots(*map(np.concatenate, zip(known, here, strict=True))), False
        before = int(np.searchsorted(times_s[:-1], first_s - step_s / 4, side="left"))
        return old.knots.part(max(0, min(in_play, before) - HISTORY), max(in_play + 1, before)), False
    at_s = np.array([played_s if math.isfinite(played_s) else first_s - step_s])
    still = np.zeros((1, MOTION_DIM))
    return _Knots(at_s, _motion(old, at_s), still, still), True


def _here(curve: Curve, at_s: float) -> _Knots:
    """Return the curve at one instant of its last piece, as a knot."""
    start_s, end_s = curve.knots.times_s[-2:]
    width, c = end_s - start_s, curve.coefficients[-1]
    u = (at_s - start_s) / width
    slope = sum(k * c[k] * u ** (k - 1) for k in range(1, 6)) / width
    bend = sum(k * (k - 1) * c[k] * u ** (k - 2) for k in range(2, 6)) / width**2
    value = _motion(curve, np.array([at_s]))
    return _Knots(np.array([at_s]), value, np.reshape(slope, (1, -1)), np.reshape(bend, (1, -1)))


def _joined(past: _Knots, times_s: Doubles, frames: Doubles, step_s: float, played_s: float) -> _Knots:
    """Return all knots with the extrapolated last one; slopes that were played are kept, later ones recomputed."""
    overrun = frames[-1] + (frames[-1] - (frames[-2] if len(frames) > 1 else past.values[-1]))
    clip_shapes(overrun)
    all_times = np.concatenate([past.times_s, times_s, times_s[-1:] + step_s])
    values = np.concatenate([past.values, frames, overrun[None]])
    slopes, bends = _derivatives(all_times, values)
    kept = min(len(past.times_s), int(np.searchsorted(past.times_s, played_s, side="left")) + 1)
    slopes[:kept], bends[:kept] = past.slopes[:kept], past.bends[:kept]
    return _Knots(all_times, values, slopes, bends)


def _derivatives(times_s: Doubles, values: Doubles) -> tuple[Doubles, Doubles]:
    """Return slopes and curvatures (K, 58) at the knots; both 0 at the two ends."""
    width = np.diff(times_s)[:, None]
    chord = np.diff(values, axis=0) / width
    left, right, wl, wr = chord[:-1], chord[1:], width[:-1], width[1:]
    slopes, bends = np.zeros_like(values), np.zeros_like(values)
    # Second order, of chords of any width.
    slopes[1:-1] = (wr * left + wl * right) / (wl + wr)
    bends[1:-1] = 2 * (right - left) / (wl + wr)
    if len(times_s) > 4:
        # Fourth order where four widths in a row are equal.
        a, b, c, d, e = (values[k : len(values) - 4 + k] for k in range(5))
        after = width[2:-1]
        even = np.ptp(sliding_window_view(width[:, 0], 4), axis=1)[:, None] < _EVEN * after
        slopes[2:-2] = np.where(even, (a - 8 * b + 8 * d - e) / (12 * after), slopes[2:-2])
        bends[2:-2] = np.where(even, (-a + 16 * b - 30 * c + 16 * d - e) / (12 * after**2), bends[2:-2])
    if len(times_s) > 3 and np.ptp(width[-3:-1]) < _EVEN * width[-2]:  # one-sided: there is no frame after the last one
        a, b, c = values[-4:-1]
        slopes[-2], bends[-2] = (a - 4 * b + 3 * c) / (2 * width[-2]), (a - 2 * b + c) / width[-2] ** 2

    bends[1:-1, SHAPES] = 2 * (right - left)[:, SHAPES] / (wl + wr)
    left, right = left[:, SHAPES], right[:, SHAPES]
    turns = left * right <= 0
    safe_left, safe_right = np.where(turns, 1.0, left), np.where(turns, 1.0, right)
    # Fritsch and Carlson: the weighted harmonic mean of the chords, 0 where they differ in sign.
    a, b = 2 * wr + wl, wr + 2 * wl
    slopes[1:-1, SHAPES] = np.where(turns, 0.0, (a + b) / (a / safe_left + b / safe_right))
    bends[1:-1, SHAPES] *= (left != 0) & (right != 0)
    return slopes, bends


def _curve(knots: _Knots, made_at_s: float, delay_s: float) -> Curve:
    width = np.diff(knots.times_s)[:, None]
    start, end = knots.values[:-1], knots.values[1:]
    rise = end - start
    m0, m1 = knots.slopes[:-1] * width, knots.slopes[1:] * width
    b0, b1 = knots.bends[:-1] * width**2, knots.bends[1:] * width**2
    # The quintic through value, slope m and curvature b at u = 0 and 1.
    coefficients = np.stack(
        [
            start,
            m0,
            b0 / 2,
            10 * rise - 6 * m0 - 4 * m1 - 1.5 * b0 + 0.5 * b1,
            -15 * rise + 8 * m0 + 7 * m1 + 1.5 * b0 - b1,
            6 * rise - 3 * m0 - 3 * m1 - 0.5 * b0 + 0.5 * b1,
        ],
        axis=1,
    )
    low, high = np.minimum(start, end), np.maximum(start, end)
    low[:, POSE], high[:, POSE] = -np.inf, np.inf
    return Curve(knots=knots, coefficients=coefficients, low=low, high=high, made_at_s=made_at_s, delay_s=delay_s)


def _motion(curve: Curve | None, asked_s: Doubles) -> Doubles:
    """Return motion (N, 58) at instants of the curve's time; held outside it, faded to neutral after a stall."""
    if curve is None:
        return np.zeros((len(asked_s), MOTION_DIM))
    times_s = curve.knots.times_s
    piece = np.minimum(np.maximum(times_s.searchsorted(asked_s, side="right") - 1, 0), len(times_s) - 2)
    along = (asked_s - times_s[piece]) / (times_s[piece + 1] - times_s[piece])
    first, last = int(piece.min()), int(piece.max())
    # One product for all the pieces in play: each row has its powers in the columns of its own piece, 0 elsewhere.
    powers = np.zeros((len(asked_s), last + 1 - first, 6))
    along = np.minimum(np.maximum(along, 0.0), 1.0)
    powers[np.arange(len(asked_s)), piece - first] = np.vander(along, 6, increasing=True)
    coefficients = curve.coefficients[first : last + 1].reshape(-1, MOTION_DIM)
    out: Doubles = powers.reshape(len(asked_s), -1) @ coefficients
    np.maximum(out, curve.low[piece], out=out)
    np.minimum(out, curve.high[piece], out=out)
    if float(asked_s.max()) > curve.made_at_s + STALL_S:
        out *= (1 - ease((asked_s - curve.made_at_s - STALL_S) / EASE_S))[:, None]
    return out
