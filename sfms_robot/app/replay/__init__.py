"""Looking at a recorded run: read it back, plot it, draw the head at twelve instants."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfms_robot.app.plot_style import checked_png
from sfms_robot.app.replay.run_file import RunRecording, read_recording, summary
from sfms_robot.app.replay.run_plot import plot
from sfms_robot.app.replay.run_sheet import sheet

__all__ = ["RunRecording", "plot", "read_recording", "replay_run", "sheet", "summary"]


def replay_run(folder: Path, plot_png: Path | None, sheet_png: Path | None) -> dict[str, Any]:
    """Draw what is asked for, and say what is in the recording. Raises ConfigError, MissingExtra."""
    for png, option in ((plot_png, "--plot"), (sheet_png, "--sheet")):
        if png is not None:
            checked_png(png, option)
    recording = read_recording(folder)
    if plot_png is not None:
        plot(recording, plot_png)
    if sheet_png is not None:
        sheet(recording, sheet_png)
    return summary(recording)
