"""Looking at a recorded run: read it back, plot it, draw the head at twelve instants. Counts as part of `app`."""

from sfms_robot.replay.plot import plot
from sfms_robot.replay.recording import RunRecording, read_recording, summary
from sfms_robot.replay.sheet import sheet

__all__ = ["RunRecording", "plot", "read_recording", "sheet", "summary"]
