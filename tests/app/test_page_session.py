"""A page and the runs behind it, in real time on emulated servos; and flags that cannot be, refused at once."""

import shutil
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from sfms_robot.app.listen.knobs import RunControls
from sfms_robot.app.listen.page_session import LEFT_S, EndsAlone, PageSession, page_session
from sfms_robot.app.options import RunOptions, begin_page
from sfms_robot.config import load_head
from sfms_robot.data import data_dir
from sfms_robot.errors import RobotError
from sfms_robot.frames import CHANNEL_INDEX
from sfms_robot.runtime.safety import Interrupt


def test_a_run_that_a_visitor_has_left_is_asked_to_end():
    page, interrupt = SimpleNamespace(visitors=1), Interrupt()
    alone = EndsAlone(page=page, interrupt=interrupt, left_s=LEFT_S)
    alone.tick(SimpleNamespace(time_s=40.0))
    page.visitors = 0
    alone.tick(SimpleNamespace(time_s=40.0 + LEFT_S))
    assert not interrupt() and not alone.ended
    alone.tick(SimpleNamespace(time_s=40.1 + LEFT_S))
    assert interrupt() and alone.ended


@pytest.mark.slow
def test_a_run_leaves_a_mesh_out_that_may_not_be_served_and_names_it_once(tmp_path, caplog, capfd):
    head = tmp_path / "op3_head"
    shutil.copytree(data_dir("configs") / "heads" / "op3_head", head)
    shapes = '<mesh filename="/etc/passwd"/>', '<capsule radius="1" length="1"/>', ""
    mesh = "".join(f"<visual><geometry>{shape}</geometry></visual>" for shape in shapes) + "</link>"
    robot = (data_dir("sim") / "heads" / "op3_head" / "robot.urdf").read_text()
    (head / "robot.urdf").write_text(robot.replace("</link>", mesh, 1))
    with (head / "head.yaml").open("a") as file:
        file.write("\nurdf: robot.urdf\n")
    options = RunOptions(head=str(head), audio="none", duration_s=0.5, packages=(str(tmp_path / "parts"),))
    with closing(begin_page("0")) as page, page_session(page, options) as pages:
        assert pages.run()["exit"] == "done"
    odd, empty, line = [record.message for record in caplog.records if "robot.urdf: link" in record.message]
    assert "<capsule>, not box" in odd and "without a geometry: not drawn" in empty
    assert line.startswith(f"picture of the head: {head}/robot.urdf: link ")
    assert line.endswith("got '/etc/passwd': not drawn")
    assert "/etc/passwd" not in capfd.readouterr().err


class Run:
    """What a page reaches of a run, what it was asked for, and the session behind the page."""

    def __init__(self, choices=True):
        self.asked = []
        page = SimpleNamespace(answered_by=lambda asked: None)
        self.session = PageSession(page, RunOptions(), None, choices)
        self.session.reach = self.reach = RunControls(load_head("face28"), RunOptions())
        self.session.recorder = SimpleNamespace(record=lambda on: self.asked.append(("record", on)))
        self.reach.set_rates = self.asked.append

    def does(self, command, **values):
        self.session.command(1, command, values)

    def face(self, time_s):
        """(58,) of a listener that asks for nothing."""
        return self.reach.puppet.overlay(np.zeros((1, 58), np.float32), np.array([time_s]))[0]


def test_the_page_ends_its_own_halt_but_not_one_of_the_device_and_its_visitor_is_answered():
    run = Run()
    run.does("halt")
    assert run.reach.halt.by == "page"
    run.does("resume")
    assert run.reach.halt.by is None
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
    assert run.face(1.5)[CHANNEL_INDEX["mouthSmileLeft"]] == pytest.approx(0.9)
    run.does("neutral", seconds=1.0)
    run.face(1.51)
    assert not run.face(2.2).any()


def test_knobs_and_rates_are_turned_and_the_rest_is_handed_on():
    run = Run()
    run.does("knobs", intensity={"neck": 0.5}, style={"jaw": 2.0})
    assert run.reach.knobs["neck"].intensity == 0.5 and run.reach.knobs["jaw"].style == 2.0
    run.does("calm", rates={"nod": 5.0, "smile": None})
    run.does("calm", rates={"blink": 3.0})
    assert (run.asked[-1].nod, run.asked[-1].blink, run.asked[-1].smile) == (5.0, 3.0, None)
    run.does("record", on=True)
    run.does("release")
    assert run.asked[2:] == [("record", True)] and run.reach.interrupt() and run.session.released


def test_a_visitor_chooses_the_next_run_and_brings_a_person():
    run = Run()
    run.session.reach = None
    with pytest.raises(RobotError, match="halt: no run is on"):
        run.does("halt")
    run.does("seed", seed=3)
    run.does("listener", name="arig-small")
    run.does("source", feeds=["voice"])
    assert run.session.next(stay=False)
    options = run.session.options
    assert (options.seed, options.listener, options.audio, options.face) == (3, "arig-small", "browser", "browser")
    kept = Run(choices=False)
    for command, values in (("seed", {"seed": 3}), ("source", {"feeds": ["voice"]})):
        with pytest.raises(RobotError, match=f"^{command}: this run "):
            kept.does(command, **values)


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
        ("listener", {"name": "/etc"}, "listener '/etc' is not there .sfms-small"),
        ("speaker", {"name": "/etc/passwd"}, "speaker '/etc/passwd' is not there"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(name, values, problem):
    with pytest.raises(RobotError, match=problem) as refused:
        Run().does(name, **values)
    assert "\n" not in str(refused.value)
