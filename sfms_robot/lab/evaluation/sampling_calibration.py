"""Calibration of sampling on training data: the rate of keyframes, and the course of nods and smiles.

Teacher forcing never shows the model its own mistakes, so in a roll-out it places keyframes somewhat too often or too
rarely, and looks restless or frozen. A bias on class 0 per group corrects that rate. For a listener with a fixed course
of nods and smiles, the course is the median of the data's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, SMILE_CORNERS, Doubles
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Dataset, Order, usable
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.evaluation.rollout import offline_rollout
from sfms_robot.lab.learning.corpus import without_gaze
from sfms_robot.lab.learning.sfms.features import gather, tokenise
from sfms_robot.lab.learning.sfms.predictor_trainer import corrected
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.listeners.torch_engine import torch_engine

DYADS = 8  # that are rolled out
COURSE_DYADS = 128  # for their nods and smiles, without roll-outs
LEAST = 10  # of a kind, to know its course
LARGEST_STEP = 1.0  # of a bias, per round
STREAMS = 4  # of every dyad, side by side

Progress = Callable[[], object]


def calibrate(
    training: config.Training, data: Path, out: Path, order: Order | None = None, each: Progress = lambda: None
) -> None:
    """Calibrate the listener trained in `out` on some training dyads, and rewrite `out`/config.yaml.

    Blocks for minutes; calls `each()` after every round of roll-outs, `rounds(training)` times.
    """
    settings, space = training.listener, MotionSpace.of(training.listener)
    model = SfmsModel(settings)
    checkpoint.load_weights(out / checkpoint.WEIGHTS, model)
    every = open_for(space.name, data, "train", order, [settings.audio])
    some = _some(every, settings.window_frames)
    found = corrected(training)
    for _ in range(training.predictor.calibration_rounds):
        found = placing(found, model, some)
        each()
    if found.events and training.predictor.calibration_rounds:
        found = coursed(found, _some(every, settings.window_frames, COURSE_DYADS))
        each()
    checkpoint.save_config(out, found)


def rounds(training: config.Training) -> int:
    """Return the rounds of `calibrate`."""
    placings = training.predictor.calibration_rounds
    return placings + bool(placings and training.listener.events)


def _some(dyads: Dataset, window: int, count: int = DYADS) -> list[Dyad]:
    """Return a few dyads, spread over a set, that are as long as a window; or else the first one that is."""
    chosen = [*usable(dyads[:: max(1, len(dyads) // count)])][:count]
    long = [dyad for dyad in chosen if len(dyad.listener) >= window]
    return long or [next(dyad for dyad in usable(dyads) if len(dyad.listener) >= window)]


def placing(settings: config.Sfms, model: SfmsModel, dyads: Sequence[Dyad], seed: int = 1) -> config.Sfms:
    """Return `settings` with biases that would have given a roll-out the keyframe rates of the data.

    The model is left in evaluation mode.
    """
    listener = SfmsListener(settings, torch_engine(model.eval()))
    wanted = _rates(tokenise(model, gather(dyads, settings.window_frames, listener.space, None, settings)))
    rolled = [
        offline_rollout(listener, dyad, range(seed + STREAMS * index, seed + STREAMS * (index + 1)))
        for index, dyad in enumerate(dyads)
    ]
    rates = _rates(torch.cat([one.tokens.flatten(0, 1) for one in rolled]))
    groups = {}
    for (name, group), has, wants in zip(settings.groups.items(), rates, wanted, strict=True):
        step = math.log(max(has, 1e-4) / (1 - has) * (1 - wants) / wants)
        bias = group.transition_bias + max(-LARGEST_STEP, min(LARGEST_STEP, step))
        groups[name] = group.model_copy(update={"transition_bias": round(bias, 3)})
    return settings.model_copy(update={"groups": groups})


def coursed(settings: config.Sfms, dyads: Sequence[Dyad]) -> config.Sfms:
    """Return `settings` with the median course of nods and smiles of `dyads`, for kinds that have enough of them."""
    nod, smile = settings.sampling.nod, settings.sampling.smile
    if nod is not None:
        falls = [fall for dyad in dyads for fall in _falls(dyad)]
        if len(falls) >= LEAST:
            nod = config.NodCourse(spread=nod.spread, fall=round(float(np.clip(np.median(falls), 0, 1)), 3))
    if smile is not None:
        found = [np.array(rows) for rows in zip(*(row for dyad in dyads for row in _smiles(dyad)), strict=True)]
        if found and len(found[0]) >= LEAST:
            rise, fall = (np.clip(np.median(rows, axis=0), 0, 1).round(3).tolist() for rows in found)
            smile = config.SmileCourse(spread=smile.spread, rise=tuple(rise), fall=tuple(fall))
    sampling = settings.sampling.model_copy(update={"nod": nod, "smile": smile})
    return settings.model_copy(update={"sampling": sampling})


def _falls(dyad: Dyad) -> Iterator[float]:
    """Yield the size of the second swing over that of the first, of each nod that has one."""
    pitch = without_gaze(dyad).listener[:, CHANNEL_INDEX["pitch"]]
    for event in dyad.events or ():
        swing = event.duration_s / event.swings / FRAME_S
        bounds = [round(event.start_s / FRAME_S + swing * number) for number in range(3)]
        if event.kind == "nod" and event.swings > 1 and bounds[0] >= 0 and bounds[2] <= len(pitch):
            first, second = (float(np.ptp(pitch[low:high])) for low, high in pairwise(bounds))
            yield second / max(first, 1e-6)


def _smiles(dyad: Dyad) -> Iterator[tuple[Doubles, Doubles]]:
    """Yield the shares of its size at `RISE_S` and `FALL_S` of each smile long enough for both, without a laugh."""
    corners = dyad.listener[:, [CHANNEL_INDEX[name] for name in SMILE_CORNERS]].mean(axis=1)
    times_s = (1 + np.arange(len(corners))) * FRAME_S
    rise_s, fall_s = np.array(config.SmileCourse.RISE_S), np.array(config.SmileCourse.FALL_S)
    laughs = [event for event in dyad.events or () if event.kind == "laugh"]
    for event in dyad.events or ():
        whole = event.duration_s >= rise_s[-1] + fall_s[-1] and event.start_s >= 0 and event.end_s <= times_s[-1]
        alone = not any(one.start_s < event.end_s and one.end_s > event.start_s for one in laughs)
        if event.kind == "smile" and whole and alone:
            at = (event.start_s + rise_s, event.end_s - fall_s)
            first, last = (np.interp(when, times_s, corners) / event.size for when in at)
            yield first, last


def _rates(tokens: Tensor) -> list[float]:
    """Return keyframes per frame of each group, in tokens (N, G)."""
    return [float(rate) for rate in (tokens > 0).float().mean(0)]
