"""Keyframes on trajectories: the worst and a normal window (figures 4, 8), and scores while they are learned (7)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import torch

from sfms_robot.app.output_paths import FAINT, INK, KEY, RULE, SERIES, TRUTH, new_figure, plain
from sfms_robot.frames import CHANNELS, FRAME_S, Floats
from sfms_robot.lab.evaluation.paper.compared_tokenizer import TableModel
from sfms_robot.lab.evaluation.paper.restoration import Windows
from sfms_robot.lab.evaluation.paper.score_history import Snapshot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVES: Final = 4  # trajectories drawn of a window
BARS: Final = 12  # channels in the bar chart


def cases(model: TableModel, seen: Windows) -> Figure:
    """Two windows side by side: where the tokenizer does worst, and where it does as usual."""
    motion = model.standardise(seen.motion)
    with torch.inference_mode():
        mask = model.mask(motion)
        restored = model.restore(motion)
    error = (restored - motion).square().mean((1, 2))
    order = error.argsort()
    shown = {"worst": int(order[-1]), "normal (median error)": int(order[len(order) // 2])}
    owner = model.sparse().quantizer.owner
    figure = new_figure(10.0, 8.4)
    columns = figure.subplots(CURVES + 1, len(shown), squeeze=False, height_ratios=[1.5] + [1.0] * CURVES)
    for column, (title, at) in enumerate(shown.items()):
        wrong = (restored[at] - motion[at]).square().mean(0).numpy()
        _bars(columns[0, column], wrong)
        columns[0, column].set_title(
            f"{title}: {seen.takes[at]}, MSE {float(error[at]):.3f}", color=INK, fontsize=10, loc="left"
        )
        moving = motion[at].var(0).argsort(descending=True)[:CURVES]
        for row, channel in enumerate(moving.tolist(), start=1):
            keys = mask[at, :, int(owner[channel])].numpy() > 0.5
            truth, ours = motion[at, :, channel].numpy(), restored[at, :, channel].numpy()
            _trajectory(columns[row, column], CHANNELS[channel], truth, ours, keys)
        columns[CURVES, column].set_xlabel("s", color=INK, fontsize=8)
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
    worst = np.argsort(wrong)[::-1][:BARS]
    axes.bar(range(BARS), wrong[worst], color=SERIES[0], width=0.7)
    axes.set_xticks(range(BARS), [CHANNELS[channel] for channel in worst], rotation=35, ha="right")
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
    """How the scores and the error of a few windows develop while the tokenizer learns, one window a column."""
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
