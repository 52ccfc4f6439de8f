"""A package of somebody else's, with its dist-info, adds listeners, sources and buses by name."""

import json
import os
import subprocess
import sys
from contextlib import closing

import pytest

import sfms_robot as sr
from sfms_robot.data import data_dir
from sfms_robot.sources.registry import open_source

PACKAGE = """
import numpy as np
import sfms_robot as sr

class Nodder:
    hop, horizon = 1, 1

    def __init__(self, size):
        self.size = float(size or 0.1)

    def start(self, seed):
        return None

    def step(self, speaker, memory):
        frames = np.zeros((1, 58), np.float32)
        frames[0, 1] = self.size * np.sin(2 * np.pi * 1.5 * speaker.time_s)
        return sr.Plan(speaker.time_s, np.array([speaker.time_s + 0.04]), frames), memory

class Hum(sr.Source):
    def __init__(self, argument):
        self.level, self.given = float(argument), 0

    def read(self, now_s):
        frames = []
        while (self.given + 1) / 25 <= now_s:
            self.given += 1
            frames.append(sr.SpeakerFrame(self.given / 25, np.full(640, self.level, np.float32)))
        return frames
"""

FAMILY = """
from sfms_robot.servo.chain.protocol2 import Dynamixel2Bus
from sfms_robot.servo.families import BusFamily

FAMILY = BusFamily("Somebody's servos", "somebodys_servos:Bus", ("dynamixel", 2))

class Bus(Dynamixel2Bus):
    '''Its statistics say whose they are.'''

    def statistics(self):
        return {**super().statistics(), "whose": "somebody's"}
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A folder as pip leaves it: the module, and METADATA and entry_points.txt of its distribution."""
    (tmp_path / "somebodys_nods.py").write_text(PACKAGE)
    info = tmp_path / "somebodys_nods-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: somebodys-nods\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[sfms_robot.listeners]\nnodder = somebodys_nods:Nodder\nbroken = somebodys_nods:Missing\n"
        "sfms-small = somebodys_nods:Nodder\n"
        "[sfms_robot.sources]\nhum = somebodys_nods:Hum\n"
        "[sfms_robot.buses]\nsomebodys = somebodys_servos:FAMILY\n"
    )
    (tmp_path / "somebodys_servos.py").write_text(FAMILY)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def program(installed, *words, code="from sfms_robot.cli.main import main; main()"):
    """Run a command line, or other code, where that package is installed."""
    here = {**os.environ, "XDG_CONFIG_HOME": str(installed), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=here, timeout=120)


def test_a_listener_of_another_package_is_loaded_by_its_name(installed):
    listener = sr.load_listener("nodder:0.2")
    plan = listener.stream().push(None)
    assert listener.hop == 1 and plan is not None and plan.frames.shape == (1, 58)
    assert sr.load_listener("sfms-small").horizon == 8  # shipped names go first


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("broken", "^plug-in broken .package somebodys-nods, somebodys_nods:Missing.: AttributeError: .*'Missing'"),
        ("nodder:large", "^plug-in nodder .package somebodys-nods, somebodys_nods:Nodder.: ValueError: could not"),
        ("nope", "'nope' is neither .*sfms-small"),
    ],
)
def test_one_that_fails_at_import_or_when_it_is_made_says_which(installed, name, problem):
    with pytest.raises(sr.ConfigError, match=problem) as raised:
        sr.load_listener(name)
    assert "\n" not in str(raised.value)


def test_a_run_listens_with_it_in_its_own_process(installed):
    done = program(installed, "run", "--head", "reachy_mini", "--listener", "nodder:0.15", "--duration", "2", "--json")
    assert done.returncode == 0, done.stderr
    assert '"listener_state": {"state": "listening"' in done.stdout.splitlines()[-1]


def test_a_source_of_another_package_is_opened_by_its_name(installed):
    with closing(open_source("hum:0.25", duration_s=0.4)) as source:
        frames = source.read(0.4)
    assert len(frames) == 10 and all((frame.audio == 0.25).all() for frame in frames)


@pytest.fixture
def their_head(installed):
    """The folder of a head on that bus."""
    folder = installed / "their_head"
    folder.mkdir()
    text = (data_dir("configs") / "heads" / "op3_head" / "head.yaml").read_text()
    assert "family: dynamixel2" in text
    (folder / "head.yaml").write_text(text.replace("family: dynamixel2", "family: somebodys"))
    return folder


def test_a_broken_plug_in_ends_no_command_but_the_one_that_names_it(installed, their_head):
    (installed / "somebodys_servos.py").write_text("raise RuntimeError('not for this computer')")
    for words, problem in (
        (["doctor", "--port", "/dev/null", "--baud", "5"], "--baud 5"),
        (["run", "--head", str(their_head)], "not for this computer"),
    ):
        done = program(installed, *words)
        warned, said = done.stderr.splitlines()
        assert done.returncode == 2 and "somebodys" in warned and warned.endswith("it is left out")
        assert problem in said


def test_a_head_on_a_bus_of_another_package_runs_on_emulated_servos(installed, their_head):
    words = ["--listener", "nodder:0.15", "--audio", "none", "--face", "none", "--fast", "--duration", "3", "--json"]
    done = program(installed, "run", "--head", str(their_head), *words)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["exit"] == "done" and report["limits"]["violations"] == 0
    assert report["bus"]["whose"] == "somebody's" and report["joints"]["head_tilt"]["travel_rad"] > 0.1
