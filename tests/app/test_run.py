"""`run` from end to end in virtual time: the shipped listener, a recorded person, emulated servos on a pty."""

import dataclasses
import os
import socket
import subprocess
import sys

import pytest

from sfms_robot.app.options import RunOptions
from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.app.session import run
from sfms_robot.config import load_head
from sfms_robot.data import data_dir, head_names
from sfms_robot.errors import ConfigError, PortError

SHORT = RunOptions(duration_s=3.0, fast=True, seed=3)
WATCHED = """
import json, sys
from pathlib import Path
from sfms_robot.app import session
from sfms_robot.app.options import RunOptions
from sfms_robot.app.listen.page_observer import PageObserver
from sfms_robot.app.listen.page_session import PageRecorder
from sfms_robot.app.listen.report import OutletObserver
from sfms_robot.config import load_head
from sfms_robot.ports import Observer
from sfms_robot.runtime.safety import Interrupt
from sfms_robot.viewer.page_process import Address, PageProcess

class Outlet:
    def hears(self, audio, time_s): pass
    def tells(self, kind, time_s, **values): pass

class Looks(Interrupt, Observer):
    "Asked before torque comes on, and at every tick."
    before = None
    def __call__(self):
        self.before = self.before or set(sys.modules)
        return super().__call__()
    def tick(self, seen):
        document = json.dumps(shown[0]())
        self.after = set(sys.modules)
    def close(self): pass

class Shown:
    def __init__(self, controls): shown.append(controls.document)
    def __enter__(self): pass
    def __exit__(self, *_): pass

listener, folder = sys.argv[1], Path(sys.argv[2])
shown, looks, joints = [], Looks(), list(load_head("face28").joints)
page = PageProcess(Address(port=0))
page.wait()
page.say("begin", head="face28")
recorder = PageRecorder(page, folder, joints, {})
recorder.record(True)
watcher = PageObserver(page, joints)
watcher.document = lambda: shown[0]()
options = RunOptions(listener=listener, duration_s=3.0, fast=True, record=folder / "run", status="0")
observers = [watcher, recorder, OutletObserver(Outlet()), looks]
controls = session.RunControls(load_head("face28"), options)
controls.interrupt = looks
report = session.run(options, Shown, observers=observers, controls=controls)
page.close()
print(json.dumps([report["exit"], report["observers_detached"], sorted(looks.after - looks.before)]))
"""


@pytest.fixture(scope="module")
def report():
    return run(SHORT)


def test_the_report_has_what_it_promises_and_no_wall_clock_figure_of_virtual_time(report):
    assert report["version"] == 1 and report["head"] == "face28" and report["exit"] == "done"
    assert (report["frames"], report["duration_s"], report["seed"]) == (75, 3.0, 3)
    assert report["ticks"] > 300 and set(report["joints"]) == set(load_head("face28").joints)
    assert set(report["motion"]) == {"nods", "blinks", "smiles"} and report["limits"]["violations"] == 0
    bus = report["bus"]
    assert bus["writes"] == report["ticks"] <= bus["reads"]
    assert (bus["errors"], bus["silent"], bus["faults"]) == (0, [], [])
    assert report["tick"]["achieved_hz"] is None and report["tick"]["jitter_ms"]["p99"] is None
    assert report["latency_ms"]["frame_to_wire"] == {"p50": None, "p99": None}
    assert report["latency_ms"]["speech_to_wire"] == {"p50": None, "p95": None}
    assert report["listener_step_ms"] == {"p50": None, "p99": None}


@pytest.mark.parametrize("listener", ["sfms-small", pytest.param("arig-small", marks=pytest.mark.slow)])
def test_nothing_is_imported_for_the_first_time_while_torque_is_on(listener, tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:  # a service manager
        manager.bind(str(tmp_path / "notify"))
        environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")}
        words = [sys.executable, "-c", WATCHED, listener, str(tmp_path)]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.splitlines()[-1:] == ['["done", {}, []]'], done.stderr


def test_one_seed_is_one_command_stream_and_another_seed_another(report):
    assert run(SHORT) == report
    other = run(dataclasses.replace(SHORT, seed=4))
    assert other["wire"]["main"]["sha256"] != report["wire"]["main"]["sha256"]


@pytest.mark.parametrize(
    ("audio", "face"),
    [
        ("none", "none"),
        pytest.param("katie", "none", marks=pytest.mark.slow),
        pytest.param("none", "face.csv.gz", marks=pytest.mark.slow),
    ],
)
def test_a_missing_modality_is_normal(audio, face, tmp_path):
    if face != "none":
        face = str(data_dir("sim") / "speakers" / "facegood_1114_3_16" / face)
    done = run(dataclasses.replace(SHORT, audio=audio, face=face))
    assert done["exit"] == "done" and done["limits"]["violations"] == 0
    assert sum(joint["travel_rad"] for joint in done["joints"].values()) > 0.1


def test_a_run_is_recorded_whole(tmp_path):
    done = run(dataclasses.replace(SHORT, record=tmp_path / "run"))
    recording = read_recording(tmp_path / "run")
    assert recording.whole and recording.joints == tuple(load_head("face28").joints)
    assert len(recording.times_s) == done["ticks"] and recording.listened_s == 3.0
    assert recording.states[-1][1] == "stopping" and recording.duration_s > 4.0
    rest_rad = [joint.rest_rad for joint in load_head("face28").joints.values()]
    assert recording.goals_rad[-1] == pytest.approx(rest_rad, abs=1e-3)
    assert (tmp_path / "run" / "report.json").is_file()
    assert done["exit"] == "done"


def test_a_dry_run_reads_every_joint_moves_none_and_has_the_supply_of_the_real_head():
    seen = run(dataclasses.replace(SHORT, dry_run=True))
    assert all(reading["position_rad"] is not None for reading in seen["readings"].values())
    assert "joints" not in seen
    seen = run(RunOptions(head="reachy_mini", duration_s=1.0, fast=True, dry_run=True))
    assert all(reading["fault"] is None for reading in seen["readings"].values())  # alert and all: the head allows it


def test_hobby_servos_on_a_real_port_move_only_when_that_is_confirmed():
    options = RunOptions(head="inmoov2_ssc32", port="/dev/does-not-exist", duration_s=1.0)
    with pytest.raises(ConfigError, match=r"'inmoov2_ssc32': hobby servos .* jumps .*\(rothead, .* with --yes"):
        run(options)
    with pytest.raises(PortError, match="does-not-exist"):
        run(dataclasses.replace(options, yes=True))


@pytest.mark.slow
def test_in_real_time_every_figure_is_measured():
    done = run(RunOptions(duration_s=4.0))
    assert done["exit"] == "done" and done["limits"]["violations"] == 0
    assert done["tick"]["achieved_hz"] > 0 and done["tick"]["jitter_ms"]["max"] >= 0
    assert done["latency_ms"]["frame_to_wire"]["p50"] > 0
    assert done["latency_ms"]["speech_to_wire"]["p95"] > done["latency_ms"]["frame_to_wire"]["p50"]
    assert done["listener_step_ms"]["p50"] > 0 and "wire" not in done


@pytest.mark.parametrize("name", head_names())
def test_it_listens_for_three_seconds_without_a_violation(name):
    head = load_head(name)
    report = run(RunOptions(head=name, duration_s=3.0, fast=True))
    assert (report["exit"], report["head"], report["frames"]) == ("done", name, 75)
    assert report["limits"]["violations"] == 0
    assert (report["bus"]["errors"], report["bus"]["silent"], report["bus"]["faults"]) == (0, [], [])
    assert set(report["wire"]) == set(head.buses) and all(wire["bytes"] for wire in report["wire"].values())
    if head.kinematics is not None:
        neck = [report["joints"][joint]["travel_rad"] for joint in head.kinematics.joints()]
        assert sum(neck) > 0.05


def test_a_joint_left_out_is_named_and_the_others_move():
    report = run(RunOptions(duration_s=2.0, fast=True, seed=3, without=("jaw", "neck_roll")))
    assert report["exit"] == "done" and report["limits"]["violations"] == 0
    assert report["bus"]["buses"]["main"]["silent"] == [] and report["joints"]["neck_pitch"]["travel_rad"] > 0


def test_a_bus_of_joints_that_are_all_left_out_is_not_opened():
    without = ("antenna_left", "antenna_right")
    options = RunOptions(head="open_duck_mini_v2_head", duration_s=1.0, fast=True, without=without)
    report = run(options)
    assert report["exit"] == "done" and set(report["bus"]["buses"]) == {"neck", "left out"}
