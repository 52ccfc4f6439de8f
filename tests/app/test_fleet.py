"""A head among others: what commands do, what a tile says, and who may send one from a page."""

import json

import pytest

from sfms_robot.app.fleet.fleet_client import GONE_S, FleetBoard, tile
from sfms_robot.app.fleet.fleet_head import FleetControls, fleet_name
from sfms_robot.app.listen.knobs import turned
from sfms_robot.config import load_head
from sfms_robot.errors import ConfigError
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.safety import Interrupt


@pytest.fixture
def run():
    """The parts of a run that a fleet reaches, and what was asked of its listener."""

    class Run:
        halt, interrupt, knobs, calmed = HaltLatch(), Interrupt(), turned(load_head("face28")), []

        def obey(self, **command):
            controls = FleetControls(self.halt, self.interrupt, self.knobs, self.calmed.append)
            return controls.obey(json.dumps(command).encode())

    return Run()


def test_halt_names_who_asked_and_resume_lets_go(run):
    assert run.obey(command="halt", by="  kitchen\n") == {"done": "halt"}
    assert run.halt.by == "kitchen"
    assert run.obey(command="resume") == {"done": "resume"}
    assert run.halt.by is None


def test_end_asks_the_run_to_end(run):
    run.obey(command="end")
    assert run.interrupt()


def test_calm_and_knobs_are_turned(run):
    assert run.obey(command="calm", rates={"nod": 3.0}) == {"done": "calm"}
    assert run.calmed[0].nod == 3.0
    region = next(iter(run.knobs))
    assert run.obey(command="knobs", intensity={region: 0.5}) == {"done": "knobs"}
    assert run.knobs[region].intensity == 0.5


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ({"command": "dance"}, "halt, resume, end, calm, knobs"),
        ({}, "no command"),
        ({"command": "calm", "rates": {"nod": -1}}, "nod"),
        ({"command": "calm", "rates": 3}, "rates is no mapping"),
        ({"command": "knobs", "intensity": {"tail": 1}}, "'tail' is not a region of this head"),
        ({"command": "knobs", "intensity": {"neck": "much"}}, "is no number"),
        ({"command": "knobs", "style": {"neck": 9}}, "not in 0..2"),
    ],
)
def test_what_cannot_be_obeyed_is_one_line(run, command, said):
    answer = run.obey(**command)
    assert said in answer["error"] and "\n" not in answer["error"]


@pytest.mark.parametrize(
    "message",
    [b"", b"\xff\xfe", b"[]", b"{" * 10_000, b'{"command": ["halt"]}',
     b'{"command": "knobs", "intensity": {"neck": 1' + 400 * b"0" + b"}}"],
)  # fmt: skip
def test_nonsense_is_answered_and_does_nothing(run, message):
    controls = FleetControls(run.halt, run.interrupt, run.knobs, None)
    assert "error" in controls.obey(message)
    assert run.halt.by is None and not run.interrupt()


@pytest.mark.parametrize("name", ["", "a/b", "a b", "*", "listen", "küche"])
def test_a_name_that_cannot_be_part_of_a_key_is_refused(name):
    with pytest.raises(ConfigError, match="--fleet"):
        fleet_name(name)


def test_a_board_keeps_the_newest_of_each_and_says_who_went_away():
    now_s = [0.0]
    board = FleetBoard(lambda: now_s[0])
    board.told({"name": "b", "state": "idle"})
    board.told({"name": "a", "state": "listening", "head": "face28", "person": {"voice_db": -30.0}})
    now_s[0] = GONE_S + 1
    board.told({"name": "a", "state": "halted", "why": ["kitchen"]})
    a, b = board.tiles()
    assert (a["name"], a["state"], a["why"], a["here"]) == ("a", "halted", ["kitchen"], True)
    assert (b["name"], b["here"], b["age_s"]) == ("b", False, 4.0)


def test_a_head_that_has_ended_is_not_there():
    assert not tile("a", {"state": "stopped"})["here"]
    assert tile("a", {})["state"] == "?"
