"""Keyframe rates of the roll-out, brought to those of the data by one bias per group on class 0.

Teacher forcing never shows the model its own mistakes, so left to itself it places keyframes somewhat too often or
too rarely, and looks restless or frozen. The rate is a number both sides have; the bias is what moves it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.learning.corpus import gather
from sfms_robot.learning.datasets.clips import Dyad
from sfms_robot.learning.rollout import speaker_frames
from sfms_robot.learning.tokens import tokenise
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace

LARGEST_STEP = 1.0  # of a bias, per round


def calibrated(
    settings: config.Sfms, model: SfmsModel, dyads: Sequence[Dyad], rounds: int, seed: int = 1
) -> config.Sfms:
    """`settings` with the biases of `rounds` roll-outs over `dyads`. The model is left in evaluation mode."""
    space = MotionSpace.of(settings)
    wanted = data_rates(model, dyads, settings.window_frames, space)
    for _ in range(rounds):
        rates = rollout_rates(SfmsListener(settings, model), dyads, seed)
        groups = {}
        for (name, group), has, wants in zip(settings.groups.items(), rates, wanted, strict=True):
            step = math.log(max(has, 1e-4) / (1 - has) * (1 - wants) / wants)
            bias = group.transition_bias + max(-LARGEST_STEP, min(LARGEST_STEP, step))
            groups[name] = group.model_copy(update={"transition_bias": round(bias, 3)})
        settings = settings.model_copy(update={"groups": groups})
    return settings


def data_rates(model: SfmsModel, dyads: Sequence[Dyad], window: int, space: MotionSpace) -> list[float]:
    """Keyframes per frame of each group in the dyads' own listeners."""
    return _rates(tokenise(model, gather(dyads, window, space)))


def rollout_rates(listener: SfmsListener, dyads: Sequence[Dyad], seed: int) -> list[float]:
    """Keyframes per frame of each group when the listener is left to itself."""
    drawn = []
    for index, dyad in enumerate(dyads):
        memory = listener.start(seed + index)
        for frame in speaker_frames(dyad):
            plan, memory = listener.step(frame, memory)
            if plan is not None:
                drawn.append(memory.ahead[-listener.hop :])
    return _rates(torch.cat(drawn))


def _rates(tokens: Tensor) -> list[float]:
    return [float(rate) for rate in (tokens > 0).float().mean(0)]
