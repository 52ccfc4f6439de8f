"""Training of the tables' tokenizers, one after another or in several processes, and the history of their scores."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.errors import ModelError
from sfms_robot.lab.evaluation.listener_evaluation import bar
from sfms_robot.lab.evaluation.table_tokenizers import (
    DenseTokenizer,
    SizeName,
    TableModel,
    baseline_loss,
    recipes,
    save,
)
from sfms_robot.lab.learning.corpus import first_frames, windows
from sfms_robot.lab.learning.job import Job, LossOf, Run, Watch, progress_bar
from sfms_robot.lab.learning.resume import checkpoint_file
from sfms_robot.lab.learning.sfms.tokenizer_trainer import amplified, loss_of_steps, optimizers_of
from sfms_robot.lab.learning.train_runs import device_of
from sfms_robot.lab.learning.training_loop import fit, optimizer
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import ConditionalScore, ScoreNetwork, place, tracks
from sfms_robot.processes import process_pool
from sfms_robot.signals.tracks import Take

_GAIN: Final = 0.4  # of windows while learning (`amplified`): six minutes of faces are few
_WATCHED: Final = (0.02, 0.3, 0.6)  # windows with a history, as shares of all by decreasing motion
_HISTORY: Final = "history.json"
_SNAPSHOTS_AT: Final = (0.0, 0.03, 0.1, 0.3, 1.0)  # shares of the steps


@dataclass(frozen=True, kw_only=True)
class _TrainingTask:
    """One tokenizer to train, sent to another process."""

    name: str
    recipe: config.Recipe
    takes: Sequence[Take]
    out: Path
    device: str
    resume: bool
    watched: Tensor


def train_all(
    names: Sequence[str],
    out: Path,
    takes: Sequence[Take],
    examples: Tensor,
    *,
    size: SizeName,
    steps: int | None,
    jobs: int,
    device: str,
    anew: bool,
) -> None:
    """Train tokenizers and keep them in `out`, resuming interrupted ones or train all again with `anew`.

    `examples` (W, T, 58) are windows of which some get a history.
    """
    known = recipes(size, steps)
    order = examples[..., 6:].var(1).mean(1).argsort(descending=True)
    watched = examples[order[[round(share * (len(order) - 1)) for share in _WATCHED]]]
    tasks = [
        _TrainingTask(
            name=name,
            recipe=known[name],
            takes=takes,
            out=out,
            device=device,
            resume=not anew and checkpoint_file(out / name, name).is_file(),
            watched=watched,
        )
        for name in names
    ]
    try:
        if jobs == 1:
            with progress_bar() as watch:
                for task in tasks:
                    _train(task, watch)
        else:
            with bar(f"training {len(tasks)} tokenizers", len(tasks)) as advance, process_pool(jobs) as pool:
                for done in as_completed([pool.submit(_train, task, _unwatched) for task in tasks]):
                    done.result()
                    advance()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; {out} keeps the trained tokenizers: without --train the command resumes"
        ) from None


def _unwatched(report: object) -> None:
    """Ignore a report of progress: several trainings share one bar."""


def _train(task: _TrainingTask, watch: Watch) -> None:
    run = Run(resume=task.resume, device=device_of(task.device), watch=watch)
    train(task.name, task.recipe, task.takes, task.out, run, task.watched)


def train(
    name: str, recipe: config.Recipe, takes: Sequence[Take], out: Path, run: Run, watched: Tensor | None = None
) -> TableModel:
    """Train one tokenizer and keep it in `out`/`name`, resuming from its checkpoints if `run` says so.

    `watched` (W, T, 58): windows whose keyframes and errors are recorded while it learns.
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
    """Return the job of the training loop. It holds nothing out: the tables compare the last weights."""
    recipe = model.recipe
    phase = recipe.training
    motion = torch.cat([torch.from_numpy(take.motion) for take in takes])
    lengths = [len(take.motion) for take in takes]
    loss_of = _loss_of(model, model.standardise(motion.to(model.motion_mean.device)), lengths)

    def noted(step: int, generator: torch.Generator, batch: int) -> Tensor:
        if history is not None:
            history.take(step, phase.steps)
        return loss_of(step, generator, batch)

    tokenizer = model.tokenizer
    return Job(
        name=name,
        model=model,
        optimizers=optimizers_of(tokenizer, phase)
        if isinstance(tokenizer, Tokenizer)
        else [optimizer(tokenizer.parameters(), phase.learning_rate, phase.weight_decay)],
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


def _loss_of(model: TableModel, motion: Tensor, lengths: Sequence[int]) -> LossOf:
    tokenizer, phase = model.tokenizer, model.recipe.training
    if isinstance(tokenizer, Tokenizer):
        return loss_of_steps(tokenizer, motion, lengths, phase, _GAIN)
    starts = first_frames(lengths, model.window)

    def everywhere(step: int, generator: torch.Generator, samples: int) -> Tensor:
        chosen = starts[torch.randint(len(starts), (samples,), generator=generator)]
        batch = amplified(windows(motion, chosen, model.window), _GAIN, generator)
        return baseline_loss(tokenizer, batch, phase.commitment, generator)

    return everywhere


# --- history: figure 7 of the paper ---------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """One window at one step, of one channel group.

    Attributes:
        scores: (T,) log-probability of each frame as the first keyframe.
        keyframes: The chosen frames.
        errors: (T,) squared error over all channels, standardised.
    """

    step: int
    window: int
    group: int
    scores: list[float]
    keyframes: list[int]
    errors: list[float]


class ScoreHistory:
    """Recorder of a model's scores for some windows (W, T, C) in our units, one busy group of each."""

    def __init__(self, model: TableModel, watched: Tensor) -> None:
        self.model = model
        self.watched = watched
        self.snapshots: list[Snapshot] = []

    @torch.no_grad()
    def take(self, step: int, steps: int) -> None:
        """Take snapshots before this step if it is one of `_SNAPSHOTS_AT`."""
        tokenizer = self.model.tokenizer
        watched = self.model.standardise(self.watched.to(self.model.motion_mean.device))
        due = {min(steps - 1, round(share * steps)) for share in _SNAPSHOTS_AT}
        if step not in due or isinstance(tokenizer, DenseTokenizer) or tokenizer.score is None:
            return
        # Keyframes by the scores alone, without the corrections of `sweeps`.
        mask = place(watched, tokenizer.keyframes, tokenizer.strategy, member=tokenizer.member, score=tokenizer.score)
        scores = _first_choice(tokenizer, watched)
        errors = (tokenizer.decode(tokenizer.encode(watched, mask)) - watched).square().mean(-1)
        busy = (watched.var(1) @ tokenizer.member.T / tokenizer.member.sum(1)).argmax(1)
        self.snapshots += [
            Snapshot(
                step=step,
                window=window,
                group=group,
                scores=_rounded(scores[window, :, group]),
                keyframes=mask[window, :, group].nonzero()[:, 0].tolist(),
                errors=_rounded(errors[window]),
            )
            for window, group in enumerate(busy.tolist())
        ]

    def save(self, folder: Path) -> None:
        """Write `folder`/history.json if there are snapshots."""
        if self.snapshots:
            plain = [asdict(snapshot) for snapshot in self.snapshots]
            (folder / _HISTORY).write_text(json.dumps(plain), encoding="utf-8")


def load_history(folder: Path) -> list[Snapshot]:
    """Read the snapshots of a folder; empty without a file. Raises ModelError."""
    file = folder / _HISTORY
    if not file.is_file():
        return []
    try:
        return [Snapshot(**snapshot) for snapshot in json.loads(file.read_text(encoding="utf-8"))]
    except (ValueError, TypeError) as error:
        raise ModelError(f"{file}: not the history of a tokenizer: {error}") from error


def _first_choice(tokenizer: Tokenizer, motion: Tensor) -> Tensor:
    """Return the log-probabilities (W, T, G) of the first choice."""
    score = tokenizer.score
    if isinstance(score, ScoreNetwork):
        return torch.log_softmax(score(motion), dim=1)
    assert isinstance(score, ConditionalScore)
    track = tracks(motion, tokenizer.member, score.curves)
    w, t, _ = motion.shape
    counts = torch.tensor(tokenizer.keyframes).repeat(w)
    logits = torch.log_softmax(score(track, motion.new_zeros(len(counts), t), counts), dim=1)
    return logits.view(w, len(tokenizer.keyframes), t).transpose(1, 2)


def _rounded(curve: Tensor) -> list[float]:
    return [round(value, 4) for value in curve.tolist()]
