"""The roll-out, brought to the data by what both can be counted on: keyframes, how large nods are, and how smiles go.

Teacher forcing never shows the model its own mistakes, so left to itself it places keyframes somewhat too often or
too rarely, and looks restless or frozen. A bias on class 0 per group moves that rate.

Nods that are told come out nearer to the usual size than they are told to be: a small network hears a size less well
than that there is a nod. How much nearer is a line, fitted to nods that were told and what was made of them; a stream
is told the size that the line turns into the one asked for. How smiles go is taken from the data as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.corpora.clips import Dyad
from sfms_robot.corpora.collection import Dataset, Order, usable
from sfms_robot.corpora.formats import open_for
from sfms_robot.evaluation.rollout import OfflineRollout, offline_rollout
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, SMILE_CORNERS, Doubles
from sfms_robot.learning.corpus import without_gaze
from sfms_robot.learning.sfms.features import gather
from sfms_robot.learning.sfms.predictor_trainer import corrected
from sfms_robot.learning.sfms.tokens import tokenise
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms import torch_engine
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace

DYADS = 8  # that are listened to
NOD_DYADS = 32  # likewise, for their nods
LEAST_NODS = 20
SMILE_DYADS = 128  # likewise, for their smiles: nothing is rolled out
LEAST_SMILES = 10
GAINS = (0.4, 2.0)  # what is not between them is no answer to what was told
AROUND_FRAMES = 2  # of a nod, which are looked at
LARGEST_STEP = 1.0  # of a bias, per round
STREAMS = 4  # of every dyad, side by side

Progress = Callable[[], object]


def calibrate(
    training: config.Training, data: Path, out: Path, order: Order | None = None, each: Progress = lambda: None
) -> None:
    """Fit how the listener trained in `out` is sampled, on some training dyads, and write `out`/config.yaml anew.

    Blocks for minutes; `each()` is called after every round of roll-outs, `rounds(training)` times.
    """
    settings, space = training.listener, MotionSpace.of(training.listener)
    model = SfmsModel(settings)
    checkpoint.load_weights(out / checkpoint.WEIGHTS, model)
    every = open_for(space.name, data, "train", order, [settings.audio])
    some = _some(every, settings.window_frames)
    found = calibrated(corrected(training), model, some, training.predictor, each=each)
    if found.events and training.predictor.calibration_rounds:
        found = coursed(found, _some(every, settings.window_frames, SMILE_DYADS))
        found = sized(found, model, _some(every, settings.window_frames, NOD_DYADS))
        each()
    checkpoint.save_config(out, found)


def rounds(training: config.Training) -> int:
    """Rounds of roll-outs that `calibrate` takes."""
    placings = training.predictor.calibration_rounds
    return placings + bool(placings and training.listener.events)


def _some(dyads: Dataset, window: int, count: int = DYADS) -> list[Dyad]:
    """A few dyads of a set, spread over it, that are as long as a window; if none of those is, the first that is."""
    chosen = [*usable(dyads[:: max(1, len(dyads) // count)])][:count]
    long = [dyad for dyad in chosen if len(dyad.listener) >= window]
    return long or [next(dyad for dyad in usable(dyads) if len(dyad.listener) >= window)]


def calibrated(
    settings: config.Sfms,
    model: SfmsModel,
    dyads: Sequence[Dyad],
    training: config.PredictorTraining,
    seed: int = 1,
    each: Progress = lambda: None,
) -> config.Sfms:
    """`settings` with biases fitted on `dyads`. The model is left in evaluation mode."""
    for _ in range(training.calibration_rounds):
        settings = placing(settings, model, dyads, seed)
        each()
    return settings


def placing(settings: config.Sfms, model: SfmsModel, dyads: Sequence[Dyad], seed: int) -> config.Sfms:
    """One round: biases that would have brought the keyframe rates of a roll-out to those of the data."""
    listener = SfmsListener(settings, torch_engine(settings, model.eval()))
    wanted = _rates(tokenise(model, gather(dyads, settings.window_frames, listener.space, None, settings)))
    rates = _rates(torch.cat([one.tokens.flatten(0, 1) for one in _rolled_out(listener, dyads, seed)]))
    groups = {}
    for (name, group), has, wants in zip(settings.groups.items(), rates, wanted, strict=True):
        step = math.log(max(has, 1e-4) / (1 - has) * (1 - wants) / wants)
        bias = group.transition_bias + max(-LARGEST_STEP, min(LARGEST_STEP, step))
        groups[name] = group.model_copy(update={"transition_bias": round(bias, 3)})
    return settings.model_copy(update={"groups": groups})


def sized(settings: config.Sfms, model: SfmsModel, dyads: Sequence[Dyad], seed: int = 1) -> config.Sfms:
    """`settings` that know how large nods come out, found on `dyads` whose nods are told at their own sizes.

    Left as they are where the dyads hold fewer than `LEAST_NODS`, or all of one size.
    """
    plain = _sampling(settings, nod_size=config.MadeSize())
    listener = SfmsListener(plain, torch_engine(plain, model.eval()))
    rolled = _rolled_out(listener, dyads, seed)
    told, made = np.concatenate([_nods(listener, *each) for each in zip(dyads, rolled, strict=True)]).T
    if len(told) < LEAST_NODS * STREAMS or np.ptp(told) < 1.0:
        return settings
    return _sampling(settings, nod_size=made_size(told, made))


def _sampling(settings: config.Sfms, **changes: config.MadeSize | config.SmileCourse) -> config.Sfms:
    """`settings` that sample otherwise."""
    return settings.model_copy(update={"sampling": settings.sampling.model_copy(update=changes)})


def made_size(told_deg: Doubles, made_deg: Doubles) -> config.MadeSize:
    """The line, by least squares, from sizes told (K,) to sizes made (K,): all the error is in what is made."""
    gain, offset_deg = np.polyfit(told_deg, made_deg, 1)
    kept = float(np.clip(gain, *GAINS))
    if kept != gain:
        offset_deg = np.mean(made_deg) - kept * np.mean(told_deg)
    return config.MadeSize(gain=round(kept, 3), offset_deg=round(float(offset_deg), 3))


def _nods(listener: SfmsListener, dyad: Dyad, rolled: OfflineRollout) -> Doubles:
    """(K, 2) of the nods of one dyad in every stream: degrees told, and made.

    What else a head does meanwhile widens its way in a roll-out as in the dyad: only the difference of both counts.
    """
    streams, frames, _ = rolled.motion.shape
    faces, _ = listener.space.decode(rolled.motion.flatten(0, 1).numpy())
    ours = faces[:, CHANNEL_INDEX["pitch"]].reshape(streams, frames)
    theirs = without_gaze(dyad).listener[:, CHANNEL_INDEX["pitch"]]
    found = []
    for nod in dyad.events or ():
        first = max(0, round(nod.start_s / FRAME_S) - AROUND_FRAMES)
        last = round(nod.end_s / FRAME_S) + AROUND_FRAMES
        if nod.kind == "nod" and last <= frames:
            more = np.ptp(ours[:, first:last], axis=1) - np.ptp(theirs[first:last])
            found += [(nod.size, nod.size + float(each)) for each in more]
    return np.degrees(np.array(found, np.float64).reshape(-1, 2))


def coursed(settings: config.Sfms, dyads: Sequence[Dyad]) -> config.Sfms:
    """`settings` with the median course of smiles of `dyads`, where smiles keep to one; as they are, if too few do."""
    smile = settings.sampling.smile
    if smile is None:
        return settings
    found = [np.array(rows) for rows in zip(*(row for dyad in dyads for row in _courses(dyad)), strict=True)]
    if not found or len(found[0]) < LEAST_SMILES:
        return settings
    rise, fall = (np.clip(np.median(rows, axis=0), 0, 1).round(3).tolist() for rows in found)
    return _sampling(settings, smile=config.SmileCourse(spread=smile.spread, rise=tuple(rise), fall=tuple(fall)))


def _courses(dyad: Dyad) -> Iterator[tuple[Doubles, Doubles]]:
    """Shares of its size at `RISE_S` and `FALL_S` of each smile that is long enough for both, and of no laugh."""
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


def _rolled_out(listener: SfmsListener, dyads: Sequence[Dyad], seed: int) -> list[OfflineRollout]:
    return [
        offline_rollout(listener, dyad, range(seed + STREAMS * index, seed + STREAMS * (index + 1)))
        for index, dyad in enumerate(dyads)
    ]


def _rates(tokens: Tensor) -> list[float]:
    """Keyframes per frame of each group, in tokens (N, G)."""
    return [float(rate) for rate in (tokens > 0).float().mean(0)]
