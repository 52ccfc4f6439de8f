"""One picture of a head: the range of every joint, what recorded faces use of it, and how fast they ask it to be."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from sfms_robot.app.head.head_check import HeadCheck
from sfms_robot.app.plot_style import INK, new_figure, plain, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_RANGE, _USED, _SPEED, _JERK, _OVER = "#dfe6ea", "#1f6f9c", "#5b8c5a", "#c29a2e", "#c8553d"
_WIDTH_IN: Final = 9.0
_ROW_IN: Final = 0.22
_DPI: Final = 80


def plot(checked: HeadCheck, png: Path) -> None:
    """Draw the check of a sound head. Raises ConfigError where the file cannot be written, MissingExtra without
    matplotlib."""
    figure = new_figure(_WIDTH_IN, 1.3 + _ROW_IN * max(len(checked.joints), 4), _DPI)
    ranges, demand = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    _ranges(ranges, checked)
    _demand(demand, checked)
    figure.suptitle(f"{checked.name} on {checked.seconds:.0f} s of recorded faces", color=INK, fontsize=11)
    save(figure, png)


def _ranges(axes: Axes, checked: HeadCheck) -> None:
    for row, joint in enumerate(checked.joints):
        axes.barh(row, joint.max_deg - joint.min_deg, left=joint.min_deg, height=0.7, color=_RANGE)
        axes.barh(row, joint.high_deg - joint.low_deg, left=joint.low_deg, height=0.35, color=_USED)
        axes.plot([joint.rest_deg] * 2, [row - 0.35, row + 0.35], color=INK, linewidth=1)
    axes.set_yticks(range(len(checked.joints)), [joint.joint for joint in checked.joints])
    axes.invert_yaxis()
    axes.set_xlabel("deg: range, used, and rest", color=INK)
    plain(axes, grid="x")


def _demand(axes: Axes, checked: HeadCheck) -> None:
    for row, joint in enumerate(checked.joints):
        for offset, share, color in ((-0.18, joint.speed, _SPEED), (0.18, joint.jerk, _JERK)):
            axes.barh(row + offset, 100 * share, height=0.32, color=color if share <= 1 else _OVER)
    axes.axvline(100, color=INK, linewidth=1)
    axes.set_xlabel("% of the limit: speed (upper), jerk (lower)", color=INK)
    plain(axes, grid="x")
