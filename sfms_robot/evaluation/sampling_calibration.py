"""The roll-out, brought to the data by what both can be counted on: keyframes.

Teacher forcing never shows the model its own mistakes, so left to itself it places keyframes somewhat too often or
too rarely, and looks restless or frozen. A bias on class 0 per group moves that rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.corpora.clips import Dyad
from sfms_robot.corpora.collection import Dataset, Order, usable
from sfms_robot.corpora.formats import open_for
from sfms_robot.evaluation.rollout import OfflineRollout, offline_rollout
from sfms_robot.learning.sfms.features import gather
from sfms_robot.learning.sfms.predictor_trainer import corrected
from sfms_robot.learning.sfms.tokens import tokenise
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms import torch_engine
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace

DYADS = 8  # that are listened to
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
    some = _some(open_for(space.name, data, "train", order, [settings.audio]), settings.window_frames)
    checkpoint.save_config(out, calibrated(corrected(training), model, some, training.predictor, each=each))


def rounds(training: config.Training) -> int:
    """Rounds of roll-outs that `calibrate` takes."""
    return training.predictor.calibration_rounds


def _some(dyads: Dataset, window: int) -> list[Dyad]:
    """A few dyads of a set, spread over it, that are as long as a window; if none of those is, the first that is."""
    chosen = [*usable(dyads[:: max(1, len(dyads) // DYADS)])][:DYADS]
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


def _rolled_out(listener: SfmsListener, dyads: Sequence[Dyad], seed: int) -> list[OfflineRollout]:
    return [
        offline_rollout(listener, dyad, range(seed + STREAMS * index, seed + STREAMS * (index + 1)))
        for index, dyad in enumerate(dyads)
    ]


def _rates(tokens: Tensor) -> list[float]:
    """Keyframes per frame of each group, in tokens (N, G)."""
    return [float(rate) for rate in (tokens > 0).float().mean(0)]
