"""A recorded run comes back on a page as it was: every picture, its events, its states."""

import json
from contextlib import closing
from urllib.request import urlopen

import numpy as np
import pytest
from websockets.sync.client import connect

from sfms_robot.app.listen.preflight import begin_page
from sfms_robot.app.replay.page_replay import pictures, show_recording
from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.app.session import RunOptions, run
from sfms_robot.frames import MOTION_DIM, Reading
from sfms_robot.ports import Tick
from sfms_robot.runtime.recorder import Recorder
from sfms_robot.viewer.page_messages import frame_json


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two seconds of a run in virtual time."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    run(RunOptions(head="op3_head", duration_s=2.0, fast=True, seed=1, record=folder))
    return folder


def test_twenty_five_pictures_a_second_are_what_was_recorded(folder):
    recording = read_recording(folder)
    told = [json.loads(frame_json(record)) for record in pictures(recording)]
    assert len(told) == pytest.approx(25 * recording.duration_s, abs=2)
    middle = told[25]
    row = int(np.argmin(np.abs(recording.times_s - middle["t"])))
    assert np.allclose(middle["m"], recording.motion[row], atol=6e-5)
    assert np.allclose(middle["j"], recording.goals_rad[row], atol=6e-5)
    assert [told[0]["s"], told[-1]["s"]] == ["starting", "stopping"] and middle["db"] is not None


def test_a_position_that_was_old_is_not_shown_as_read(tmp_path):
    recorder = Recorder(tmp_path / "run", ("slow", "away"), when_full="wait")
    for index in range(50):
        readings = {"slow": Reading(0.11, 0.04 * (index % 25)), "away": Reading(0.12, 0.04 * index)}
        recorder.tick(Tick(0.04 * index, np.zeros(MOTION_DIM, np.float32), np.array([0.1, 0.2]), readings))
    recorder.close()
    told = [json.loads(frame_json(record)) for record in pictures(read_recording(tmp_path / "run"))]
    assert all(each["r"][0] == 0.11 for each in told)
    assert told[20]["r"] == [0.11, 0.12] and told[-1]["r"] == [0.11, None] and told[-1]["u"] == [0.11, 0.2]


def test_the_page_has_all_of_it(folder):
    page = begin_page("0")
    with closing(page):
        page.wait()
        show_recording(folder, page)
        with connect(page.url.replace("http", "ws", 1) + "ws") as visitor:  # the page's process may still be reading
            told = json.loads(visitor.recv(timeout=30))
            while not told.get("over") and told["type"] != "over":
                told = json.loads(visitor.recv(timeout=30))
        with urlopen(page.url + "runs/last", timeout=30) as answer:
            lines = [json.loads(line) for line in answer.read().splitlines()]
        assert lines[0]["head"] == "op3_head" and lines[0]["replay"] is True
        count = sum(line["type"] == "frame" for line in lines)
        assert count == len(list(pictures(read_recording(folder))))
        assert lines[-1]["report"]["ticks"] > 200
