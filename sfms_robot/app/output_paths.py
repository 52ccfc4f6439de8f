"""Checks of files that a command will write, before the work begins; and the style of pictures."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from sfms_robot.errors import ConfigError, optional

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT, RULE, TRUTH, KEY = "#2a2d34", "#7d828c", "#e4e9ec", "#9aa3ad", "#c8553d"
SERIES: Final = ("#1f6f9c", "#c29a2e", "#5b8c5a", "#c8553d", "#7a5c99")
_DPI: Final = 110


def checked_file(file: Path, option: str) -> Path:
    """Return the file. Raises ConfigError, which names the option, if it cannot be written."""
    if file.is_dir():
        raise ConfigError(f"{option} {file}: cannot be written: is a folder")
    if not file.parent.is_dir():
        raise ConfigError(f"{option} {file}: cannot be written: no folder {file.parent}")
    if not os.access(file if file.exists() else file.parent, os.W_OK):
        raise ConfigError(f"{option} {file}: cannot be written: no permission")
    return file


def made_folder(folder: Path, option: str) -> Path:
    """Create the folder, and return it. Raises ConfigError, which names the option, if it cannot be created."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{option} {folder}: cannot be written to: {error.strerror or error}") from error
    return folder


# --- pictures of tables and heads -----------------------------------------------------------------------------------


def checked_png(png: Path, option: str) -> Path:
    """Return the file, checked before the work begins. Raises ConfigError if no PNG can be written there."""
    if png.suffix.lower() != ".png":
        raise ConfigError(f"{option} {png}: expected the name of a picture, FILE.png")
    return checked_file(png, option)


def new_figure(width_in: float, height_in: float, dpi: int = _DPI) -> Figure:
    """Return an empty figure. Raises MissingExtra without matplotlib."""
    with optional("a plot"):
        from matplotlib.figure import Figure
    return Figure(figsize=(width_in, height_in), dpi=dpi, layout="constrained")


def save(figure: Figure, png: Path) -> None:
    """Write a picture. Raises ConfigError if it cannot be written."""
    try:
        png.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(png)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{png}: cannot be written: {error}") from error


def plain(axes: Axes, size: float = 8, grid: Literal["both", "x"] = "both") -> None:
    """Remove the box around `axes`, and draw a faint grid."""
    axes.tick_params(labelsize=size, colors=INK, length=2, which="both")
    axes.grid(axis=grid, color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
