"""Tokens out of probabilities: frame by frame, every group at once, many streams at a time.

A group may be guided (Ho and Salimans 2022, classifier-free guidance, there for diffusion): training leaves voice and
face out now and then, so the predictor also knows what its classes are with nobody there, and

    guided = unheard + guidance * (heard - unheard),   logits, per group and class.

Above 1 what the speaker does weighs more than it did in training: movement that he makes likelier becomes more frequent
still, and restlessness that nobody called for rarer. The paper has none, which is guidance 1 and takes no time.

Listeners are trained while somebody speaks. When nobody has for a while (from 1.6 s of silence on, wholly from 3.2 s)
little was learned: guidance fades to 1 there, and a group may draw from a smaller nucleus, which keeps it still.

Both made rare nods come when they should. A listener that is told of events has no need of them: its nods are decided
elsewhere. The weights of 0.1.0 have.
"""

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
from sfms_robot.signals.phase import PHRASE_KNOTS_S, SILENCE_KNOTS_S, SPEECH_KNOTS_S

# 1 at the hats of `phase.features` that stand for silence up to 1.6 s: their sum falls from 1 there to 0 at 3.2 s.
SILENCE_LATELY = np.array(
    [0.0] * len(SPEECH_KNOTS_S) + [float(knot <= 1.6) for knot in SILENCE_KNOTS_S] + [0.0] * len(PHRASE_KNOTS_S),
    np.float32,
)
LIKELIEST = 128  # classes that are looked at: what is behind them weighs next to nothing


@dataclass(frozen=True)
class Seen:
    """What a plan may look at: the parts of `predictor.Context`, those of the speaker of 1 or B streams."""

    face: Floats
    face_known: NDArray[np.bool_]
    voice: Floats
    heard: NDArray[np.bool_]
    phase: Floats
    tokens: Tokens
    control: Floats


class Sampler:
    """How the tokens of one listener are drawn: its predictor, and what its settings say of every group."""

    def __init__(self, settings: config.Sfms, engine: Engine, reach: Reach, courses: Sequence[ToldCourse] = ()) -> None:
        groups, common = list(settings.groups.values()), settings.sampling
        self._engine, self._reach, self._courses = engine, reach, courses
        self._temperature = np.float32(common.temperature)
        self._bias = np.array([group.transition_bias for group in groups], np.float32)
        nucleus = [group.nucleus or common.nucleus for group in groups]
        self._nucleus = np.array(nucleus, np.float32)
        alone = [group.nucleus_in_silence or own for group, own in zip(groups, nucleus, strict=True)]
        self._nucleus_in_silence = np.array(alone, np.float32)
        self._guidance = np.array([group.guidance for group in groups], np.float32)[:, None]
        self._classes = [group.codes + 1 for group in groups]
        self._now, self._ramp = settings.past_frames - 1, settings.ramp_frames or 0

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
        lately = self._lately(seen)
        guidance = 1 + (self._guidance - 1) * lately[:, None, None]  # (1 or B, G, 1)
        nucleus = self._nucleus_in_silence + (self._nucleus - self._nucleus_in_silence) * lately[:, None]
        chances = self._chances(seeds, frames, window - first)
        before = min(first, 2)  # rows that say how fast a swing is, and that it has just ended
        rows = seen.control[:, first - before :]
        courses = [(told, one) for told in self._courses if (one := told.course(rows)) is not None]
        for frame in range(first, window):
            (flat,) = self._engine.run("next", slots[..., frame - window, :], *last, np.array([frame - 1]))
            at = frame - first + before
            now = [(told, one.wanted[:, at], one.spread[:, at]) for told, one in courses]
            since = frame - np.maximum(last.at[..., 0], self._now if self._ramp else -1)  # no ramp began before that
            drawn = self._drawn(flat, last, since, guidance, nucleus, chances[:, frame - window], now)
            known = tokens[:, frame]
            tokens[:, frame] = np.where(known == UNDECIDED, drawn, known)
            last = last.then(tokens[:, frame], frame)
        return anchored(tokens, seen.tokens == UNDECIDED, self._now, self._ramp) if self._ramp else tokens

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
        guidance: Floats,
        nucleus: Floats,
        chance: Doubles,
        courses: Sequence[tuple[ToldCourse, Doubles, Doubles]],
    ) -> Tokens:
        """Tokens (B, G) of a frame from the logits (B, N, classes of all groups) of the network `next`.

        `since` (B, G): frames in which each group may have got there from its last keyframe.

        `courses`: those that are told, each with the row (B,) of what is wanted, and its spread.
        """
        logits = by_group(flat, self._classes)  # (B, N, G, V)
        possible: Floats = guided(logits[:, 0], logits[:, 1], guidance) if logits.shape[1] > 1 else logits[:, 0]
        too_soon = self._reach.too_soon(last.tokens[..., 0], since)
        np.copyto(possible, np.float32(-np.inf), where=too_soon)
        possible /= self._temperature
        for told, wanted, spread in courses:
            streams, lost = told.penalties(wanted, spread, last.tokens[:, told.group, 0])
            possible[streams, told.group, : lost.shape[1]] -= lost
        return sample(possible, self._bias, nucleus, chance)

    def _lately(self, seen: Seen) -> Floats:
        """(1 or B,) 1 where somebody speaks or did 1.6 s ago, 0 from 3.2 s of silence on; 1 if that is unknown."""
        if not seen.phase.shape[-1]:
            return np.ones(len(seen.heard), np.float32)
        return np.where(seen.heard[:, -1], seen.phase[:, -1] @ SILENCE_LATELY, np.float32(1))


def by_group(flat: Floats, classes: Sequence[int]) -> Floats:
    """Logits (..., all classes of all groups), `classes` of each -> (..., G, V); -inf for those that a group lacks."""
    out = np.full((*flat.shape[:-1], len(classes), max(classes)), -np.inf, np.float32)
    first = 0
    for group, count in enumerate(classes):
        out[..., group, :count] = flat[..., first : first + count]
        first += count
    return out


def guided(heard: Floats, unheard: Floats, guidance: Floats) -> Floats:
    """Logits (..., G, V) with the speaker and with nobody, guidance (..., G, 1) -> logits; `heard` where that is 1."""
    untouched = (guidance == 1) | np.isinf(heard)  # classes that a group lacks
    with np.errstate(invalid="ignore"):
        return np.where(untouched, heard, unheard + guidance * (heard - unheard))


def sample(logits: Floats, bias: Floats, nucleus: Floats, chance: Doubles) -> Tokens:
    """One class (..., G) of each logits (..., G, V): bias (G,) on class 0, then the likeliest that hold `nucleus`.

    `chance`, both (..., G) in 0..1, says where in that mass: a class is drawn as often as it is likely.
    """
    biased = logits.copy()
    biased[..., 0] += bias
    biased -= biased.max(-1, keepdims=True)
    shares = np.exp(biased, out=biased).reshape(-1, logits.shape[-1])  # (R, V), a row for every draw
    shares /= shares.sum(-1, keepdims=True)
    within = np.broadcast_to(nucleus, logits.shape[:-1]).reshape(-1, 1)
    values = np.sort(shares, axis=-1)[:, : -LIKELIEST - 1 : -1]  # largest first
    mass = values.cumsum(-1)
    kept = (mass - values < within).sum(-1)
    row = np.arange(len(mass))
    point = chance.reshape(-1) * mass[row, kept - 1]
    place = np.minimum((mass <= point[:, None]).sum(-1), kept - 1)
    value = values[row, place][:, None]
    alike = shares == value  # mostly that class alone; of several the first ones come first
    before = place - (values > value).sum(-1)
    drawn: Tokens = (alike.cumsum(-1) > before[:, None] if before.any() else alike).argmax(-1)
    return drawn.reshape(logits.shape[:-1])
