"""How a tokenizer of the tables is trained: any recipe as a `Job` of the training loop."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.corpora.takes import Take
from sfms_robot.evaluation.baselines.dense import DenseTokenizer, baseline_loss
from sfms_robot.evaluation.paper.history import Diary
from sfms_robot.evaluation.paper.model import TableModel, save
from sfms_robot.learning.job import Job, Run
from sfms_robot.learning.loop import fit, optimizer
from sfms_robot.learning.resume import checkpoint_file
from sfms_robot.learning.sfms.corpus import windows
from sfms_robot.learning.sfms.keyframe_scores import imitation, lively
from sfms_robot.learning.sfms.masks import bank
from sfms_robot.learning.sfms.tokenizer import learned_loss, tokenizer_loss
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.score import ConditionalScore, ScoreNetwork

GAIN: Final = 0.4  # deviation of the logarithm of a window's gain

LossOf = Callable[[int, torch.Generator], Tensor]


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
    diary = Diary(model, watched) if watched is not None and not run.resume else None
    fit(job(name, model.to(run.device), takes, diary), folder, run)
    save(folder, model.cpu().eval())
    checkpoint_file(folder, name).unlink(missing_ok=True)
    if diary is not None:
        diary.save(folder)
    return model


def job(name: str, model: TableModel, takes: Sequence[Take], diary: Diary | None = None) -> Job:
    """The recipe of `model` as the loop takes it. Nothing is held out: the last weights are the ones compared."""
    recipe = model.recipe
    phase = recipe.training
    motion = torch.cat([torch.from_numpy(take.motion) for take in takes])
    starts = first_frames([len(take.motion) for take in takes], model.window)
    loss_of = _loss_of(model, model.standardise(motion.to(model.motion_mean.device)), starts)

    def noted(step: int, generator: torch.Generator) -> Tensor:
        if diary is not None:
            diary.look(step, phase.steps)
        return loss_of(step, generator)

    return Job(
        name=name,
        model=model,
        optimizers=_optimizers(model, phase),
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


def first_frames(lengths: Sequence[int], window: int, hop: int = 1) -> Tensor:
    """First frames of the windows that lie in one take, takes one after another."""
    firsts, at = [torch.empty(0, dtype=torch.int64)], 0
    for length in lengths:
        firsts.append(torch.arange(at, max(at, at + length - window + 1), hop))
        at += length
    return torch.cat(firsts)


def amplified(batch: Tensor, generator: torch.Generator) -> Tensor:
    """Windows (B, T, C) that move more or less than they did, all channels alike.

    Six minutes of a few faces do not hold what the next face does at its widest. The best masks stay the best.
    """
    gain = torch.exp(GAIN * torch.randn(len(batch), 1, 1, generator=generator))
    return batch * gain.to(batch.device)


def _optimizers(model: TableModel, phase: config.TokenizerTraining) -> list[torch.optim.Optimizer]:
    tokenizer = model.tokenizer
    score = None if isinstance(tokenizer, DenseTokenizer) else tokenizer.score
    scores = [] if score is None else list(score.parameters())
    known = {id(p) for p in scores}
    rest = [p for p in tokenizer.parameters() if id(p) not in known]
    made = [optimizer(rest, phase.learning_rate, phase.weight_decay)]
    return [*made, optimizer(scores, phase.score_learning_rate, phase.weight_decay)] if scores else made


def _loss_of(model: TableModel, motion: Tensor, starts: Tensor) -> LossOf:
    tokenizer, phase = model.tokenizer, model.recipe.training
    if isinstance(tokenizer, Tokenizer) and not isinstance(tokenizer.score, ScoreNetwork):
        return _placed(tokenizer, motion, starts, phase)

    def anywhere(step: int, generator: torch.Generator) -> Tensor:
        chosen = starts[torch.randint(len(starts), (phase.batch,), generator=generator)]
        batch = amplified(windows(motion, chosen, model.window), generator)
        if isinstance(tokenizer, DenseTokenizer):
            return baseline_loss(tokenizer, batch, phase.commitment, generator)
        hot, cold = phase.temperature
        temperature = hot * (cold / hot) ** (step / max(1, phase.steps - 1))
        return learned_loss(tokenizer, batch, temperature, phase, generator)

    return anywhere


def _placed(tokenizer: Tokenizer, motion: Tensor, starts: Tensor, phase: config.TokenizerTraining) -> LossOf:
    """Codes and inpainter on masks placed beforehand; conditional scores learn them meanwhile."""
    some = starts[:: max(1, len(starts) // (phase.steps * phase.batch))]  # no more than are ever drawn
    masks = bank(tokenizer, motion, some, phase.keyframes_drawn)
    most = max(*tokenizer.keyframes, *(phase.keyframes_drawn or (0,)))
    score = tokenizer.score

    def beside(step: int, generator: torch.Generator) -> Tensor:
        chosen, mask = masks.draw(phase.batch, generator)
        batch = amplified(windows(motion, chosen, tokenizer.window), generator)
        loss = tokenizer_loss(tokenizer, batch, mask, phase, generator)[0]
        if not isinstance(score, ConditionalScore):
            return loss
        some = lively(batch, tokenizer.member, score.curves, phase.score_tracks, generator)
        return loss + imitation(score, some, most, phase.untold, generator)

    return beside
