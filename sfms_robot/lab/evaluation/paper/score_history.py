"""What a tokenizer thought of a few windows while it learned: figure 7 of the paper."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from sfms_robot.errors import ModelError
from sfms_robot.lab.evaluation.baselines.dense import DenseTokenizer
from sfms_robot.lab.evaluation.paper.compared_tokenizer import TableModel
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import ConditionalScore, ScoreNetwork, place, tracks

FILE: Final = "history.json"
SNAPSHOTS_AT: Final = (0.0, 0.03, 0.1, 0.3, 1.0)  # shares of the steps


@dataclass(frozen=True)
class Snapshot:
    """One window at one step, seen through one channel group.

    Attributes:
        scores: (T,) log-probability of each frame as the first keyframe.
        keyframes: frames chosen.
        errors: (T,) squared error over all channels, standardised.
    """

    step: int
    window: int
    group: int
    scores: list[float]
    keyframes: list[int]
    errors: list[float]


class ScoreHistory:
    """Writes down what the model does with some windows (W, T, C) in our units, one busy group of each."""

    def __init__(self, model: TableModel, watched: Tensor) -> None:
        self.model = model
        self.watched = watched
        self.snapshots: list[Snapshot] = []

    @torch.no_grad()
    def take(self, step: int, steps: int) -> None:
        """Take snapshots before this step, when one of `SNAPSHOTS_AT` has come."""
        tokenizer = self.model.tokenizer
        device = self.model.motion_mean.device
        watched = self.model.standardise(self.watched.to(device))
        due = {min(steps - 1, round(share * steps)) for share in SNAPSHOTS_AT}
        if step not in due or isinstance(tokenizer, DenseTokenizer) or tokenizer.score is None:
            return
        scores, mask = _scores(tokenizer, watched), _mask(tokenizer, watched)
        restored = tokenizer.decode(tokenizer.encode(watched, mask))
        errors = (restored - watched).square().mean(-1)
        busy = (watched.var(1) @ tokenizer.member.T / tokenizer.member.sum(1)).argmax(1)
        for window, group in enumerate(busy.tolist()):
            chosen = mask[window, :, group].nonzero()[:, 0].tolist()
            curve = scores[window, :, group].tolist()
            self.snapshots.append(Snapshot(step, window, group, curve, chosen, errors[window].tolist()))

    def save(self, folder: Path) -> None:
        """Write `folder`/history.json, where there is something to tell."""
        if self.snapshots:
            rounded = [{k: _rounded(v) for k, v in asdict(snapshot).items()} for snapshot in self.snapshots]
            (folder / FILE).write_text(json.dumps(rounded), encoding="utf-8")


def load(folder: Path) -> list[Snapshot]:
    """The snapshots of a folder; none where none were taken. Raises ModelError."""
    file = folder / FILE
    if not file.is_file():
        return []
    try:
        return [Snapshot(**snapshot) for snapshot in json.loads(file.read_text(encoding="utf-8"))]
    except (ValueError, TypeError) as error:
        raise ModelError(f"{file}: not the history of a tokenizer: {error}") from error


def _mask(tokenizer: Tokenizer, motion: Tensor) -> Tensor:
    """Keyframes (W, T, G) by the scores alone, without second thoughts (`sweeps`)."""
    return place(motion, tokenizer.keyframes, tokenizer.strategy, member=tokenizer.member, score=tokenizer.score)


def _scores(tokenizer: Tokenizer, motion: Tensor) -> Tensor:
    """Log-probabilities (W, T, G) of the first choice."""
    score = tokenizer.score
    if isinstance(score, ScoreNetwork):
        return torch.log_softmax(score(motion), dim=1)
    if not isinstance(score, ConditionalScore):
        raise TypeError("this tokenizer has no scores")
    track = tracks(motion, tokenizer.member, score.curves)
    w, t, _ = motion.shape
    counts = torch.tensor(tokenizer.keyframes).repeat(w)
    logits = torch.log_softmax(score(track, motion.new_zeros(len(counts), t), counts), dim=1)
    return logits.view(w, len(tokenizer.keyframes), t).transpose(1, 2)


def _rounded(value: object) -> object:
    return [round(v, 4) if isinstance(v, float) else v for v in value] if isinstance(value, list) else value
