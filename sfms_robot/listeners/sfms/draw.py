"""Tokens out of probabilities: frame by frame, every group at once, many streams at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.frames import Doubles, Floats
from sfms_robot.listeners.engine import Engine
from sfms_robot.listeners.lots import Use, uniforms
from sfms_robot.listeners.sfms.courses import ToldCourse
from sfms_robot.listeners.sfms.keyframes import UNDECIDED, LastKeyframes, Tokens, anchored, last_keyframes
from sfms_robot.listeners.sfms.reachable import Reach

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
