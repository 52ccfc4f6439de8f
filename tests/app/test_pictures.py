"""Pictures of a recording: the plot, and the sheet with its twelve instants."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from recorded_runs import record

from sfms_robot.app.replay.pictures import pick_instants, plot, sheet
from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.config import load_head
from sfms_robot.frames import CHANNEL_INDEX


def size_of(png):
    """Return the height and width of a picture, px."""
    with Image.open(png) as picture:
        return picture.height, picture.width


@pytest.mark.parametrize(("seconds", "voice"), [(2.0, True), (2.0, False), (0.01, True)])
def test_a_plot_is_1600_by_1200(tmp_path, seconds, voice):
    pytest.importorskip("matplotlib")
    plot(read_recording(record(tmp_path, seconds, voice)), tmp_path / "a.png")
    assert size_of(tmp_path / "a.png") == (1200, 1600)


def run_with_events():
    times_s, frames = np.arange(500) / 25, np.zeros((500, 58), dtype=np.float32)

    def bump(name, at_s, height, width_s):
        frames[:, CHANNEL_INDEX[name]] += height * np.exp(-(((times_s - at_s) / width_s) ** 2))

    bump("pitch", 4.0, 0.2, 0.15)
    bump("pitch", 14.0, -0.3, 0.15)  # a look up
    for side in ("Left", "Right"):
        bump(f"eyeBlink{side}", 7.0, 1.0, 0.08)
        bump(f"mouthSmile{side}", 11.0, 0.8, 0.8)
    bump("eyeLookInLeft", 17.0, 0.6, 0.3)
    bump("eyeLookOutRight", 17.0, 0.6, 0.3)
    return times_s, frames


def run_of(folder, head):
    """Return a recording of those events, by a head of two joints."""
    times_s, frames = run_with_events()
    still = np.zeros((len(times_s), 2), np.float32)
    return replace(
        read_recording(record(folder, 0.3)), about={"head": head}, joints=tuple(load_head("op3_head").joints),
        times_s=times_s, motion=frames, goals_rad=still, present_rad=still.copy(),
    )  # fmt: skip


def test_a_sheet_shows_what_happened():
    times_s, motion = run_with_events()
    instants = pick_instants(times_s, motion)
    labels = {label: times_s[row] for row, label in instants.items()}
    assert len(instants) == 12 and sorted(instants) == list(instants)
    assert labels["nod, lowest"] == pytest.approx(4.0, abs=0.05)
    assert 3.4 < labels["nod begins"] < labels["nod, lowest"] < labels["nod ends"] < 4.6
    assert labels["blink"] == pytest.approx(7.0, abs=0.05) and labels["smile"] == pytest.approx(11.0, abs=0.1)
    assert labels["looks right"] == pytest.approx(17.0, abs=0.1)
    assert max(np.diff(times_s[list(instants)])) < 4.0


@pytest.mark.parametrize("head", ["op3_head", "gone"])
def test_pictures_are_drawn_without_a_display_and_without_the_head(tmp_path, head):
    pytest.importorskip("vtkmodules")
    run = run_of(tmp_path, head)
    assert sheet(run, tmp_path / "sheet.png") == pick_instants(run.times_s, run.motion)
    height, width = size_of(tmp_path / "sheet.png")
    assert width == pytest.approx(1800 if head == "op3_head" else 1600, abs=20) and 1000 < height < 1400
