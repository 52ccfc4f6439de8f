"""What visitors ask for is done to the run behind the page, or refused in one line."""

import numpy as np
import pytest

from sfms_robot.app.listen.knobs import turned
from sfms_robot.app.listen.page_commands import NAMED_EXPRESSIONS, PageCommands, Reach
from sfms_robot.config import Calmness, load_head
from sfms_robot.errors import RobotError
from sfms_robot.frames import CHANNEL_INDEX, CHANNELS
from sfms_robot.retarget.puppet import Puppet
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.sources.browser import Visitor
from sfms_robot.viewer.visitor_commands import Command


class Run:
    """What a page reaches, and what it was asked for."""

    def __init__(self):
        self.asked = []
        head = load_head("face28")
        self.reach = Reach(
            HaltLatch(), Puppet(), turned(head), Calmness(), lambda calm: self.asked.append(calm),
            lambda on: self.asked.append(("record", on)), lambda: self.asked.append("release"),
        )  # fmt: skip
        self.page = PageCommands(
            lambda what, value: self.asked.append((what, value)),
            lambda visitor, feeds: self.asked.append((visitor, feeds)),
            Visitor(),
        )
        self.page.reach = self.reach

    def does(self, command, **values):
        self.page.command(1, Command(command, values))

    def face(self, time_s):
        """(58,) of a listener that asks for nothing."""
        return self.reach.puppet.overlay(np.zeros((1, 58), np.float32), np.array([time_s]))[0]


def test_a_halt_is_the_pages_until_it_is_ended():
    run = Run()
    run.does("halt")
    assert run.reach.halt.by == "page"
    run.does("resume")
    assert run.reach.halt.by is None


def test_the_page_does_not_end_a_halt_of_the_device_and_its_visitor_is_answered():
    run = Run()
    run.does("halt")
    run.reach.halt.close("key")
    with pytest.raises(RobotError, match=r"^still halted: key \(cleared at the device\)$"):
        run.does("resume")
    assert run.reach.halt.by == "key"


def test_channels_expressions_and_neutral_are_laid_over_the_face():
    run = Run()
    run.face(0.0)
    run.does("show", channels={"jawOpen": 0.5}, seconds=1.0)
    run.face(0.01)
    assert run.face(0.9)[CHANNEL_INDEX["jawOpen"]] == pytest.approx(0.5)
    run.does("expression", name="smile", seconds=1.0)
    run.face(0.91)
    assert run.face(1.5)[CHANNEL_INDEX["mouthSmileLeft"]] == pytest.approx(0.8)
    run.does("neutral", seconds=1.0)
    run.face(1.51)
    assert not run.face(2.2).any()


def test_knobs_and_rates_are_turned():
    run = Run()
    run.does("knobs", intensity={"neck": 0.5}, style={"jaw": 2.0})
    assert run.reach.knobs["neck"].intensity == 0.5 and run.reach.knobs["jaw"].style == 2.0
    run.does("calm", rates={"nod": 5.0, "smile": None})
    run.does("calm", rates={"blink": 3.0})
    assert (run.asked[-1].nod, run.asked[-1].blink, run.asked[-1].smile) == (5.0, 3.0, None)


def test_the_rest_is_handed_on():
    run = Run()
    run.does("record", on=True)
    run.does("release")
    run.does("seed", seed=3)
    run.does("listener", name="arig-small")
    run.does("source", feeds=["voice"])
    assert run.asked == [("record", True), "release", ("seed", 3), ("listener", "arig-small"), (1, ["voice"])]


@pytest.mark.parametrize(
    ("name", "values", "problem"),
    [
        ("show", {"channels": {"nose": 1.0}, "seconds": 1.0}, "'nose' is not a channel"),
        ("show", {"channels": {"jawOpen": 2.0}, "seconds": 1.0}, "jawOpen = 2 is not a number in its range"),
        ("neutral", {"seconds": -1.0}, "seconds = -1 is not a positive number"),
        ("expression", {"name": "dance", "seconds": 1.0}, "expression 'dance' is not there .smile"),
        ("look_at", {"x_m": 0.0, "y_m": 0.0, "z_m": 0.0, "seconds": 1.0}, "is not a point"),
        ("knobs", {"intensity": {"tail": 1.0}, "style": {}}, "'tail' is not a region"),
        ("knobs", {"intensity": {"neck": 3.0}, "style": {}}, "is not in 0..2"),
        ("calm", {"rates": {"dance": 1.0}}, "dance"),
        ("calm", {"rates": {"nod": 1000.0}}, "nod"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(name, values, problem):
    with pytest.raises(RobotError, match=problem) as refused:
        Run().does(name, **values)
    assert "\n" not in str(refused.value)


def test_between_two_runs_only_the_next_one_is_chosen():
    run = Run()
    run.page.reach = None
    run.does("seed", seed=2)
    with pytest.raises(RobotError, match="halt: no run is on"):
        run.does("halt")


@pytest.mark.parametrize("name", NAMED_EXPRESSIONS)
def test_every_named_expression_is_a_face(name):
    assert set(NAMED_EXPRESSIONS[name]) <= set(CHANNELS)
    Puppet().show(NAMED_EXPRESSIONS[name], 1.0)
