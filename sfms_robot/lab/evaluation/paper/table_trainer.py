"""How a tokenizer of the tables is trained: any recipe as a `Job` of the training loop."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.lab.evaluation.baselines.dense import DenseTokenizer, baseline_loss
from sfms_robot.lab.evaluation.paper.compared_tokenizer import TableModel, save
from sfms_robot.lab.evaluation.paper.score_history import ScoreHistory
from sfms_robot.lab.learning.corpus import first_frames, windows
from sfms_robot.lab.learning.job import Job, LossOf, Run
from sfms_robot.lab.learning.resume import checkpoint_file
from sfms_robot.lab.learning.sfms.tokenizer_trainer import amplified, loss_of_steps, optimizers_of
from sfms_robot.lab.learning.training_loop import fit, optimizer
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.signals.tracks import Take

GAIN: Final = 0.4  # of windows while learning (`amplified`): six minutes of faces are few


def train(
    name: str, recipe: config.Recipe, takes: Sequence[Take], out: Path, run: Run, watched: Tensor | None = None
) -> TableModel:
    """Train one tokenizer and keep it in `out`/`name`, whose checkpoints it goes on from when `run` says so.

    `watched` (W, T, 58): a few windows whose keyframes and errors are written down while it learns.
    """
    folder = out / name
    torch.manual_seed(recipe.seed)
    model = TableModel(recipe)
    model.fit_scales(torch.cat([torch.from_numpy(take.motion) for take in takes]))
    history = ScoreHistory(model, watched) if watched is not None and not run.resume else None
    fit(job(name, model.to(run.device), takes, history), folder, run)
    save(folder, model.cpu().eval())
    checkpoint_file(folder, name).unlink(missing_ok=True)
    if history is not None:
        history.save(folder)
    return model


def job(name: str, model: TableModel, takes: Sequence[Take], history: ScoreHistory | None = None) -> Job:
    """The recipe of `model` as the loop takes it. Nothing is held out: the last weights are the ones compared."""
    recipe = model.recipe
    phase = recipe.training
    motion = torch.cat([torch.from_numpy(take.motion) for take in takes])
    lengths = [len(take.motion) for take in takes]
    loss_of = _loss_of(model, model.standardise(motion.to(model.motion_mean.device)), lengths)

    def noted(step: int, generator: torch.Generator, batch: int) -> Tensor:
        if history is not None:
            history.take(step, phase.steps)
        return loss_of(step, generator, batch)

    return Job(
        name=name,
        model=model,
        optimizers=_optimizers(model.tokenizer, phase),
        loss_of=noted,
        held_out=None,
        frames_per_step=phase.batch * model.window,
        phase=phase,
        seed=recipe.seed,
        identity={
            "recipe": recipe.model_dump(mode="json", exclude={"training"}),
            "training": phase.identity(),
            "data": hashlib.blake2b(motion.numpy().tobytes(), digest_size=8).hexdigest(),
        },
    )


def _optimizers(tokenizer: Tokenizer | DenseTokenizer, phase: config.TokenizerTraining) -> list[torch.optim.Optimizer]:
    if isinstance(tokenizer, Tokenizer):
        return optimizers_of(tokenizer, phase)
    return [optimizer(tokenizer.parameters(), phase.learning_rate, phase.weight_decay)]


def _loss_of(model: TableModel, motion: Tensor, lengths: Sequence[int]) -> LossOf:
    tokenizer, phase = model.tokenizer, model.recipe.training
    if isinstance(tokenizer, Tokenizer):
        return loss_of_steps(tokenizer, motion, lengths, phase, GAIN)
    starts = first_frames(lengths, model.window)

    def everywhere(step: int, generator: torch.Generator, samples: int) -> Tensor:
        chosen = starts[torch.randint(len(starts), (samples,), generator=generator)]
        batch = amplified(windows(motion, chosen, model.window), GAIN, generator)
        return baseline_loss(tokenizer, batch, phase.commitment, generator)

    return everywhere
