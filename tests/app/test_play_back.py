"""A recorded run again: on the same head and on another, within its limits; and on a page."""

import json
from contextlib import closing
from urllib.request import urlopen

import numpy as np
import pytest
from websockets.sync.client import connect

from sfms_robot.app.options import RunOptions, begin_page
from sfms_robot.app.replay.play_back import pictures, play_back, recorded_face, show_recording
from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.app.session import run
from sfms_robot.frames import MOTION_DIM, Reading
from sfms_robot.ports import Tick
from sfms_robot.runtime.recorder import Recorder
from sfms_robot.viewer.page_messages import frame_json

HEAD, SECONDS = "interbotix_wxxms", 4.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A run in virtual time, and its report."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    return folder, run(RunOptions(head=HEAD, duration_s=SECONDS, fast=True, record=folder, style=("neck=1.5",)))


def test_the_same_head_does_what_it_did(recorded):
    folder, report = recorded
    played = play_back(folder, fast=True)
    assert (played["head"], played["exit"], played["error"]) == (HEAD, "done", None)
    assert played["duration_s"] == pytest.approx(SECONDS) and played["limits"]["violations"] == 0
    assert played["motion"] == report["motion"]
    for joint, went in report["joints"].items():
        for end in ("min_rad", "max_rad"):
            assert played["joints"][joint][end] == pytest.approx(went[end], abs=0.02)


def test_another_head_does_what_it_can(recorded):
    played = play_back(recorded[0], head="poppy_head", fast=True)
    assert played["head"] == "poppy_head" and played["exit"] == "done" and played["limits"]["violations"] == 0
    assert any(joint["travel_rad"] > 0.01 for joint in played["joints"].values())


def test_a_face_is_that_of_its_tick_and_between_two_between_them(recorded):
    recording = read_recording(recorded[0])
    listened = recording.times_s <= recording.listened_s
    assert recording.listened_s == SECONDS and not listened.all()  # a head that plays it has a way to rest of its own
    timeline, times_s, motion = recorded_face(recording), recording.times_s[listened], recording.motion[listened]
    np.testing.assert_array_equal(timeline.sample(times_s, 0.0, None)[0], motion)
    between, _ = timeline.sample((times_s[1:] + times_s[:-1]) / 2, 0.0, None)
    np.testing.assert_allclose(between, (motion[1:] + motion[:-1]) / 2, atol=1e-6)
    outside, _ = timeline.sample(np.array([-5.0, 1e9]), 0.0, None)
    np.testing.assert_array_equal(outside, motion[[0, -1]])


def test_a_recording_tells_what_ran_on_what_and_how_and_holds_its_head_file(recorded, tmp_path):
    about = read_recording(recorded[0]).about
    assert {"version", "python", "platform", "started_utc", "listener_sha256"} <= set(about)
    assert len(about["listener_sha256"]) == 64 and "head_yaml" in about and "listener_config" in about
    options = json.loads(about["options"])
    assert options["head"] == HEAD and options["fast"] and options["style"] == ["neck=1.5"]
    (tmp_path / "head.yaml").write_text(read_recording(recorded[0]).about["head_yaml"])
    played = play_back(recorded[0], head=str(tmp_path), fast=True)
    assert played["head"] == HEAD and played["joints"] == play_back(recorded[0], fast=True)["joints"]


def test_what_is_wrong_is_said_in_one_line(recorded, command_line):
    for words, told in (
        (["--head", "poppy_head"], "add --port"),
        (["--port", "sim", "--head", "nobody"], "nobody"),
        (["--port", "/dev/nowhere"], "/dev/nowhere"),
    ):
        ended = command_line("replay", recorded[0], *words)
        assert ended.code in (2, 3) and told in ended.complaint


def test_twenty_five_pictures_a_second_are_what_was_recorded(recorded):
    recording = read_recording(recorded[0])
    told = [json.loads(frame_json(record)) for record in pictures(recording)]
    assert len(told) == pytest.approx(25 * recording.duration_s, abs=2)
    middle = told[25]
    row = int(np.argmin(np.abs(recording.times_s - middle["t"])))
    assert np.allclose(middle["m"], recording.motion[row], atol=6e-5)
    assert np.allclose(middle["j"], recording.goals_rad[row], atol=6e-5)
    assert [told[0]["s"], told[-1]["s"]] == ["starting", "stopping"] and middle["db"] is not None


def test_a_position_that_was_old_is_not_shown_as_read(tmp_path):
    recorder = Recorder(tmp_path / "run", ("slow", "away"), wait=True)
    for index in range(50):
        readings = {"slow": Reading(0.11, 0.04 * (index % 25)), "away": Reading(0.12, 0.04 * index)}
        recorder.tick(Tick(0.04 * index, np.zeros(MOTION_DIM, np.float32), np.array([0.1, 0.2]), readings))
    recorder.close()
    told = [json.loads(frame_json(record)) for record in pictures(read_recording(tmp_path / "run"))]
    assert all(each["r"][0] == 0.11 for each in told)
    assert told[20]["r"] == [0.11, 0.12] and told[-1]["r"] == [0.11, None] and told[-1]["u"] == [0.11, 0.2]


def test_the_page_has_all_of_it(recorded):
    folder, page = recorded[0], begin_page("0")
    with closing(page):
        page.wait()
        show_recording(folder, page)
        with connect(page.url.replace("http", "ws", 1) + "ws") as visitor:  # the page's process may still be reading
            told = json.loads(visitor.recv(timeout=30))
            while not told.get("over") and told["type"] != "over":
                told = json.loads(visitor.recv(timeout=30))
        with urlopen(page.url + "runs/last", timeout=30) as answer:
            lines = [json.loads(line) for line in answer.read().splitlines()]
        assert lines[0]["head"] == HEAD and lines[0]["replay"] is True
        assert sum(line["type"] == "frame" for line in lines) == len(list(pictures(read_recording(folder))))
        assert lines[-1]["report"]["ticks"] > 200
