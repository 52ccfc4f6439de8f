"""Commands of a program to the face, laid over the listener's plan: a face, or a point to look at.

    show       each channel goes from the listener's value to the requested one, stays, and goes back
    look_at    the eyes jump to the point, the head follows with its share, and the eyes compensate for its turn

Each channel has a weight: 0 leaves the listener's value, 1 is the requested value. A weight rises and falls by smooth
steps and is 0 again in the end, so that a face without commands is the listener's, bit for bit. A new command begins
at the present value of the channel.

Commands come from any thread and take effect at the latest instant of the tick that finds them, because joints look
ahead by different leads and no instant that was already played may change.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from sfms_robot.config import Gaze
from sfms_robot.errors import InputError
from sfms_robot.frames import CHANNELS, MOTION_DIM, POSE, SHAPES, YAW_PITCH, Bools, Doubles, Floats
from sfms_robot.signals.face_units import channel_of, motion_of
from sfms_robot.signals.gaze_kinematics import direction_to, directions, turn
from sfms_robot.signals.minimum_jerk import ease

RISE_S: Final = 0.25  # listener -> face
CHANGE_S: Final = 0.12  # one requested face -> the next; linear, so that a stream of faces moves evenly
FALL_S: Final = 0.35
EYES_S: Final = 0.1  # a saccade of 30 degrees
HEAD_S: Final = 0.6  # a head turn that follows it
HEAD_SHARE: Final = 0.6  # share of the direction; the eyes turn the rest
LARGEST_POSE: Final = np.array([math.pi, math.pi, math.pi, 1.0, 1.0, 1.0])  # rad, m
_ZERO: Final = np.zeros(1)
_NEVER_S: Final = np.full(1, -math.inf)


@dataclass(frozen=True, kw_only=True)
class Request:
    """Requested values of C channels and their weights; all arrays are (C,), or (1,) before the first command.

    Attributes:
        rise_s, fall_s: time of a weight from `start` at `began_s` up to 1, and down to 0 from `until_s` on.
        change_s: time of the values from `before`, which hold until `since_s`, to `after`.
        smooth: whether the values change by a smooth step; otherwise they change linearly.
    """

    rise_s: float
    fall_s: float
    change_s: float
    smooth: bool = True
    start: Doubles = field(default_factory=_ZERO.copy)
    began_s: Doubles = field(default_factory=_NEVER_S.copy)
    until_s: Doubles = field(default_factory=_NEVER_S.copy)
    before: Doubles = field(default_factory=_ZERO.copy)
    after: Doubles = field(default_factory=_ZERO.copy)
    since_s: float = 0.0

    @property
    def over_s(self) -> float:
        """Time from which all weights are 0."""
        return float(self.until_s.max()) + self.fall_s

    def weights(self, times_s: Doubles) -> Doubles:
        """Return the weights (N, C) at (N,) instants."""
        times = times_s[:, None]
        risen = self.start + (1.0 - self.start) * ease((times - self.began_s) / self.rise_s)
        return risen * (1.0 - ease((times - self.until_s) / self.fall_s))

    def values(self, times_s: Doubles) -> Doubles:
        """Return the values (N, C) at (N,) instants."""
        share = (times_s - self.since_s) / self.change_s
        share = ease(share) if self.smooth else np.clip(share, 0.0, 1.0)
        return self.before + share[:, None] * (self.after - self.before)

    def then(self, values: Doubles, which: Bools, seconds: float, now_s: float) -> Request:
        """Return the request for `which` (C,) of `values` (C,) from now on; once risen, they stay for `seconds`."""
        here = np.array([now_s])
        weight, value = self.weights(here)[0], self.values(here)[0]
        falling = which & (self.until_s <= now_s)
        return replace(
            self,
            start=np.where(falling, weight, self.start),
            began_s=np.where(falling, now_s, self.began_s),
            until_s=np.where(which, now_s + self.rise_s + seconds, self.until_s),
            before=np.where(which & (weight <= 0), values, value),
            after=np.where(which, values, self.after),
            since_s=now_s,
        )


@dataclass(frozen=True)
class _Piece:
    """The commands in force from `since_s` on."""

    since_s: float
    shown: Request  # (58,)
    eyes: Request  # (2,) yaw and pitch [rad]
    head: Request

    @cached_property
    def over_s(self) -> float:
        """Time from which the face is the listener's; used at every tick."""
        return max(part.over_s for part in (self.shown, self.eyes, self.head))


class Puppet:
    """Commands to a face: `show` and `look_at` from any thread; `overlay` from the loop.

    Args:
        gaze: the eyes' range, and the share of the head's turn that they compensate for.
        blind: channels that the head does not show; without eyes only the head turns, without a neck only the eyes.
    """

    def __init__(self, gaze: Gaze | None = None, blind: frozenset[str] = frozenset()) -> None:
        gaze = gaze or Gaze()
        self._full_rad = gaze.full_rad
        eyeless = [{"eyeLookOutLeft", "eyeLookInLeft"} <= blind, {"eyeLookUpLeft", "eyeLookDownLeft"} <= blind]
        stiff = ["yaw" in blind, "pitch" in blind]
        self._head_share = np.where(stiff, 0.0, np.where(eyeless, 1.0, HEAD_SHARE))
        self._gain = np.where(stiff, 0.0, gaze.neck_gain)
        # Commands since the last tick: a face (58,), its channels, seconds; or a direction (2,), None, seconds.
        self._asked = deque[tuple[Doubles, Bools | None, float]]()
        shown = Request(rise_s=RISE_S, fall_s=FALL_S, change_s=CHANGE_S, smooth=False)
        eyes = Request(rise_s=EYES_S, fall_s=FALL_S, change_s=EYES_S)
        head = Request(rise_s=HEAD_S, fall_s=HEAD_S, change_s=HEAD_S)
        self._pieces = [_Piece(-math.inf, shown, eyes, head)]

    def show(self, face: Floats | Mapping[str, float], seconds: float) -> None:
        """Show a whole face (58,), or some channels by name, for `seconds` once it has risen. Never blocks.

        Raises InputError for an unknown channel, a value that is not finite, a blendshape outside 0..1, a pose beyond
        pi or 1 m, and `seconds` that is not a positive number.
        """
        self._asked.append((*_channels(face), _checked_seconds(seconds)))

    def look_at(self, x_m: float, y_m: float, z_m: float, seconds: float) -> None:
        """Look at a point in metres from the middle of the head: x forward, y to its left, z up. Never blocks.

        Raises InputError for a point that is not finite, or nearer than a centimetre, and for `seconds` as `show`.
        """
        point = np.array([x_m, y_m, z_m], np.float64)
        if not np.isfinite(point).all() or math.hypot(*point) < 0.01:
            raise InputError(f"look_at({x_m:g}, {y_m:g}, {z_m:g}) is not a point in front of a head, in metres")
        self._asked.append((direction_to(point), None, _checked_seconds(seconds)))

    def overlay(self, motion: Floats, times_s: Doubles) -> Floats:
        """Return motion (N, 58) at (N,) instants with the commands. Never changes its input."""
        earliest_s = float(times_s.min())
        self._take(earliest_s, float(times_s.max()))
        if len(self._pieces) == 1 and self._pieces[0].over_s <= earliest_s:
            return motion
        out = motion.copy()
        which = np.searchsorted([piece.since_s for piece in self._pieces], times_s, side="right") - 1
        for index, piece in enumerate(self._pieces):
            rows = np.flatnonzero(which == index)
            if len(rows):
                out[rows] = self._laid_over(piece, motion[rows], times_s[rows])
        return out

    def _take(self, earliest_s: float, latest_s: float) -> None:
        """Begin commands at the latest instant of this tick, and drop pieces that no later instant needs."""
        if self._asked:
            now = self._pieces[-1]
            since_s, shown, eyes, head = max(latest_s, now.since_s), now.shown, now.eyes, now.head
            while self._asked:
                values, which, seconds = self._asked.popleft()
                if which is not None:
                    shown = shown.then(values, which, seconds, since_s)
                else:
                    eyes, head = (each.then(values, np.ones(2, bool), seconds, since_s) for each in (eyes, head))
            self._pieces.append(_Piece(since_s, shown, eyes, head))
        while len(self._pieces) > 1 and self._pieces[1].since_s <= earliest_s:
            self._pieces.pop(0)

    def _laid_over(self, piece: _Piece, motion: Floats, times_s: Doubles) -> Floats:
        shown = piece.shown
        weight = shown.weights(times_s)
        out = np.where(weight > 0, motion + weight * (shown.values(times_s) - motion), motion)
        out = out.astype(np.float32)
        looking = np.flatnonzero((piece.eyes.weights(times_s) + piece.head.weights(times_s)).any(axis=1))
        if len(looking):
            out[looking] = self._looking(piece, out[looking], times_s[looking])
        return out

    def _looking(self, piece: _Piece, motion: Floats, times_s: Doubles) -> Floats:
        """Turn head and eyes of `motion` (N, 58), in place."""
        turned = piece.head.values(times_s) * self._head_share
        motion[:, YAW_PITCH] += (piece.head.weights(times_s) * (turned - motion[:, YAW_PITCH])).astype(np.float32)
        wanted = piece.eyes.values(times_s) - self._gain * motion[:, YAW_PITCH]
        both = directions(motion, self._full_rad)  # (N, eye, axis)
        middle = both.mean(axis=1)
        turn(motion, both + (piece.eyes.weights(times_s) * (wanted - middle))[:, None], self._full_rad)
        return motion


def _channels(face: Floats | Mapping[str, float]) -> tuple[Doubles, Bools]:
    """Return values (58,) and which of them are requested (58,) bool."""
    which = np.ones(MOTION_DIM, bool)
    if isinstance(face, Mapping):
        values = motion_of(face, "show").astype(np.float64)
        named = {channel_of(name) for name in face}
        which = np.array([name in named for name in CHANNELS])
    else:
        values = np.asarray(face, np.float64)
    if values.shape != (MOTION_DIM,):
        raise InputError(f"show: a face has shape {values.shape}; pose 6 and blendshapes 52 are ({MOTION_DIM},)")
    fits = np.isfinite(values)
    fits[POSE] &= np.abs(values[POSE]) <= LARGEST_POSE
    fits[SHAPES] &= (values[SHAPES] >= 0) & (values[SHAPES] <= 1)
    if not fits.all():
        worst = int(np.argmin(fits))
        raise InputError(f"show: {CHANNELS[worst]} = {values[worst]:g} is not a number in its range")
    return values, which


def _checked_seconds(seconds: float) -> float:
    if not (math.isfinite(seconds) and seconds > 0):
        raise InputError(f"seconds = {seconds:g} is not a positive number")
    return seconds
