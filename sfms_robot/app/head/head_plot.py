"""One picture of a head: the range of every joint, what recorded faces use of it, and how fast they ask it to be."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from sfms_robot.app.head.head_check import HeadCheck
from sfms_robot.errors import ConfigError, MissingExtra

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INK, _FAINT, _RANGE, _USED, _SPEED, _JERK, _OVER = (
    "#2a2d34", "#7d828c", "#dfe6ea", "#1f6f9c", "#5b8c5a", "#c29a2e", "#c8553d",
)  # fmt: skip
_WIDTH_IN: Final = 9.0
_ROW_IN: Final = 0.22
_DPI: Final = 80


def plot(checked: HeadCheck, png: Path) -> None:
    """Draw the check of a sound head. Raises ConfigError where the file cannot be written, MissingExtra without
    matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra.of("a plot", "pictures") from error
    rows = len(checked.joints)
    figure = Figure(figsize=(_WIDTH_IN, 1.3 + _ROW_IN * max(rows, 4)), dpi=_DPI, layout="constrained")
    ranges, demand = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    _ranges(ranges, checked)
    _demand(demand, checked)
    figure.suptitle(f"{checked.name} on {checked.seconds:.0f} s of recorded faces", color=_INK, fontsize=11)
    try:
        figure.savefig(png)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--plot {str(png)!r} cannot be written: {error}") from error


def _ranges(axes: Axes, checked: HeadCheck) -> None:
    for row, joint in enumerate(checked.joints):
        axes.barh(row, joint.max_deg - joint.min_deg, left=joint.min_deg, height=0.7, color=_RANGE)
        axes.barh(row, joint.high_deg - joint.low_deg, left=joint.low_deg, height=0.35, color=_USED)
        axes.plot([joint.rest_deg] * 2, [row - 0.35, row + 0.35], color=_INK, linewidth=1)
    axes.set_yticks(range(len(checked.joints)), [joint.joint for joint in checked.joints])
    axes.invert_yaxis()
    axes.set_xlabel("deg: range, used, and rest", color=_INK)
    _plain(axes)


def _demand(axes: Axes, checked: HeadCheck) -> None:
    for row, joint in enumerate(checked.joints):
        for offset, share, color in ((-0.18, joint.speed, _SPEED), (0.18, joint.jerk, _JERK)):
            axes.barh(row + offset, 100 * share, height=0.32, color=color if share <= 1 else _OVER)
    axes.axvline(100, color=_INK, linewidth=1)
    axes.set_xlabel("% of the limit: speed (upper), jerk (lower)", color=_INK)
    _plain(axes)


def _plain(axes: Axes) -> None:
    axes.tick_params(labelsize=8, colors=_INK, length=2)
    axes.grid(axis="x", color=_RANGE, linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(_FAINT)
