"""Tokens out of probabilities: frame by frame, every group at once, many streams at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.config import NodCourse, SmileCourse
from sfms_robot.frames import FRAME_S, Doubles, Floats
from sfms_robot.listeners.engine import Engine
from sfms_robot.listeners.lots import Use, uniforms
from sfms_robot.listeners.sfms.keyframes import UNDECIDED, LastKeyframes, Tokens, anchored, last_keyframes
from sfms_robot.signals.control import COLUMNS, FULL_SIZE, since_s

LIKELIEST = 128  # classes that are looked at: what is behind them weighs next to nothing


@dataclass(frozen=True)
class Seen:
    """What a plan may look at: the parts of `predictor.Context`, those of the speaker of 1 or B streams.

    Attributes:
        settled: (B,) the last frame of each window whose motion stays as it is: no new ramp begins before it.
    """

    face: Floats
    face_known: NDArray[np.bool_]
    voice: Floats
    heard: NDArray[np.bool_]
    phase: Floats
    tokens: Tokens
    control: Floats
    settled: Tokens


# --- Reach ------------------------------------------------------------------------------------------------------------
#
# How soon one keyframe may follow another: no channel moves faster than it ever did in the training motion. Frames
# are drawn one at a time from probabilities that never quite reach zero; without this rule two codes far apart may
# end up in neighbouring frames, which no head can follow and no face does.

NEVER = 255  # frames, more than any window has
TINY = 1e-9  # for a channel that never moved


class Reach:
    """Frames needed from each token to each other one, per group. A row is worked out when it is first asked for.

    Args:
        motion: (V, C) motion of every code, V of the largest group; the codes of a smaller one are its first.
        channels: of each group; codes: how many it has.
        speed: (C,) fastest natural change of each channel from one frame to the next.
        bounded: else every code may follow every other at once; but a group never gets a code that it lacks.
    """

    def __init__(
        self,
        motion: Floats,
        channels: Sequence[Sequence[int]],
        codes: Sequence[int],
        speed: Floats,
        bounded: bool = True,
    ) -> None:
        self._classes = 1 + len(motion)
        self._bounded = bounded
        self._motion = [np.ascontiguousarray((motion[:size, own]).T) for own, size in zip(channels, codes, strict=True)]
        self._speed = [np.maximum(speed[own, None], TINY) for own in channels]
        self._rows: dict[tuple[int, int], NDArray[np.uint8]] = {}

    def too_soon(self, last: Tokens, gap: Tokens) -> NDArray[np.bool_]:
        """Tokens (B, G) of the last keyframes (0: none), frames since (B, G) -> classes (B, G, V + 1) out of reach."""
        needed = np.concatenate([self.needed(*each) for row in last.tolist() for each in enumerate(row)])
        passed = np.minimum(gap, NEVER - 1).astype(np.uint8)  # as wide as what it is compared with
        too_soon: NDArray[np.bool_] = needed.reshape(*last.shape, self._classes) > passed[..., None]
        return too_soon

    def needed(self, group: int, token: int) -> NDArray[np.uint8]:
        """(V + 1,) whole frames, at least, from a token to every class; class 0 may always follow, and anything may
        follow class 0, which is no keyframe yet.
        """
        row = self._rows.get((group, token))
        if row is None:
            motion = self._motion[group]
            row = np.zeros(self._classes, np.uint8)
            if token and self._bounded:
                frames = np.abs(motion - motion[:, token - 1, None]) / self._speed[group]
                row[1 : 1 + motion.shape[1]] = np.minimum(np.ceil(frames.max(0)), NEVER)
            row[1 + motion.shape[1] :] = NEVER
            self._rows[group, token] = row
        return row


# --- Courses of events ------------------------------------------------------------------------------------------------
#
# A smile or a nod in the control rows moves as people's do: the tokens drawn for it lie near the course of an event
# of its size.
#
# Both are rare, so a small predictor learns that one is under way better than how far it has to go by now: alone it
# raises the corners of a mouth too little, at any time within a second, and makes one short nod in four hardly at
# all. While one is under way, each class of its group loses what a normal distribution around the course takes from
# it,
#
#     log p  -=  (value - course)^2 / (2 spread^2),
#
# where the value is that of the code, or, for the transition, that of the keyframe that is held. So a keyframe comes
# when the held one has left the course, and of the codes those that fit are likely; the predictor still decides which
# of them, and what else the group does. Without an event nothing changes.
#
# A smile has a course all along: corners that rise, and fall before its end; a laugh, which is larger, has none. A
# nod has one where its swings turn, at the lowest point of each and between them; the way there is free.

_AT: Final = {name: at for at, name in enumerate(COLUMNS)}
_TURN: Final = 2 * math.pi
_LEAST_RAD: Final = 1e-6


@dataclass(frozen=True)
class Course:
    """Where one channel should be in every row told.

    Attributes:
        wanted: (...,) NaN where that is not known. spread: (...,) how far from it is left to the predictor.
    """

    wanted: Doubles
    spread: Doubles


@dataclass(frozen=True)
class ToldCourse:
    """What is told does to the odds of one group.

    Attributes:
        how: the course. group: its place among the groups. values: (V,) of each of its codes, in the unit of the
            course: radians nose down of a nod, 0 to 1 of a smile.
    """

    how: SmileCourse | NodCourse
    group: int
    values: Doubles

    def course(self, control: Floats) -> Course | None:
        """Of rows (..., T, K) of control, in their order: (..., T); None where none of them tells of one."""
        kind = "smile" if isinstance(self.how, SmileCourse) else "nod"
        if not control[..., _AT[f"{kind}.active"]].any():
            return None
        if isinstance(self.how, SmileCourse):
            return smile_course(self.how, control)
        return nod_course(self.how, control)

    def penalties(self, wanted: Doubles, spread: Doubles, last: Tokens) -> tuple[NDArray[np.intp], Floats]:
        """A row of the `course` of streams (B,), and their last keyframes (B,), 0 for none -> for which of them there
        is one (S,), and what classes 0, 1, ... lose in log-odds (S, V + 1).
        """
        told = np.flatnonzero(np.isfinite(wanted))
        token = last[told]
        held = np.where(token > 0, self.values[np.maximum(token - 1, 0)], 0.0)
        every = np.concatenate([held[:, None], np.broadcast_to(self.values, (len(token), len(self.values)))], axis=1)
        off = (every - wanted[told, None]) / spread[told, None]
        return told, (off**2 / 2).astype(np.float32)


def smile_course(smile: SmileCourse, control: Floats) -> Course:
    """Of the corners of the mouth, 0 to 1."""
    told = (control[..., _AT["smile.active"]] > 0) & (control[..., _AT["laugh.active"]] == 0)
    since = since_s(control[..., _AT["smile.since"]])
    over = control[..., _AT["smile.over"]].astype(np.float64)
    left = np.where(over > 0, since * (1 / np.maximum(over, 1e-6) - 1), np.inf)
    wanted = np.where(told, control[..., _AT["smile.size"]] * smile_share(smile, since, left), np.nan)
    return Course(wanted, np.full_like(wanted, smile.spread))


def smile_share(smile: SmileCourse, since: Doubles, left: Doubles) -> Doubles:
    """Share of its size that a smile has `since` its beginning, with so much `left` of it, both in seconds."""
    rise = np.interp(since, smile.RISE_S, smile.rise)
    return np.asarray(np.minimum(rise, np.interp(left, smile.FALL_S, smile.fall)))


def nod_course(nod: NodCourse, control: Floats) -> Course:
    """Of the pitch, radians, in the two rows about the middle of each swing, and in that nearest to its end."""
    told = control[..., _AT["nod.active"]] > 0
    size = control[..., _AT["nod.size"]].astype(np.float64) * FULL_SIZE["nod"]
    turned, step = _turned(control, told)
    ended = np.zeros_like(told)
    ended[..., 1:] = ~told[..., 1:] & told[..., :-1]  # the row behind the last one may lie nearest to the end
    for values, more in ((turned, step), (size, 0.0), (step, 0.0)):
        values[..., 1:] = np.where(ended[..., 1:], (values + more)[..., :-1], values[..., 1:])
    swing, angle = np.divmod(turned, _TURN)
    low = (told | ended) & (np.abs(angle - math.pi) <= step)
    back = (told | ended) & (np.minimum(angle, _TURN - angle) <= step / 2) & (turned > math.pi)
    off = angle - math.pi
    nearest = off - step * np.round(off / np.maximum(step, _LEAST_RAD))  # of the rows, to the middle
    there = size * nod.fall**swing * (1 + np.cos(off)) / np.maximum(1 + np.cos(nearest), _LEAST_RAD)
    wanted = np.where(low, there, np.where(back, 0.0, np.nan))
    return Course(wanted, nod.spread * np.maximum(size, _LEAST_RAD))


def _turned(control: Floats, told: NDArray[np.bool_]) -> tuple[Doubles, Doubles]:
    """How far the swings of a nod have turned since its beginning, radians, and by how much they do from row to row;
    0 where only one row of it is known.
    """
    angle = np.arctan2(control[..., _AT["nod.sine"]], control[..., _AT["nod.cosine"]]).astype(np.float64) % _TURN
    since = since_s(control[..., _AT["nod.since"]])
    same = told[..., 1:] & told[..., :-1] & (since[..., 1:] > since[..., :-1])
    ahead = np.where(same, np.diff(angle, axis=-1) % _TURN, 0.0)
    step = np.zeros_like(angle)
    step[..., 1:] = ahead
    step[..., :-1] = np.where(same, ahead, step[..., :-1])
    whole = np.round((since / FRAME_S * step - angle) / _TURN)
    return angle + _TURN * whole, step


class Sampler:
    """How the tokens of one listener are drawn: its predictor, and what its settings say of every group."""

    def __init__(self, settings: config.Sfms, engine: Engine, reach: Reach, courses: Sequence[ToldCourse] = ()) -> None:
        groups, common = list(settings.groups.values()), settings.sampling
        self._engine, self._reach, self._courses = engine, reach, courses
        self._temperature, self._nucleus = np.float32(common.temperature), np.float32(common.nucleus)
        self._bias = np.array([group.transition_bias for group in groups], np.float32)
        self._classes = [group.codes + 1 for group in groups]
        self._ramp = settings.ramp_frames or 0

    def draw(self, seen: Seen, seeds: Sequence[int], frames: Sequence[int]) -> Tokens:
        """`seen.tokens` (B, P + H, G) with its undecided frames drawn; stream b has `seeds[b]` and draws for frames up
        to `frames[b]` of its life.

        A stream's undecided frames are its last ones; how many may differ from stream to stream.
        """
        tokens = seen.tokens.copy()
        window = tokens.shape[1]
        left = (tokens[..., 0] == UNDECIDED).sum(1)  # frames of each stream
        first = window - int(left.max())
        recent = last_keyframes(tokens)
        parts = (seen.face, seen.face_known, seen.voice, seen.heard, seen.phase, tokens, seen.control)
        (slots,) = self._engine.run("ahead", *parts, *recent)
        last = LastKeyframes(recent.tokens[:, first - 1], recent.at[:, first - 1])
        chances = self._chances(seeds, frames, window - first)
        before = min(first, 2)  # rows that say how fast a swing is, and that it has just ended
        rows = seen.control[:, first - before :]
        courses = [(told, one) for told in self._courses if (one := told.course(rows)) is not None]
        for frame in range(first, window):
            (flat,) = self._engine.run("next", slots[:, frame - window], *last, np.array([frame - 1]))
            at = frame - first + before
            now = [(told, one.wanted[:, at], one.spread[:, at]) for told, one in courses]
            since = frame - np.maximum(last.at[..., 0], seen.settled[:, None] if self._ramp else -1)
            drawn = self._drawn(flat, last, since, chances[:, frame - window], now)
            known = tokens[:, frame]
            tokens[:, frame] = np.where(known == UNDECIDED, drawn, known)
            last = last.then(tokens[:, frame], frame)
        return anchored(tokens, seen.tokens == UNDECIDED, seen.settled, self._ramp) if self._ramp else tokens

    def _chances(self, seeds: Sequence[int], frames: Sequence[int], count: int) -> Doubles:
        """(B, count, G) in 0..1 for each stream's last `count` frames."""
        groups = len(self._bias)
        drawn = [
            [uniforms(seed, frame - count + 1 + at, Use.TOKENS, groups) for at in range(count)]
            for seed, frame in zip(seeds, frames, strict=True)
        ]
        return np.array(drawn)

    def _drawn(
        self,
        flat: Floats,
        last: LastKeyframes,
        since: Tokens,
        chance: Doubles,
        courses: Sequence[tuple[ToldCourse, Doubles, Doubles]],
    ) -> Tokens:
        """Tokens (B, G) of a frame from the logits (B, classes of all groups) of the network `next`.

        `since` (B, G): frames in which each group may have got there from its last keyframe.

        `courses`: those that are told, each with the row (B,) of what is wanted, and its spread.
        """
        possible = by_group(flat, self._classes)  # (B, G, V)
        too_soon = self._reach.too_soon(last.tokens[..., 0], since)
        np.copyto(possible, np.float32(-np.inf), where=too_soon)
        possible /= self._temperature
        for told, wanted, spread in courses:
            streams, lost = told.penalties(wanted, spread, last.tokens[:, told.group, 0])
            possible[streams, told.group, : lost.shape[1]] -= lost
        return sample(possible, self._bias, self._nucleus, chance)


def by_group(flat: Floats, classes: Sequence[int]) -> Floats:
    """Logits (..., all classes of all groups), `classes` of each -> (..., G, V); -inf for those that a group lacks."""
    out = np.full((*flat.shape[:-1], len(classes), max(classes)), -np.inf, np.float32)
    first = 0
    for group, count in enumerate(classes):
        out[..., group, :count] = flat[..., first : first + count]
        first += count
    return out


def sample(logits: Floats, bias: Floats, nucleus: np.float32, chance: Doubles) -> Tokens:
    """One class (..., G) of each logits (..., G, V): bias (G,) on class 0, then the likeliest that hold `nucleus`.

    `chance` (..., G) in 0..1 says where in that mass: a class is drawn as often as it is likely.
    """
    biased = logits.copy()
    biased[..., 0] += bias
    biased -= biased.max(-1, keepdims=True)
    shares = np.exp(biased, out=biased).reshape(-1, logits.shape[-1])  # (R, V), a row for every draw
    shares /= shares.sum(-1, keepdims=True)
    values = np.sort(shares, axis=-1)[:, : -LIKELIEST - 1 : -1]  # largest first
    mass = values.cumsum(-1)
    kept = (mass - values < nucleus).sum(-1)
    row = np.arange(len(mass))
    point = chance.reshape(-1) * mass[row, kept - 1]
    place = np.minimum((mass <= point[:, None]).sum(-1), kept - 1)
    value = values[row, place][:, None]
    alike = shares == value  # mostly that class alone; of several the first ones come first
    before = place - (values > value).sum(-1)
    drawn: Tokens = (alike.cumsum(-1) > before[:, None] if before.any() else alike).argmax(-1)
    return drawn.reshape(logits.shape[:-1])
