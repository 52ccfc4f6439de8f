"""Training of the tables' tokenizers, one after another or in several processes, and the history of their scores."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import call
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from pydantic import TypeAdapter
from torch import Tensor

from sfms_robot import config
from sfms_robot.app.output_paths import FAINT, INK, KEY, RULE, SERIES, TRUTH, new_figure, plain, save
from sfms_robot.errors import ModelError
from sfms_robot.frames import CHANNELS, FRAME_S, SHAPES, Doubles
from sfms_robot.lab.evaluation.rollout import run_in_processes
from sfms_robot.lab.evaluation.table_tokenizers import (
    DenseTokenizer,
    SizeName,
    TableModel,
    baseline_loss,
    recipe_of,
    save_tokenizer,
)
from sfms_robot.lab.learning.corpus import first_frames, windows
from sfms_robot.lab.learning.job import Job, Run, Watch, progress_bar
from sfms_robot.lab.learning.sfms.tokenizer_trainer import amplified, loss_of_steps, optimizers_of
from sfms_robot.lab.learning.train_runs import device_of
from sfms_robot.lab.learning.training_loop import checkpoint_file, fit, optimizer
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import ScoreNetwork, place, tracks
from sfms_robot.signals.tracks import Take

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GAIN: Final = 0.4  # gain of windows while learning (`amplified`), since six minutes of faces are few
_WATCHED: Final = (0.02, 0.3, 0.6)  # windows with a history, as shares of all by decreasing motion
_HISTORY: Final = "history.json"
_SNAPSHOTS_AT: Final = (0.0, 0.03, 0.1, 0.3, 1.0)  # shares of the steps


def train_all(
    names: Sequence[str],
    out: Path,
    takes: Sequence[Take],
    examples: Tensor,
    *,
    size: SizeName,
    steps: int | None,
    jobs: int,
    again: bool,
) -> None:
    """Train tokenizers and keep them in `out`. An interrupted one is resumed; with `again` all are trained again.

    `examples` (W, T, 58) are windows; a history is recorded for some of them.
    """
    order = examples[..., SHAPES].var(1).mean(1).argsort(descending=True)
    watched = examples[order[[round(share * (len(order) - 1)) for share in _WATCHED]]]

    def task(name: str, *watches: Watch) -> partial[None]:
        resume = not again and checkpoint_file(out / name, name).is_file()
        run = Run(resume=resume, device=device_of("auto"), watches=watches)
        return partial(train, name, recipe_of(name, size, steps), takes, out, run, watched)

    try:
        if jobs > 1:
            run_in_processes(call, [task(name) for name in names], jobs, "tokenizers trained")
            return
        with progress_bar() as watch:
            for name in names:
                task(name, watch)()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; {out} keeps the trained tokenizers: without --train the command resumes"
        ) from None


def train(
    name: str, recipe: config.Recipe, takes: Sequence[Take], out: Path, run: Run, watched: Tensor | None = None
) -> None:
    """Train one tokenizer and keep it in `out`/`name`, resuming from its checkpoint if `run` says so.

    `watched` (W, T, 58): windows whose keyframes and errors are recorded while it learns.
    """
    folder = out / name
    torch.manual_seed(recipe.seed)
    model = TableModel(recipe)
    motion = torch.cat([torch.from_numpy(take.motion) for take in takes])
    model.fit_scales(motion)
    history = load_history(folder) if run.resume else []
    job = _job(name, model.to(run.device), motion, [len(take.motion) for take in takes])
    if watched is not None:
        due = {min(recipe.training.steps - 1, round(share * recipe.training.steps)) for share in _SNAPSHOTS_AT}
        windows, loss_of = model.standardise(watched.to(run.device)), job.loss_of

        def recorded(step: int, generator: torch.Generator, samples: int) -> Tensor:
            new = step in due and all(step != one.step for one in history)
            if new and (found := snapshots(model.tokenizer, windows, step)):
                history.extend(found)
                folder.mkdir(parents=True, exist_ok=True)
                (folder / _HISTORY).write_bytes(_SNAPSHOTS.dump_json(history))
            return loss_of(step, generator, samples)

        job = replace(job, loss_of=recorded)
    fit(job, folder, run)
    save_tokenizer(folder, model.cpu().eval())
    checkpoint_file(folder, name).unlink(missing_ok=True)


def _job(name: str, model: TableModel, motion: Tensor, lengths: Sequence[int]) -> Job:
    """Return the job of the training loop. It has no held-out data, since the tables compare the last weights."""
    recipe, tokenizer, phase = model.recipe, model.tokenizer, model.recipe.training
    standard, starts = model.standardise(motion.to(model.motion_mean.device)), first_frames(lengths, model.window)
    if isinstance(tokenizer, Tokenizer):
        loss_of, optimizers = loss_of_steps(tokenizer, standard, lengths, phase, _GAIN), optimizers_of(tokenizer, phase)
    else:
        baseline = tokenizer
        optimizers = [optimizer(baseline.parameters(), phase.learning_rate, phase.weight_decay)]

        def loss_of(step: int, generator: torch.Generator, samples: int) -> Tensor:
            chosen = starts[torch.randint(len(starts), (samples,), generator=generator)]
            batch = amplified(windows(standard, chosen, model.window), _GAIN, generator)
            return baseline_loss(baseline, batch, phase.commitment, generator)

    return Job(
        name=name,
        model=model,
        optimizers=optimizers,
        loss_of=loss_of,
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


_SNAPSHOTS: Final = TypeAdapter(list[Snapshot])


@torch.no_grad()
def snapshots(tokenizer: Tokenizer | DenseTokenizer, watched: Tensor, step: int) -> list[Snapshot]:
    """Return the scores before a step for standardised windows (W, T, C), of the group with the most motion in each."""
    if isinstance(tokenizer, DenseTokenizer) or tokenizer.score is None:
        return []
    # Keyframes by the scores alone, without the corrections of `sweeps`.
    mask = place(watched, tokenizer.keyframes, tokenizer.strategy, member=tokenizer.member, score=tokenizer.score)
    score = tokenizer.score
    if isinstance(score, ScoreNetwork):
        scores = torch.log_softmax(score(watched), dim=1)
    else:  # scores of the first choice only
        track = tracks(watched, tokenizer.member, score.curves)
        w, t, _ = watched.shape
        counts = torch.tensor(tokenizer.keyframes, device=watched.device).repeat(w)
        logits = torch.log_softmax(score(track, watched.new_zeros(len(counts), t), counts), dim=1)
        scores = logits.view(w, len(tokenizer.keyframes), t).transpose(1, 2)
    errors = (tokenizer.decode(tokenizer.encode(watched, mask)) - watched).square().mean(-1)
    busy = (watched.var(1) @ tokenizer.member.T / tokenizer.member.sum(1)).argmax(1)
    return [
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


def load_history(folder: Path) -> list[Snapshot]:
    """Read the snapshots of a folder; empty without a file. Raises ModelError."""
    file = folder / _HISTORY
    if not file.is_file():
        return []
    try:
        return _SNAPSHOTS.validate_json(file.read_bytes())
    except ValueError as error:
        raise ModelError(f"{file}: not the history of a tokenizer: {error}") from error


def _rounded(curve: Tensor) -> list[float]:
    return [round(value, 4) for value in curve.tolist()]


# --- Pictures --------------------------------------------------------------------------------------------------------

_TRAJECTORIES_OF: Final = {"keyframes.png": "sparse-all-k10", "keyframes-one-set.png": "sparse-one-k10"}
_HISTORIES_OF: Final = {"scores.png": "sparse-all-k7", "scores-as-written.png": "sparse-all-k7-as-written"}  # figure 7
_CURVES: Final = 4  # trajectories drawn of a window
_BARS: Final = 12  # channels in the bar chart


def draw(
    folder: Path,
    models: Mapping[str, TableModel],
    trained: Path,
    motion: Tensor,
    takes: Sequence[str],
    errors: Mapping[str, Doubles],
) -> None:
    """Write every picture that these tokenizers allow as PNG files in `folder`. Raises ConfigError, MissingExtra.

    Args:
        folder: Where to write.
        models: Tokenizers by name.
        trained: Folder of their histories.
        motion: Windows (W, T, 58) in our units.
        takes: The take of each window.
        errors: (W,) of the rows of table IV, by label; empty without that table.
    """
    for file, name in _TRAJECTORIES_OF.items():
        if name in models:
            save(cases(models[name], motion, takes), folder / file)
    for file, name in _HISTORIES_OF.items():
        if name in models and (history := load_history(trained / name)):
            save(scores_over_steps(history), folder / file)
    if errors:
        save(_quantiles(errors), folder / "quantiles.png")


def _quantiles(errors: Mapping[str, Doubles]) -> Figure:
    """Draw figure 6: the distribution of the error over windows."""
    figure = new_figure(6.4, 4.0)
    axes = figure.subplots()
    share = np.linspace(0, 100, 101)
    for (label, values), color in zip(errors.items(), SERIES, strict=False):
        axes.plot(share, np.percentile(values, share), color=color, linewidth=1.8, label=label)
    axes.axvspan(90, 100, color=RULE, alpha=0.5, linewidth=0)
    axes.set(yscale="log", xlim=(0, 100))
    axes.set_xlabel("% of windows with less error; shaded: the worst tenth", color=INK)
    axes.set_ylabel("MSE, deviations²", color=INK)
    axes.set_title("Error of windows, sorted (unequal bits)", color=INK, fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, labelcolor=INK, loc="upper left")
    plain(axes)
    return figure


def cases(model: TableModel, windows: Tensor, takes: Sequence[str]) -> Figure:
    """Draw figures 4 and 8: the window with the largest error and one with the median error, side by side."""
    motion, tokenizer = model.standardise(windows), model.sparse()
    with torch.inference_mode():
        keyframes, restored = model.mask(motion) > 0.5, model.restore(motion)
    wrong = (restored - motion).square().mean(1).numpy()  # (W, C)
    error = wrong.mean(axis=1)
    order = error.argsort().tolist()
    times_s = np.arange(model.window) * FRAME_S
    figure = new_figure(10.0, 8.4)
    columns = figure.subplots(_CURVES + 1, 2, squeeze=False, height_ratios=[1.5] + [1.0] * _CURVES)
    shown = (("worst", order[-1]), ("normal (median error)", order[len(order) // 2]))
    for (title, at), (bars, *curves) in zip(shown, columns.T, strict=True):
        worst = np.argsort(wrong[at])[::-1][:_BARS]
        bars.bar(range(_BARS), wrong[at, worst], color=SERIES[0], width=0.7)
        bars.set_xticks(range(_BARS), [CHANNELS[channel] for channel in worst], rotation=35, ha="right")
        bars.set_ylabel("MSE", color=INK, fontsize=8)
        plain(bars, 7)
        bars.grid(visible=False, axis="x")
        bars.set_title(f"{title}: {takes[at]}, MSE {error[at]:.3f}", color=INK, fontsize=10, loc="left")
        moving = motion[at].var(0).argsort(descending=True)[:_CURVES].tolist()
        for axes, channel in zip(curves, moving, strict=True):
            keys = keyframes[at, :, int(tokenizer.quantizer.owner[channel])].numpy()
            truth, ours = motion[at, :, channel].numpy(), restored[at, :, channel].numpy()
            axes.plot(times_s, truth, color=TRUTH, linewidth=3.2, label="recorded")
            axes.plot(times_s, ours, color=SERIES[0], linewidth=1.4, label="from its code")
            axes.plot(
                times_s[keys], truth[keys], "o", color=KEY, markersize=4.5, markerfacecolor="none", label="keyframe"
            )
            axes.set_title(CHANNELS[channel], color=INK, fontsize=8, loc="left", pad=2)
            plain(axes, 7)
        curves[-1].set_xlabel("s", color=INK, fontsize=8)
    columns[1, 0].legend(frameon=False, fontsize=7, labelcolor=INK)
    count = len(tokenizer.keyframes)
    figure.suptitle(
        f"{count} keyframe set{'s' if count > 1 else ''}, {tokenizer.keyframes[0]} keyframes in "
        f"{model.window} frames each; deviations of the training motion",
        color=INK, fontsize=10,
    )  # fmt: skip
    return figure


def scores_over_steps(snapshots: Sequence[Snapshot]) -> Figure:
    """Draw figure 7: scores and errors of a few windows while the tokenizer learns, one window a column."""
    windows = sorted({snapshot.window for snapshot in snapshots})
    steps = sorted({snapshot.step for snapshot in snapshots})
    figure = new_figure(3.6 * len(windows), 1.35 * len(steps) + 0.9)
    grid = figure.subplots(len(steps), len(windows), squeeze=False, sharex=True)
    for snapshot in snapshots:
        axes = grid[steps.index(snapshot.step), windows.index(snapshot.window)]
        _snapshot(axes, snapshot)
        if snapshot.step == steps[0]:
            axes.set_title(
                f"window {snapshot.window + 1}: {CHANNELS[snapshot.group]}", color=INK, fontsize=9, loc="left"
            )
        if snapshot.window == windows[0]:
            axes.set_ylabel(f"step {snapshot.step}", color=INK, fontsize=8)
        if snapshot.step == steps[-1]:
            axes.set_xlabel("frame", color=INK, fontsize=8)
    figure.suptitle(
        "Log-probability of each frame as the first keyframe (line), keyframes (circles), error (area)",
        color=INK, fontsize=9,
    )  # fmt: skip
    return figure


def _snapshot(axes: Axes, snapshot: Snapshot) -> None:
    scores = np.array(snapshot.scores)
    axes.plot(scores, color=SERIES[0], linewidth=1.3)
    axes.plot(snapshot.keyframes, scores[snapshot.keyframes], "o", color=KEY, markersize=4, markerfacecolor="none")
    beside = axes.twinx()
    beside.fill_between(range(len(snapshot.errors)), snapshot.errors, color=SERIES[1], alpha=0.35, linewidth=0)
    beside.set_ylim(bottom=0)
    plain(axes, 7)
    beside.tick_params(labelsize=6, colors=FAINT, length=2)
    for side in ("top", "left", "bottom"):
        beside.spines[side].set_visible(False)
    beside.spines["right"].set_color(RULE)
