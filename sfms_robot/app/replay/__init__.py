"""Looking at a recorded run: read it back, plot it, draw the head at twelve instants."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.app.out_files import checked_png
from sfms_robot.app.replay.run_file import RunRecording, read_recording, summary
from sfms_robot.app.replay.run_plot import plot
from sfms_robot.config import load_head
from sfms_robot.errors import ConfigError
from sfms_robot.face.contact_sheet import Instant, render_sheet
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.frames import Doubles

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


def sheet(recording: RunRecording, png: Path | str) -> list[Instant]:
    """Draw virtual head and robot at twelve instants: the face asked for, what the servos did. Return the instants.

    A head that is not at hand, has other joints now or names no URDF is left out. Raises MissingExtra without vtk.
    """
    talking = recording.talks_at(recording.times_s) if recording.has_voice else None
    return render_sheet(png, recording.times_s, recording.motion, talking, recording.title, _robot(recording))


def _robot(recording: RunRecording) -> tuple[RobotScene, Doubles] | None:
    """Return the robot's picture, and the angles (N, J) that were read, or asked for where none was."""
    try:
        head = load_head(recording.about["head"])
        scene = scene_of(head) if tuple(head.joints) == recording.joints else None
    except ConfigError:
        return None
    if scene is None:
        return None
    read_rad = recording.present_rad.astype(np.float64)
    return scene, np.where(np.isnan(read_rad), recording.goals_rad, read_rad)
