"""Pictures of the tables: the paper's figures 4, 6, 7 and 8 on our motion, and the two curves it does not have."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sfms_robot.app.evaluate import trajectory_plots
from sfms_robot.app.evaluate.plot_style import FAINT, INK, KINDS, RULE, SERIES, new_figure, plain, save
from sfms_robot.evaluation.paper import history
from sfms_robot.evaluation.paper.bits import GOAL_FROM_BITS
from sfms_robot.evaluation.paper.model import TableModel
from sfms_robot.evaluation.paper.rows import Row
from sfms_robot.evaluation.paper.score import Windows
from sfms_robot.evaluation.paper.tables import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRAJECTORIES_OF: Final = {"keyframes.png": "sparse-all-k10", "keyframes-one-set.png": "sparse-one-k10"}
HISTORY_OF: Final = "sparse-all-k7"  # figure 7 has k = 7


def draw(folder: Path, tables: Sequence[Table], models: Mapping[str, TableModel], trained: Path, seen: Windows) -> None:
    """Every picture that these tables allow, as PNG files in `folder`. Raises ConfigError, MissingExtra."""
    for file, name in TRAJECTORIES_OF.items():
        if name in models:
            save(trajectory_plots.cases(models[name], seen), folder / file)
    looks = history.load(trained / HISTORY_OF) if HISTORY_OF in models else []
    if looks:
        save(trajectory_plots.scores_over_steps(looks), folder / "scores.png")
    by_name: dict[str, Callable[[Table], Figure]] = {"4": _quantiles, "bits": _error_bits, "adaptive": _adaptive}
    files = {"4": "quantiles.png", "bits": "bits.png", "adaptive": "adaptive.png"}
    for table in tables:
        if table.name in by_name:
            save(by_name[table.name](table), folder / files[table.name])


def _quantiles(table: Table) -> Figure:
    """Figure 6: how the error is spread over windows."""
    figure = new_figure(6.4, 4.0)
    axes = figure.subplots()
    share = np.linspace(0, 100, 101)
    for row, color in zip(table.rows, SERIES, strict=False):
        line = np.percentile(row.score.of_windows, share)
        axes.plot(share, line, color=color, linewidth=1.8, label=f"{row.spec.name}, {row.bits:,.0f} bits")
    axes.axvspan(90, 100, color=RULE, alpha=0.5, linewidth=0)
    axes.set_yscale("log")
    axes.set_xlim(0, 100)
    axes.set_xlabel("% of windows with less error; shaded: the worst tenth", color=INK)
    axes.set_ylabel("MSE, deviations²", color=INK)
    axes.set_title("Error of windows, sorted (unequal bits)", color=INK, fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, labelcolor=INK, loc="upper left")
    plain(axes)
    return figure


def _error_bits(table: Table) -> Figure:
    """Least error that a number of bits buys, by family: points, and steps along the least of them."""
    figure = new_figure(7.2, 4.4)
    axes = figure.subplots()
    for family, (color, label) in KINDS.items():
        rows = [row for row in table.rows if row.spec.note == family]
        bits, errors = np.array([row.bits for row in rows]), np.array([row.score.mse for row in rows])
        axes.plot(bits, errors, "o", color=color, markersize=4, alpha=0.6, markeredgewidth=0)
        axes.step(bits, np.minimum.accumulate(errors), where="post", color=color, linewidth=1.6, label=label)
        for row, least in zip(rows, np.minimum.accumulate(errors), strict=True):
            if family == "sparse" and row.score.mse == least:
                _name(axes, row)
    axes.axvline(GOAL_FROM_BITS, color=FAINT, linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("bits a window of 48 frames, places of keyframes included", color=INK)
    axes.set_ylabel("MSE, deviations²", color=INK)
    axes.set_title("Error at equal bits, held-out takes", color=INK, fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, labelcolor=INK)
    plain(axes)
    return figure


def _name(axes: Axes, row: Row) -> None:
    short = row.spec.name.removeprefix("bits-").removeprefix("sparse-")
    axes.annotate(
        short, (row.bits, row.score.mse), xytext=(4, 4), textcoords="offset points", fontsize=6.5, color=FAINT
    )


def _adaptive(table: Table) -> Figure:
    """Rate and distortion: nested prefixes of one tokenizer, tolerances, and the tokenizers of one k each."""
    figure = new_figure(6.4, 4.2)
    axes = figure.subplots()
    curve: Sequence[Mapping[str, Any]] = table.figures["curve"]
    fixed = [point for point in curve if point["tolerance"] is None]
    chosen = [point for point in curve if point["tolerance"] is not None]
    axes.plot(*_points(fixed), "-", color=SERIES[0], linewidth=1.8, label="one tokenizer, nested: the first k of 12")
    axes.plot(
        *_points(chosen), "D", color=SERIES[1], markersize=6, label="the same, k by tolerance, channel by channel"
    )
    for point in chosen:
        axes.annotate(f"{point['tolerance']:g}", (point["bits"], point["mse"]), xytext=(6, 4),
                      textcoords="offset points", fontsize=7, color=SERIES[1])  # fmt: skip
    for name, color, mark in (("fixed k", SERIES[3], "o"), ("k drawn, told k", SERIES[2], "s")):
        rows = [row for row in table.rows if row.spec.name == name]
        label = "a tokenizer for each k" if name == "fixed k" else "one tokenizer, told k"
        axes.plot([r.bits for r in rows], [r.score.mse for r in rows], mark, color=color, markersize=6, label=label)
    axes.set_yscale("log")
    axes.set_xlabel("bits a window of 48 frames", color=INK)
    axes.set_ylabel("MSE, deviations²", color=INK)
    axes.set_title("As few keyframes as a window needs", color=INK, fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, labelcolor=INK)
    plain(axes)
    return figure


def _points(points: Sequence[Mapping[str, Any]]) -> tuple[list[float], list[float]]:
    return [point["bits"] for point in points], [point["mse"] for point in points]
