"""Pictures of the tables: figures 4, 6, 7 and 8 of the SFMS paper on our motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from torch import Tensor

from sfms_robot.app.output_paths import FAINT, INK, KEY, RULE, SERIES, TRUTH, new_figure, plain, save
from sfms_robot.frames import CHANNELS, FRAME_S, Doubles, Floats
from sfms_robot.lab.evaluation.table_tokenizers import TableModel
from sfms_robot.lab.evaluation.table_training import Snapshot, load_history

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TRAJECTORIES_OF: Final = {"keyframes.png": "sparse-all-k10", "keyframes-one-set.png": "sparse-one-k10"}
_HISTORY_OF: Final = "sparse-all-k7"  # figure 7 has k = 7
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
    snapshots = load_history(trained / _HISTORY_OF) if _HISTORY_OF in models else []
    if snapshots:
        save(scores_over_steps(snapshots), folder / "scores.png")
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
    axes.set_yscale("log")
    axes.set_xlim(0, 100)
    axes.set_xlabel("% of windows with less error; shaded: the worst tenth", color=INK)
    axes.set_ylabel("MSE, deviations²", color=INK)
    axes.set_title("Error of windows, sorted (unequal bits)", color=INK, fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, labelcolor=INK, loc="upper left")
    plain(axes)
    return figure


def cases(model: TableModel, windows: Tensor, takes: Sequence[str]) -> Figure:
    """Draw figures 4 and 8: the window with the largest error and one with the median error, side by side."""
    motion = model.standardise(windows)
    with torch.inference_mode():
        mask = model.mask(motion)
        restored = model.restore(motion)
    error = (restored - motion).square().mean((1, 2))
    order = error.argsort()
    shown = {"worst": int(order[-1]), "normal (median error)": int(order[len(order) // 2])}
    owner = model.sparse().quantizer.owner
    figure = new_figure(10.0, 8.4)
    columns = figure.subplots(_CURVES + 1, len(shown), squeeze=False, height_ratios=[1.5] + [1.0] * _CURVES)
    for column, (title, at) in enumerate(shown.items()):
        wrong = (restored[at] - motion[at]).square().mean(0).numpy()
        _bars(columns[0, column], wrong)
        columns[0, column].set_title(
            f"{title}: {takes[at]}, MSE {float(error[at]):.3f}", color=INK, fontsize=10, loc="left"
        )
        moving = motion[at].var(0).argsort(descending=True)[:_CURVES]
        for row, channel in enumerate(moving.tolist(), start=1):
            keys = mask[at, :, int(owner[channel])].numpy() > 0.5
            truth, ours = motion[at, :, channel].numpy(), restored[at, :, channel].numpy()
            _trajectory(columns[row, column], CHANNELS[channel], truth, ours, keys)
        columns[_CURVES, column].set_xlabel("s", color=INK, fontsize=8)
    columns[1, 0].legend(frameon=False, fontsize=7, labelcolor=INK)
    kind = model.recipe.model
    count = len(model.sparse().keyframes)
    figure.suptitle(
        f"{count} keyframe set{'s' if count > 1 else ''}, {model.sparse().keyframes[0]} keyframes in "
        f"{kind.window_frames} frames each; deviations of the training motion",
        color=INK, fontsize=10,
    )  # fmt: skip
    return figure


def _bars(axes: Axes, wrong: Floats) -> None:
    worst = np.argsort(wrong)[::-1][:_BARS]
    axes.bar(range(_BARS), wrong[worst], color=SERIES[0], width=0.7)
    axes.set_xticks(range(_BARS), [CHANNELS[channel] for channel in worst], rotation=35, ha="right")
    axes.set_ylabel("MSE", color=INK, fontsize=8)
    plain(axes, 7)
    axes.grid(visible=False, axis="x")


def _trajectory(
    axes: Axes, name: str, truth: Floats, ours: Floats, keys: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> None:
    times_s = np.arange(len(truth)) * FRAME_S
    axes.plot(times_s, truth, color=TRUTH, linewidth=3.2, label="recorded")
    axes.plot(times_s, ours, color=SERIES[0], linewidth=1.4, label="from its code")
    axes.plot(times_s[keys], truth[keys], "o", color=KEY, markersize=4.5, markerfacecolor="none", label="keyframe")
    axes.set_title(name, color=INK, fontsize=8, loc="left", pad=2)
    plain(axes, 7)


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
