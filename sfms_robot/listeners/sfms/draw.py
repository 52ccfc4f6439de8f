"""Tokens of a stream: its window of past and future, and the drawing of undecided tokens. numpy only. Ours.

The paper predicts 8 frames and stops there. A robot does not: plans overlap, keyframes that were drawn stay, and an
event that is decided meanwhile may revoke some of them. A token is 0 at a transition, 1 + i at a keyframe of code i,
UNDECIDED where it is not drawn yet. B streams, P past and H future frames, T = P + H, G groups, V codes, K columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.config import NodCourse, SmileCourse
from sfms_robot.frames import FRAME_S, Bools, Doubles, Floats, Indices, Ints
from sfms_robot.listeners.engine import Engine
from sfms_robot.listeners.stream_rng import Use, uniforms
from sfms_robot.signals.control import COLUMNS, FULL_SIZE, since_s

Tokens = Ints
A = TypeVar("A")  # an array or a tensor

UNDECIDED: Final = -1
KEPT_FRAMES: Final = 1  # future frames that no event revokes: servos are already moving there
SAME: Final = 1e-5  # control rows that differ by less are the same
KEYS_STEP: Final = 8
NEUTRAL_STRIDE: Final = 8  # frames between the keyframes of the neutral face a stream begins with
LIKELIEST: Final = 128  # number of classes that may be drawn: all others together have next to no probability

# --- The window of a stream -------------------------------------------------------------------------------------------
#
# H = 8, hop 4, the plan made after frame 100 has come. k: keyframe, .: transition, U: undecided.
#
#     frame          61       ...        98   99  100 | 101  102  103  104 | 105  106  107  108
#                    past (P = 40), shown             | kept of the plan   | free
#                                                     | before             |
#     before         .   k   .   .   k   .    .    .  |  .    .    k    .  |  U    U    U    U
#     after `draw`   .   k   .   .   k   .    .    .  |  .    .    k    .  |  .    k    .    .
#                                                  ^
#                                                  settled: the last frame whose motion is fixed
#
# - `passed`: four frames later the same tokens are four places further left, and four undecided ones follow. With
#   penalised placement, where a keyframe holds until the next one, the last keyframe that has left the window is put at
#   the window's first frame.
# - `revoked`: an event is decided that changes the control row of frame 103. Tokens of 103 to 108 become undecided and
#   are drawn again, whatever the hop; settled is 102. Frame 101 (KEPT_FRAMES) is never revoked.
# - `anchored`: the keyframe just drawn at 106 has a ramp of 5 frames, which would begin at 101; but settled is 102,
#   and motion up to there was made without the keyframe. So the last keyframe of the group is repeated at 102, and the
#   ramp begins there. Without it, a nod would begin before the time that it was decided for.
#
# Motion after the last keyframe is an extrapolation, which the next plan may correct (`stream.join`).


class LastKeyframes(NamedTuple, Generic[A]):
    """The last two keyframes of every group, the newer first: tokens (..., G, 2), 0 for none yet, and their frames."""

    tokens: A
    at: A


class Context(NamedTuple, Generic[A]):
    """Inputs of the predictor, arrays or tensors, in the order of the inputs of the network `ahead`.

    Attributes:
        face: (B, P, C) speaker's standardised motion; arbitrary where not `face_known`.
        face_known: (B, P) bool.
        voice: (B, P, W) sound as `SpeakerEncoder.listen` returns it; arbitrary where not `heard`.
        heard: (B, P) bool.
        phase: (B, P, F) the speaker's place in a phrase; arbitrary where not `heard`; F = 0 without.
        tokens: (B', P + H, G) the listener's own: past, the part of the future that is drawn already, UNDECIDED.
            B' = B, or any number when B = 1: many answers to one speaker.
        control: (B', P + H, K) events in each of those frames; K = 0 without events.
    """

    face: A
    face_known: A
    voice: A
    heard: A
    phase: A
    tokens: A
    control: A


def last_keyframes(tokens: Tokens) -> LastKeyframes[Tokens]:
    """Return the last keyframes at every frame of tokens (B, T, G), that frame included; frame -1 for none."""
    windows, frames, groups = tokens.shape
    window, group = np.arange(windows)[:, None, None], np.arange(groups)
    # One frame without a keyframe is put before all others: its index is for frames that have no keyframe yet.
    known = np.zeros((windows, frames + 1, groups), tokens.dtype)
    np.maximum(tokens, 0, out=known[:, 1:])
    last = np.maximum.accumulate(np.where(known > 0, np.arange(frames + 1)[:, None], 0), axis=1)
    before = np.concatenate([last[:, :1], last[:, :-1]], axis=1)[window, last, group]  # the keyframe before the last
    at = np.stack([last, before], axis=-1)[:, 1:]
    return LastKeyframes(known[window[..., None], at, group[:, None]], at - 1)


def with_drawn(recent: LastKeyframes[Tokens], drawn: Tokens, frame: int) -> LastKeyframes[Tokens]:
    """Return the last keyframes (..., G, 2) after the tokens (..., G) `drawn` for `frame`."""
    key, now = drawn[..., None] > 0, np.full_like(drawn, frame)
    tokens, at = (np.stack([new, old[..., 0]], -1) for new, old in zip((drawn, now), recent, strict=True))
    return LastKeyframes(np.where(key, tokens, recent.tokens), np.where(key, at, recent.at))


def around(tokens: Tokens) -> tuple[NDArray[Any], ...]:
    """Return the parts of `piecewise_linear.Around` of tokens (B, T, G): the keyframes around each frame.

    A window without keyframes attends to all of its frames. K is as large as the fullest window needs, rounded up to a
    multiple of `KEYS_STEP`, because engines have to prepare for every new K.
    """
    windows, frames, _ = tokens.shape
    key, frame = tokens > 0, np.arange(frames)[:, None]
    before = np.maximum.accumulate(np.where(key, frame, -1), axis=1)
    after = np.ascontiguousarray(np.minimum.accumulate(np.where(key, frame, frames)[:, ::-1], axis=1)[:, ::-1])
    seen: Bools = np.asarray(key.any(-1))
    seen[~seen.any(-1)] = True
    counts, window = seen.sum(-1, keepdims=True), np.arange(windows)[:, None]
    most = min(-(-int(counts.max()) // KEYS_STEP) * KEYS_STEP, frames)
    rows = np.argsort(~seen, axis=1, kind="stable")[:, :most] + window * frames
    places = np.maximum(seen.cumsum(-1) - 1, 0) + window * most
    return before, after, rows, np.arange(most) < counts, places


def neutral_mask(frames: int, groups: int) -> Floats:
    """Return the keyframes (frames, groups) of a still, neutral face, the last of them at the newest frame."""
    mask = np.zeros((frames, groups), np.float32)
    mask[(frames - 1) % NEUTRAL_STRIDE :: NEUTRAL_STRIDE] = 1.0
    return mask


def passed(tokens: Tokens, path: Floats, frames: int, holds: bool = False) -> tuple[Tokens, Floats]:
    """Return tokens (B, P + H, G) and path (B, 2 + H, C) moved on by `frames`.

    Tokens that passed undecided, before the first plan, were the neutral face: they become transitions. `holds`: the
    last keyframe that has left the window is put at the window's first frame.
    """
    horizon = path.shape[1] - 2
    moved = np.concatenate([tokens[:, frames:], np.full_like(tokens[:, :frames], UNDECIDED)], axis=1)
    np.maximum(moved[:, :-horizon], 0, out=moved[:, :-horizon])
    if holds:
        moved[:, 0] = last_keyframes(tokens[:, : frames + 1]).tokens[:, -1, :, 0]
    return moved, np.concatenate([path[:, frames:], np.repeat(path[:, -1:], frames, axis=1)], axis=1)


def later(control: Floats, frames: int = 1) -> Floats:
    """Return control (B, P + H, K) moved on by `frames`; 0 for frames that have no row yet."""
    return np.concatenate([control[:, frames:], np.zeros_like(control[:, :frames])], axis=1)


def revoked(tokens: Tokens, drawn_under: Floats, control: Floats, horizon: int) -> tuple[Tokens, Tokens]:
    """Return tokens (B, P + H, G), undecided from the first future control row that changed, and `settled` (B,).

    Args:
        tokens: tokens of the window.
        drawn_under: (B, P + H, K) control rows with which the tokens were drawn.
        control: (B, P + H, K) current control rows.
        horizon: H.
    """
    changed = (np.abs(control - drawn_under)[:, -horizon:] > SAME).any(-1)
    stale: NDArray[Any] = np.logical_or.accumulate(changed, axis=1)
    stale[:, :KEPT_FRAMES] = False
    future = np.where(stale[..., None], UNDECIDED, tokens[:, -horizon:])
    overtaken = stale & (tokens[:, -horizon:, 0] != UNDECIDED)
    settled = tokens.shape[1] - horizon - 1 + np.where(overtaken.any(1), overtaken.argmax(1), 0)
    return np.concatenate([tokens[:, :-horizon], future], axis=1), settled


def anchored(tokens: Tokens, drawn: Bools, settled: Tokens, ramp: int) -> Tokens:
    """Return tokens (B, T, G) in which no ramp to a keyframe just `drawn`, (B, T, G), begins before frame `settled`.

    At frame `settled` (B,) the keyframe that a group held until then is repeated.
    """
    stream, frame = np.arange(len(tokens)), np.arange(tokens.shape[1])
    new, out = drawn & (tokens > 0), tokens.copy()
    behind = frame > settled[:, None]
    ahead = (tokens > 0) & (behind & (frame < settled[:, None] + ramp))[..., None]
    first = ahead.argmax(1)  # the next keyframe of each group, if there is any
    is_new = np.take_along_axis(new, first[:, None], axis=1)[:, 0]
    held = last_keyframes(np.where(behind[..., None], 0, tokens)).tokens[:, -1, :, 0]
    out[stream, settled] = np.where(ahead.any(1) & is_new, held, tokens[stream, settled])
    return out


# --- Reach ------------------------------------------------------------------------------------------------------------
#
# The least number of frames between two keyframes: no channel may move faster than it ever did in the training motion.
# Frames are drawn one at a time from probabilities that never quite reach zero; without this rule two codes far apart
# may end up in neighbouring frames, which no head can follow and no face does.

NEVER = 255  # frames, more than any window has
TINY = 1e-9  # speed of a channel that never moved


class CodeReach:
    """Frames needed from each token to each other token, per group. A row is computed when it is first needed.

    Args:
        settings: settings of the listener. Without `sampling.reach` every code may follow every other at once; a group
            still never gets a code that it lacks.
        motion: (V, C) motion of every code, V of the largest group; the codes of a smaller group are the first ones.
        speed: (C,) fastest natural change of each channel from one frame to the next.
    """

    def __init__(self, settings: config.Sfms, motion: Floats, speed: Floats) -> None:
        self._classes = 1 + len(motion)
        self._bounded = settings.sampling.reach
        self._motion, self._speed = [], []
        for group in settings.groups.values():
            own = [settings.channels.index(name) for name in group.channels]
            self._motion.append(np.ascontiguousarray(motion[: group.codes, own].T))
            self._speed.append(np.maximum(speed[own, None], TINY))
        self._rows: dict[tuple[int, int], NDArray[np.uint8]] = {}

    def too_soon(self, last: Tokens, gap: Tokens) -> Bools:
        """Return the classes (B, G, V + 1) out of reach `gap` (B, G) frames after the last keyframes (B, G)."""
        needed = np.concatenate([self._needed(*each) for row in last.tolist() for each in enumerate(row)])
        passed = np.minimum(gap, NEVER - 1).astype(np.uint8)  # the type of `needed`
        return needed.reshape(*last.shape, self._classes) > passed[..., None]

    def _needed(self, group: int, token: int) -> NDArray[np.uint8]:
        """Return the whole frames needed, at least, from a token to every class (V + 1,).

        Class 0 may always follow, and any class may follow class 0 (no keyframe yet).
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
# A smile or a nod in the control rows moves as people's do: the tokens drawn for it are near the course of an event
# of its size.
#
# Both are rare, so a small predictor learns that an event is in progress better than how far it has to be by now. Alone
# it raises the corners of a mouth too little, at any time within a second, and hardly makes one short nod in four.
# While an event is in progress, the log-odds of each class of its group are reduced as by a normal distribution around
# the course,
#
#     log p  -=  (value - course)^2 / (2 spread^2),
#
# where the value is that of the code, or, for the transition, that of the keyframe that is held. So a keyframe is
# drawn when the held one has left the course, and codes that fit the course are likely; the predictor still decides
# which of them it is, and the other motion of the group. Without an event nothing changes.
#
# A smile has a course at all times: corners that rise, and fall before its end; a laugh, which is larger, has none. A
# nod has a course where its swings turn, at the lowest point of each and between them; the motion in between is free.

_AT: Final = {name: at for at, name in enumerate(COLUMNS)}
_TURN: Final = 2 * math.pi
_LEAST_RAD: Final = 1e-6


class Course(NamedTuple):
    """The course of one channel in control rows (...): the value wanted, NaN for any, and the spread around it."""

    wanted: Doubles
    spread: Doubles


@dataclass(frozen=True)
class EventCourse:
    """A course that the tokens of one group follow.

    Attributes:
        how: shape of the course.
        group: place among the groups.
        values: (V,) value of each of the group's codes, in the unit of the course: radians nose down for a nod, 0 to 1
            for a smile.
    """

    how: SmileCourse | NodCourse
    group: int
    values: Doubles

    def course(self, control: Floats) -> Course | None:
        """Return the course (..., T) in consecutive control rows (..., T, K); None without such an event."""
        if isinstance(self.how, SmileCourse):
            return smile_course(self.how, control) if control[..., _AT["smile.active"]].any() else None
        return nod_course(self.how, control) if control[..., _AT["nod.active"]].any() else None

    def penalties(self, wanted: Doubles, spread: Doubles, last: Tokens) -> tuple[Indices, Floats]:
        """Return the streams (S,) that have a course in this frame, and the log-odds (S, V + 1) that each class loses.

        Args:
            wanted, spread: (B,) the course of this frame.
            last: (B,) last keyframes of the group, 0 for none.
        """
        streams = np.flatnonzero(np.isfinite(wanted))
        token = last[streams]
        held = np.where(token > 0, self.values[np.maximum(token - 1, 0)], 0.0)
        every = np.concatenate([held[:, None], np.broadcast_to(self.values, (len(token), len(self.values)))], axis=1)
        off = (every - wanted[streams, None]) / spread[streams, None]
        return streams, (off**2 / 2).astype(np.float32)


def smile_course(smile: SmileCourse, control: Floats) -> Course:
    """Return the course of the corners of the mouth, 0 to 1."""
    told = (control[..., _AT["smile.active"]] > 0) & (control[..., _AT["laugh.active"]] == 0)
    since = since_s(control[..., _AT["smile.since"]])
    over = control[..., _AT["smile.over"]].astype(np.float64)  # the share of its duration that has passed
    left = np.where(over > 0, since * (1 / np.maximum(over, 1e-6) - 1), np.inf)
    # A smile has the share of its size that it has risen to, and no more than is left of its fall.
    share = np.minimum(np.interp(since, smile.RISE_S, smile.rise), np.interp(left, smile.FALL_S, smile.fall))
    wanted = np.where(told, control[..., _AT["smile.size"]] * share, np.nan)
    return Course(wanted, np.full_like(wanted, smile.spread))


def nod_course(nod: NodCourse, control: Floats) -> Course:
    """Return the course of the pitch [rad]: in the two rows around the middle of each swing and next to its end."""
    told = control[..., _AT["nod.active"]] > 0
    size = control[..., _AT["nod.size"]].astype(np.float64) * FULL_SIZE["nod"]
    turned, step = _turned(control, told)
    ended = np.zeros_like(told)
    ended[..., 1:] = ~told[..., 1:] & told[..., :-1]  # the row after the last one may be nearest to the end
    for values, more in ((turned, step), (size, 0.0), (step, 0.0)):
        values[..., 1:] = np.where(ended[..., 1:], (values + more)[..., :-1], values[..., 1:])
    swing, angle = np.divmod(turned, _TURN)
    low = (told | ended) & (np.abs(angle - math.pi) <= step)
    back = (told | ended) & (np.minimum(angle, _TURN - angle) <= step / 2) & (turned > math.pi)
    off = angle - math.pi
    nearest = off - step * np.round(off / np.maximum(step, _LEAST_RAD))  # offset of the nearest row from the middle
    # A swing is size (1 - cos angle) / 2, scaled so that the row nearest to its middle reaches the whole size.
    there = size * nod.fall**swing * (1 + np.cos(off)) / np.maximum(1 + np.cos(nearest), _LEAST_RAD)
    wanted = np.where(low, there, np.where(back, 0.0, np.nan))
    return Course(wanted, nod.spread * np.maximum(size, _LEAST_RAD))


def _turned(control: Floats, told: Bools) -> tuple[Doubles, Doubles]:
    """Return the angle that the swings of a nod have turned so far, and its step from row to row, in radians.

    The step is 0 where only one row of the nod is known.
    """
    angle = np.arctan2(control[..., _AT["nod.sine"]], control[..., _AT["nod.cosine"]]).astype(np.float64) % _TURN
    since = since_s(control[..., _AT["nod.since"]])
    same = told[..., 1:] & told[..., :-1] & (since[..., 1:] > since[..., :-1])
    ahead = np.where(same, np.diff(angle, axis=-1) % _TURN, 0.0)
    step = np.zeros_like(angle)
    step[..., 1:] = ahead
    step[..., :-1] = np.where(same, ahead, step[..., :-1])
    whole = np.round((since / FRAME_S * step - angle) / _TURN)  # complete turns before this one
    return angle + _TURN * whole, step


# --- Drawing ----------------------------------------------------------------------------------------------------------


class Sampler:
    """A sampler of the tokens of one listener: frame by frame, every group at once, many streams at a time."""

    def __init__(self, settings: config.Sfms, engine: Engine, codes: Floats, courses: Sequence[EventCourse]) -> None:
        """Create a sampler from the motion `codes` (V, C) of every code, and the courses to follow."""
        groups, common = list(settings.groups.values()), settings.sampling
        self._engine, self._courses = engine, courses
        self._reach = CodeReach(settings, codes, engine.tensors["motion_speed"])
        self._temperature, self._nucleus = np.float32(common.temperature), np.float32(common.nucleus)
        self._bias = np.array([group.transition_bias for group in groups], np.float32)
        self._classes = [group.codes + 1 for group in groups]
        self._ramp = settings.ramp_frames or 0

    def draw(self, seen: Context[NDArray[Any]], settled: Tokens, seeds: Sequence[int], frames: Sequence[int]) -> Tokens:
        """Return `seen.tokens` (B, P + H, G) with its undecided frames drawn.

        Args:
            seen: undecided frames are the last ones of a stream; how many may differ from stream to stream.
            settled: (B,) the last frame of each window whose motion is fixed: no new ramp begins before it.
            seeds: seed of each stream.
            frames: number of the last frame of each window, counted since the stream began.
        """
        tokens = seen.tokens.copy()
        window = tokens.shape[1]
        first = window - int((tokens[..., 0] == UNDECIDED).sum(1).max())
        recent = last_keyframes(tokens)
        (slots,) = self._engine.run("ahead", *seen, *recent)
        last = LastKeyframes(recent.tokens[:, first - 1], recent.at[:, first - 1])
        before = min(first, 2)  # earlier rows, which show the pace of a swing, and that it has just ended
        rows = seen.control[:, first - before :]
        courses = [(told, one) for told in self._courses if (one := told.course(rows)) is not None]
        for frame in range(first, window):
            (flat,) = self._engine.run("next", slots[:, frame - window], *last, np.array([frame - 1]))
            logits = by_group(flat, self._classes)  # (B, G, V)
            since = frame - np.maximum(last.at[..., 0], settled[:, None] if self._ramp else -1)
            np.copyto(logits, np.float32(-np.inf), where=self._reach.too_soon(last.tokens[..., 0], since))
            logits /= self._temperature
            for told, course in courses:
                wanted, spread = (part[:, frame - first + before] for part in course)
                streams, lost = told.penalties(wanted, spread, last.tokens[:, told.group, 0])
                logits[streams, told.group, : lost.shape[1]] -= lost
            chances = [
                uniforms(seed, newest - window + 1 + frame, Use.TOKENS, len(self._bias))
                for seed, newest in zip(seeds, frames, strict=True)
            ]
            drawn = sample(logits, self._bias, self._nucleus, np.array(chances))
            known = tokens[:, frame]
            tokens[:, frame] = np.where(known == UNDECIDED, drawn, known)
            last = with_drawn(last, tokens[:, frame], frame)
        return anchored(tokens, seen.tokens == UNDECIDED, settled, self._ramp) if self._ramp else tokens


def by_group(flat: Floats, classes: Sequence[int]) -> Floats:
    """Return logits (..., G, V) of (..., all classes of all groups), `classes` of each group; -inf for missing ones."""
    out = np.full((*flat.shape[:-1], len(classes), max(classes)), -np.inf, np.float32)
    first = 0
    for group, count in enumerate(classes):
        out[..., group, :count] = flat[..., first : first + count]
        first += count
    return out


def sample(logits: Floats, bias: Floats, nucleus: np.float32, chance: Doubles) -> Tokens:
    """Draw one class (..., G) from logits (..., G, V): bias (G,) on class 0, then the likeliest that hold `nucleus`.

    `chance` (..., G) in 0..1 is the place in that mass.
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
    alike = shares == value  # mostly one class; if there are several, the first ones come first
    before = place - (values > value).sum(-1)
    drawn: Tokens = (alike.cumsum(-1) > before[:, None] if before.any() else alike).argmax(-1)
    return drawn.reshape(logits.shape[:-1])
