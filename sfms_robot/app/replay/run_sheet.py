"""The virtual head at twelve instants of a recorded run."""

from __future__ import annotations

from pathlib import Path

from sfms_robot.app.replay.run_file import RunRecording
from sfms_robot.face.contact_sheet import Instant, render_sheet


def sheet(recording: RunRecording, png: Path | str) -> list[Instant]:
    """Draw the face the listener asked for, and say at which instants. Raises MissingExtra without vtk."""
    talking = recording.talks_at(recording.times_s) if recording.has_voice else None
    return render_sheet(png, recording.times_s, recording.motion, talking, recording.title)
