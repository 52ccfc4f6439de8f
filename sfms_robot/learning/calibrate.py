"""The roll-out, brought to the data by what both can be counted on: keyframes by a bias, nods by a nucleus.

Teacher forcing never shows the model its own mistakes, so left to itself it places keyframes somewhat too often or
too rarely, and looks restless or frozen. A bias on class 0 per group moves that rate. Nods are rarer than keyframes and
end up too many or too few at the same rate of keyframes: how much of the tail the group that pitches the head may draw
from decides that, so of several nuclei the one that nods as often as the people did is taken. Guidance and the nucleus
in silence are the recipe's: a few dyads hold far too few nods to tell when they come.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.corpora.clips import Dyad
from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, Floats
from sfms_robot.learning.answers import Answers, answers, heard_by
from sfms_robot.learning.sfms.corpus import gather
from sfms_robot.learning.sfms.tokens import tokenise
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.signals import events as timing

LARGEST_STEP = 1.0  # of a bias, per round
STREAMS = 4  # of every dyad, side by side
PITCH = ("pitch", "rotation_x", "head_x")  # what a nod moves, in any motion space


def calibrated(
    settings: config.Sfms, model: SfmsModel, dyads: Sequence[Dyad], training: config.PredictorTraining, seed: int = 1
) -> config.Sfms:
    """`settings` with biases and nucleus fitted on `dyads`. The model is left in evaluation mode."""
    for _ in range(training.calibration_rounds):
        settings = placing(settings, model, dyads, seed)
    return nodding(settings, model, dyads, training.nod_nuclei, seed) if training.nod_nuclei else settings


def placing(settings: config.Sfms, model: SfmsModel, dyads: Sequence[Dyad], seed: int) -> config.Sfms:
    """One round: biases that would have brought the keyframe rates of a roll-out to those of the data."""
    listener = SfmsListener(settings, model)
    wanted = _rates(tokenise(model, gather(dyads, settings.window_frames, listener.space)))
    rates = _rates(torch.cat([one.tokens.flatten(0, 1) for one in _rolled_out(listener, dyads, seed)]))
    groups = {}
    for (name, group), has, wants in zip(settings.groups.items(), rates, wanted, strict=True):
        step = math.log(max(has, 1e-4) / (1 - has) * (1 - wants) / wants)
        bias = group.transition_bias + max(-LARGEST_STEP, min(LARGEST_STEP, step))
        groups[name] = group.model_copy(update={"transition_bias": round(bias, 3)})
    return settings.model_copy(update={"groups": groups})


def nodding(
    settings: config.Sfms, model: SfmsModel, dyads: Sequence[Dyad], nuclei: Sequence[float], seed: int
) -> config.Sfms:
    """The nucleus of `nuclei`, for the group that pitches the head, with which nods are as many as in the data."""
    people = SfmsListener(settings, model)
    wanted = nods_per_minute([_shown(people, heard_by(people, dyad).motion[None]) for dyad in dyads], dyads)
    tried = [_with_nucleus(settings, nucleus) for nucleus in nuclei]
    away = []
    for one in tried:
        listener = SfmsListener(one, model)
        shown = [_shown(listener, answer.motion) for answer in _rolled_out(listener, dyads, seed)]
        away.append(abs(math.log((nods_per_minute(shown, dyads) + 0.1) / (wanted + 0.1))))
    return tried[int(np.argmin(away))]


def nods_per_minute(motions: Sequence[Floats], dyads: Sequence[Dyad]) -> float:
    """Nods of (S, N, 58) motions, each beside its dyad, per minute of listening."""
    onsets, minutes = 0, 0.0
    for motion, dyad in zip(motions, dyads, strict=True):
        for one in motion:
            starts = [
                int(start * FRAME_HZ) for start, _, _ in timing.find_nods(one[:, CHANNEL_INDEX["pitch"]], FRAME_HZ)
            ]
            onsets += int(dyad.listening[starts].sum())
            minutes += float(dyad.listening.sum()) / FRAME_HZ / 60
    return onsets / minutes if minutes else 0.0


def _with_nucleus(settings: config.Sfms, nucleus: float) -> config.Sfms:
    groups = {
        name: group.model_copy(update={"nucleus": nucleus}) if set(PITCH) & set(group.channels) else group
        for name, group in settings.groups.items()
    }
    return settings.model_copy(update={"groups": groups})


def _rolled_out(listener: SfmsListener, dyads: Sequence[Dyad], seed: int) -> list[Answers]:
    return [
        answers(listener, heard_by(listener, dyad), range(seed + STREAMS * index, seed + STREAMS * (index + 1)))
        for index, dyad in enumerate(dyads)
    ]


def _shown(listener: SfmsListener, motion: Tensor) -> Floats:
    """(S, N, D) in the model's space -> (S, N, 58)."""
    return np.stack([listener.space.decode(one)[0] for one in motion.numpy()])


def _rates(tokens: Tensor) -> list[float]:
    """Keyframes per frame of each group, in tokens (N, G)."""
    return [float(rate) for rate in (tokens > 0).float().mean(0)]
