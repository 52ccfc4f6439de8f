"""`head check`, `head list` and `head show`: what they find, and what they print."""

import json

import numpy as np
import pytest

from sfms_robot.app.catalogue import shipped_heads
from sfms_robot.app.head.head_check import check
from sfms_robot.config import load_head
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, MOTION_DIM
from sfms_robot.signals.tracks import Track, write_track

FACES = ("face24_maestro", "face28", "inmoov2_maestro", "inmoov2_ssc32")


@pytest.fixture
def tracks(tmp_path):
    """A folder with one track of 4 s: a nod of 10 degrees once a second, and one shut jaw that opens half."""
    times_s, motion = np.arange(100) / 25, np.zeros((100, MOTION_DIM), np.float32)
    motion[:, CHANNEL_INDEX["pitch"]] = np.radians(10) * np.sin(2 * np.pi * times_s)
    motion[:, CHANNEL_INDEX["jawOpen"]] = 0.25 * (1 - np.cos(2 * np.pi * times_s))
    write_track(tmp_path / "nod.csv", Track(times_s, motion, frozenset(CHANNELS)))
    return tmp_path


@pytest.fixture
def command(command_line):
    """Exit code and stdout of `sfms-robot head WORDS`."""
    return lambda *words: command_line("head", *words)[:2]


def test_use_and_demand_are_those_of_the_faces_shown_and_clipping_leaves_out_where_a_joint_rests(tracks):
    rows = {row["joint"]: row for row in check("face28", tracks)["joints"]}
    pitch, jaw = rows["neck_pitch"], rows["jaw"]
    assert (pitch["low_deg"], pitch["high_deg"]) == pytest.approx((-10, 10), abs=0.1)
    assert pitch["used"] == pytest.approx(20 / 65, abs=0.01)
    limit = load_head("face28").limit("neck_pitch")
    assert pitch["speed"] == pytest.approx(2 * np.pi * 10 / limit.speed_deg_s, rel=0.02)
    assert 1 < pitch["jerk"] / ((2 * np.pi) ** 3 * 10 / limit.jerk_deg_s3) < 1.5  # frames make it a little rougher
    assert jaw["high_deg"] == pytest.approx(14, abs=0.1) and jaw["clipped"] == 0
    assert (pitch["channels"], jaw["channels"]) == (("pitch",), ["jawOpen"])
    rows = {row["joint"]: row for row in check("inmoov2_maestro", tracks)["joints"]}
    assert rows["jaw"]["low_deg"] == 0 and rows["jaw"]["clipped"] == 0


@pytest.mark.parametrize("name", FACES)
def test_recorded_faces_use_half_of_what_shows_a_face_and_rarely_an_end(name):
    rows = {row["joint"]: row for row in check(name)["joints"]}
    for joint in (joint for joint in rows if joint.startswith(("lid_left", "lid_upper_left", "jaw", "eye_pan"))):
        assert rows[joint]["used"] > 0.5, joint
    assert all(row["clipped"] < 0.05 for row in rows.values())


def test_a_platforms_reach_and_the_share_of_recorded_poses_in_it_are_told():
    neck = check("reachy_mini")["neck"]
    assert neck["reach"]["pitch"] == (-40, 40) and neck["reach"]["z"] == (-50, 23) and 0.9 < neck["reached"] < 1


def test_all_problems_come_at_once_with_those_of_the_neck(tmp_path, command):
    text = (data_dir("configs") / "heads" / "op3_head" / "head.yaml").read_text()
    broken = text.replace("id: 20", "id: 19").replace("yaw: head_pan", "yaw: head_pam").replace(": tilt", ": up")
    (tmp_path / "head.yaml").write_text(broken + "\nfolds: [{channel: jawOpen, into: head_tilt, gain: 0.1}]\n")
    code, out = command("check", str(tmp_path))
    assert code == 2
    for told in ("'head_pam' is not a joint", "id = 19 is used twice", "limits = 'up'", "folds.0.into = 'head_tilt'"):
        assert told in out
    code, out = command("check", str(tmp_path), "--json")
    assert code == 2 and len(json.loads(out)["problems"]) == 4


def test_a_folder_without_tracks_is_refused_and_a_home_out_of_reach_is_a_problem_of_the_head(tmp_path):
    with pytest.raises(ConfigError, match="no face tracks"):
        check("op3_head", tmp_path)
    text = (data_dir("configs") / "heads" / "reachy_mini" / "head.yaml").read_text()
    (tmp_path / "head.yaml").write_text(text.replace("home_height_m: 0.177", "home_height_m: 0.3"))
    assert "home is out of reach" in " ".join(check(str(tmp_path))["problems"])


def test_show_tells_value_and_origin(command):
    code, out = command("show", "face28", "--joint", "eye_pan_right", "--json")
    assert code == 0
    assert json.loads(out)["joints"]["eye_pan_right"]["max_deg"] == {"value": 30.0, "from": "mirror of eye_pan_left"}
    assert "mirror of eye_pan_left" in command("show", "face28", "--joint", "eye_pan_right")[1]
    assert command("show", "face28", "--joint", "ear")[0] == 2


@pytest.mark.parametrize("head", [entry["name"] for entry in shipped_heads()])
def test_a_shipped_head_has_its_picture_and_provenance(head):
    folder = data_dir("configs") / "heads" / head
    assert 0 < (folder / "picture.png").stat().st_size < 60_000
    text = (folder / "README.md").read_text()
    assert "## Provenance" in text and "## What this head cannot show" in text
    assert all(joint in text for joint in load_head(head).joints)


OWL = """\
version: 1
name: owl
description: a neck and a beak
buses:
  main: {family: dynamixel2, baud: 1000000}
limits:
  neck: {speed_deg_s: 150, acceleration_deg_s2: 1500, jerk_deg_s3: 90000}
joint_defaults: {bus: main, model: xl330-m288, zero_ticks: 2048, lag_ms: 30, limits: neck}
joints:
  neck_yaw: {id: 1, min_deg: -60, max_deg: 60, unit: rad, drive: yaw}
  beak: {id: 3, min_deg: 0, max_deg: 25, drive: jawOpen}
  lid: {id: 4, mirror_of: beak}
"""


@pytest.mark.parametrize(
    "old, new, lines",
    [
        ("max_deg: 25,", "max_deg: 25,5,", ["joints.beak: 5 stands alone, without a key: a decimal number is written"]),
        ("max_deg: 25,", "max_deg: '25,5',", ["beak.max_deg = '25,5': a decimal number is written with a point: 25.5"]),
        ("\n  ", "\n  - ", ["joints: expected keys with values, as key: value, got a list: leave out the dashes"]),
        ("of: beak", "of: baek", ["joints.lid.mirror_of = 'baek' is not a joint of this head (", "'beak'?"]),
        ("xl330-m288", "xl330-m299", ["joints.neck_yaw, beak, lid: model = 'xl330-m299' has no firmware map; did you"]),
        ("dynamixel2", "feetech", ["neck_yaw.model = 'xl330-m288': expected a servo of family feetech, as bus main"]),
        ("unit: rad", "unit: rads", ["neck_yaw.unit = 'rads': Input should be 'range' or 'rad'; did you mean 'rad'?"]),
        ("drive: jawOpen", "drive: jawopen", ["; did you mean 'jawOpen'?"]),
        ("id: 3", "ids: 3", ["joints.beak: 'ids' is not a known key (", "; did you mean 'id'?"]),
        ("name: owl", "\tname: owl", ["head.yaml:2: found", "YAML is indented with spaces, not tabs"]),
    ],
)
def test_a_mistake_is_named_with_what_to_write(tmp_path, old, new, lines):
    before, joints, after = OWL.partition("joints:")
    if old == "\n  ":
        text = before + joints + after.replace(old, new)
    else:
        text = OWL.replace(old, new)
    assert text != OWL
    (tmp_path / "head.yaml").write_text(text)
    problem = check(str(tmp_path))["problems"][0]
    assert all(line in problem for line in lines) and "\n" not in problem, problem


def test_models_have_any_case_and_small_ranges_and_wild_speeds_are_remarks(tmp_path):
    text = OWL.replace("xl330-m288", "XL330-M288-T").replace("-60, max_deg: 60", "-1.05, max_deg: 1.05")
    (tmp_path / "head.yaml").write_text(text.replace("speed_deg_s: 150", "speed_deg_s: 3000"))
    checked = check(str(tmp_path))
    assert checked["problems"] == [] and checked["joints"][0]["servo"] == "xl330-m288"
    small, *fast = checked["remarks"]
    assert small == "joints.neck_yaw: -1.05..1.05 deg is a small range: is it in radians?"
    assert "3000 deg/s is more than xl330-m288 turns without a load (618)" in fast[0]
