"""Can a small network tell a listener's motion from people's? A classifier two-sample test (Lopez-Paz and Oquab 2017).

Both motions are cut into windows of two seconds, by region of the face. Both go through the same 6 Hz low-pass and get
the noise of a face tracker, so that what is judged is motion, not rounding or a missing tremor. A network of three
convolutions learns on the windows of most dyads and scores those of the others, in folds by dyad: no speaker, no
stretch of a meeting is on both sides. The area under its ROC curve is 0.5 where it cannot tell, 1 where it always can.

Network, windows, noise and seeds are fixed here: a figure is comparable from one version to the next, and nothing here
may ever become a training loss.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt
from torch import Tensor, nn

from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, FRAME_HZ, Doubles, Floats
from sfms_robot.lab.evaluation.phrase_timing import rank_auc

REGIONS: Final[Mapping[str, tuple[int, ...]]] = {
    "head": tuple(range(6)),
    "eyes": tuple(CHANNEL_INDEX[name] for name in CHANNELS if name.startswith("eyeLook")),
    "lids": tuple(CHANNEL_INDEX[name] for name in CHANNELS if name.startswith(("eyeBlink", "eyeSquint", "eyeWide"))),
    "mouth": tuple(CHANNEL_INDEX[n] for n in CHANNELS if n.startswith(("jaw", "mouth", "cheek", "nose", "tongue"))),
    "brows": tuple(CHANNEL_INDEX[name] for name in CHANNELS if name.startswith("brow")),
}
WINDOW: Final = 2 * FRAME_HZ
LOW_PASS_HZ: Final = 6.0
NOISE: Final = np.array([np.deg2rad(0.15)] * 3 + [0.0005] * 3 + [0.02] * 52)  # rad, m, of full closure
FOLDS: Final = 5
STEPS: Final = 240
BATCH: Final = 64
WIDTH: Final = 24
LEARNING_RATE: Final = 3e-3
WEIGHT_DECAY: Final = 0.02
RESAMPLED: Final = 400  # times, of dyads, for an interval
SEED: Final = 20
_CHUNK: Final = 512


@dataclass(frozen=True)
class Told:
    """How well they are told apart: area under the ROC curve and its 95 % interval over dyads."""

    auc: float
    low: float
    high: float


def windows(motion: Floats, rng: np.random.Generator, judged: NDArray[np.bool_] | None = None) -> Floats:
    """Motion (N, 58) -> (W, 50, 58): low-passed, with a tracker's noise, in windows of two seconds side by side; those
    of `judged` (N,) frames alone.

    A motion shorter than a window gives none.
    """
    if len(motion) < WINDOW:
        return np.zeros((0, WINDOW, motion.shape[1]), np.float32)
    sections = butter(4, LOW_PASS_HZ, fs=FRAME_HZ, output="sos")
    smooth = sosfiltfilt(sections, motion.astype(np.float64), axis=0)
    seen = smooth + NOISE * rng.standard_normal(smooth.shape)
    whole = len(seen) // WINDOW
    cut = np.asarray(seen[: whole * WINDOW].reshape(whole, WINDOW, -1), np.float32)
    return cut if judged is None else cut[judged[: whole * WINDOW].reshape(whole, WINDOW).all(axis=1)]


def levelled(part: Floats) -> Floats:
    """Windows (W, 50, 58) of one motion, each channel less its mean over them and over its deviation.

    What rests where, and how widely a face moves, differs from take to take; what is left is how it moves.
    """
    if not len(part):
        return part
    return np.asarray((part - part.mean(axis=(0, 1))) / part.std(axis=(0, 1)).clip(min=1e-6), np.float32)


def told_apart(
    ours: Sequence[Floats], theirs: Sequence[Floats], region: str, each: Callable[[], object] = lambda: None
) -> Told:
    """Windows by dyad, (W, 50, 58) each; dyad d of both is the same dyad, or at least nobody of another one.

    `each()` after every fold. Raises ValueError for fewer dyads than folds.
    """
    if len(ours) != len(theirs) or len(ours) < FOLDS:
        raise ValueError(f"{len(ours)} and {len(theirs)} dyads: as many of both, {FOLDS} or more")
    channels = list(REGIONS[region])
    clips = [part[..., channels] for part in (*ours, *theirs)]
    sizes = [len(part) for part in clips]
    dyad = np.repeat(np.tile(np.arange(len(ours)), 2), sizes)
    label = np.repeat(np.repeat([1, 0], len(ours)), sizes)
    values = torch.from_numpy(np.concatenate(clips))
    fold = np.random.default_rng(SEED).permutation(len(ours)) % FOLDS
    scores = np.zeros(len(values))
    for number in range(FOLDS):
        held_out = fold[dyad] == number
        if held_out.any() and not held_out.all():
            scores[held_out] = _scores(values[~held_out], label[~held_out], values[held_out], SEED + number)
        each()
    return Told(*_interval(scores, label == 1, dyad))


def _interval(scores: Doubles, ours: NDArray[np.bool_], dyad: NDArray[np.intp]) -> tuple[float, float, float]:
    """The area, and the 95 % interval over dyads drawn with replacement."""
    rng = np.random.default_rng(SEED)
    rows = [np.flatnonzero(dyad == number) for number in range(dyad.max() + 1)]
    drawn = []
    for _ in range(RESAMPLED):
        chosen = np.concatenate([rows[number] for number in rng.integers(len(rows), size=len(rows))])
        drawn.append(rank_auc(scores[chosen], ours[chosen], ~ours[chosen]))
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return rank_auc(scores, ours, ~ours), float(low), float(high)


def _scores(values: Tensor, label: NDArray[np.intp], unseen: Tensor, seed: int) -> Doubles:
    """Log-odds (M,) of `unseen` (M, 50, C) by a network trained on values (N, 50, C), label (N,) 1 or 0."""
    mean, deviation = values.mean((0, 1)), values.std((0, 1)).clamp(min=1e-6)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _network(values.shape[-1])
        wanted = torch.from_numpy(label).float()
        # Both kinds weigh the same, however many windows there are of each.
        loss = nn.BCEWithLogitsLoss(pos_weight=(1 - wanted).sum() / wanted.sum().clamp(min=1))
        optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, STEPS)
        for _ in range(STEPS):
            rows = torch.randint(len(values), (BATCH,))
            optimizer.zero_grad()
            loss(network(_channels_first((values[rows] - mean) / deviation))[:, 0], wanted[rows]).backward()
            optimizer.step()
            schedule.step()
        network.eval()
        with torch.no_grad():
            parts = [network(_channels_first((part - mean) / deviation))[:, 0] for part in torch.split(unseen, _CHUNK)]
    return np.asarray(torch.cat(parts).double().numpy(), np.float64)


def _network(channels: int) -> nn.Sequential:
    """Three convolutions over time, the mean and the largest of what they find, one number."""
    return nn.Sequential(
        nn.Conv1d(channels, WIDTH, 5, padding=2), nn.GELU(),
        nn.Conv1d(WIDTH, WIDTH, 5, stride=2, padding=2), nn.GELU(),
        nn.Conv1d(WIDTH, WIDTH, 5, stride=2, padding=2), nn.GELU(),
        _MeanAndMost(), nn.Dropout(0.2), nn.Linear(2 * WIDTH, 1),
    )  # fmt: skip


class _MeanAndMost(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        """(B, W, T) -> (B, 2W)."""
        return torch.cat([x.mean(-1), x.amax(-1)], dim=-1)


def _channels_first(x: Tensor) -> Tensor:
    return x.transpose(1, 2)
