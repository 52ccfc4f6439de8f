"""How well a tokenizer restores faces it has not seen: one score per row of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import torch
from torch import Tensor

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, SHAPES, Doubles
from sfms_robot.lab.evaluation.paper.compared_tokenizer import TableModel
from sfms_robot.lab.learning.corpus import first_frames, windows
from sfms_robot.signals.tracks import Take

ANGLES: Final = slice(CHANNEL_INDEX["roll"], CHANNEL_INDEX["yaw"] + 1)


@dataclass(frozen=True)
class Windows:
    """What is scored: `motion` (W, T, 58) consecutive windows in our units, and the take each is from."""

    motion: Tensor
    takes: tuple[str, ...]

    @classmethod
    def of(cls, takes: Sequence[Take], window: int) -> Windows:
        """The windows of all takes. Raises ConfigError when no take is as long as one."""
        usable = [take for take in takes if len(take.motion) >= window]
        if not usable:
            raise ConfigError(f"none of {len(takes)} stretches with a face is as long as a window of {window} frames")
        lengths = [len(take.motion) for take in usable]
        motion = torch.cat([torch.from_numpy(take.motion) for take in usable])
        names = tuple(take.name for take in usable for _ in range(len(take.motion) // window))
        return cls(windows(motion, first_frames(lengths, window, window), window), names)


@dataclass(frozen=True)
class Score:
    """Errors of one tokenizer on W windows.

    Attributes:
        errors: (W, C) mean squared over time, in deviations of the training motion.
        angle_rmse_rad, shape_rmse: over all windows; the latter of 0..1.
    """

    takes: tuple[str, ...]
    errors: Doubles
    angle_rmse_rad: float
    shape_rmse: float

    @cached_property
    def of_windows(self) -> Doubles:
        """(W,) over all channels: what the tables mean by MSE."""
        return np.asarray(self.errors.mean(axis=1))

    @property
    def mse(self) -> float:
        return float(self.of_windows.mean())

    @property
    def median(self) -> float:
        return float(np.median(self.of_windows))

    @property
    def per_take(self) -> dict[str, float]:
        names = np.array(self.takes)
        return {take: float(self.of_windows[names == take].mean()) for take in dict.fromkeys(self.takes)}


def score(model: TableModel, seen: Windows, restored: Tensor | None = None) -> Score:
    """Score of a tokenizer, of what it `restored` (W, T, 58), standardised, where that is at hand."""
    motion = model.standardise(seen.motion)
    wrong = ((model.restore(motion) if restored is None else restored) - motion).double()
    plain = (wrong * model.motion_std).square().mean((0, 1))
    return Score(
        takes=seen.takes,
        errors=wrong.square().mean(1).numpy(),
        angle_rmse_rad=float(plain[ANGLES].mean().sqrt()),
        shape_rmse=float(plain[SHAPES].mean().sqrt()),
    )
