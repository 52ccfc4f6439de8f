"""Pictures of the tables: the paper's figures 4, 6, 7 and 8 on our motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from sfms_robot.app.output_paths import INK, RULE, SERIES, new_figure, plain, save
from sfms_robot.lab.evaluate import trajectory_plots
from sfms_robot.lab.evaluation.paper import score_history as history
from sfms_robot.lab.evaluation.paper.compared_tokenizer import TableModel
from sfms_robot.lab.evaluation.paper.restoration import Windows
from sfms_robot.lab.evaluation.paper.tokenizer_tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRAJECTORIES_OF: Final = {"keyframes.png": "sparse-all-k10", "keyframes-one-set.png": "sparse-one-k10"}
HISTORY_OF: Final = "sparse-all-k7"  # figure 7 has k = 7


def draw(folder: Path, tables: Sequence[Table], models: Mapping[str, TableModel], trained: Path, seen: Windows) -> None:
    """Every picture that these tables allow, as PNG files in `folder`. Raises ConfigError, MissingExtra."""
    for file, name in TRAJECTORIES_OF.items():
        if name in models:
            save(trajectory_plots.cases(models[name], seen), folder / file)
    snapshots = history.load(trained / HISTORY_OF) if HISTORY_OF in models else []
    if snapshots:
        save(trajectory_plots.scores_over_steps(snapshots), folder / "scores.png")
    for table in tables:
        if table.name == "4":
            save(_quantiles(table), folder / "quantiles.png")


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
