"""A page and the runs behind it, in real time on emulated servos; and flags that cannot be, refused at once."""

import json
import shutil
import threading
from contextlib import closing
from types import SimpleNamespace

import pytest
from websockets.sync.client import connect

from sfms_robot.app.listen.page_session import LEFT_S, EndsAlone, page_session
from sfms_robot.app.options import RunOptions, begin_page
from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.config import Calmness
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.runtime.safety import Interrupt

WAIT_S = 60.0


class Visit(threading.Thread):
    """Somebody who looks at a page, and does something at a kind of message: `plan` is (what is seen, what is said)."""

    def __init__(self, url, plan):
        super().__init__(daemon=True)
        self.url, self.plan = url, list(plan)
        self.seen = []

    def run(self):
        with connect(self.url.replace("http", "ws", 1) + "ws") as page:
            while self.plan:
                told = json.loads(page.recv(timeout=WAIT_S))
                self.seen.append(told)
                if self.plan[0][0](told):
                    says = self.plan.pop(0)[1]
                    if says is not None:
                        page.send(json.dumps(says))


def at(time_s, state=None):
    return lambda told: told["type"] == "frame" and told["t"] >= time_s and told["s"] == (state or told["s"])


def kind(name):
    return lambda told: told["type"] == name


def test_a_run_that_a_visitor_has_left_is_asked_to_end():
    page, interrupt = SimpleNamespace(visitors=1), Interrupt()
    alone = EndsAlone(page, interrupt)
    alone.tick(SimpleNamespace(time_s=40.0))
    page.visitors = 0
    alone.tick(SimpleNamespace(time_s=40.0 + LEFT_S))
    assert not interrupt() and not alone.ended
    alone.tick(SimpleNamespace(time_s=40.1 + LEFT_S))
    assert interrupt() and alone.ended


@pytest.mark.slow
def test_a_visitor_moves_halts_records_and_chooses_the_next_run():
    options = RunOptions(head="op3_head", duration_s=8.0, seed=1, calmness=Calmness(smile=0.5))
    plan = [
        (at(1.5), {"type": "record", "on": True}),
        (at(1.6), {"type": "show", "channels": {"yaw": 0.4}, "seconds": 1.0}),
        (lambda told: told["type"] == "frame" and told["j"][0] > 0.2, {"type": "halt"}),
        (at(0.0, "halted"), {"type": "resume"}),
        (at(0.0, "starting"), {"type": "record", "on": False}),
        (lambda told: told["type"] == "record" and told["seconds"], {"type": "knobs", "intensity": {"neck": 0.5}}),
        (at(0.0), {"type": "calm", "rates": {"nod": 4.0}}),
        (at(0.0), {"type": "seed", "seed": 7}),
        (lambda told: told["type"] == "hello" and told["seed"] == 7, {"type": "listener", "name": "nobody"}),
        (kind("error"), None),
        (at(1.0), {"type": "release"}),
        (kind("over"), None),
    ]
    page = begin_page("0")
    with closing(page), page_session(page, options, choices=True) as pages:
        visit = Visit(page.url, plan)
        visit.start()
        first = pages.run()
        assert first["exit"] == "interrupted" and pages.next(stay=True)
        second = pages.run()
        visit.join(WAIT_S)
        assert not visit.plan, f"waits for {visit.plan[0]}"
        assert second["seed"] == 7 and pages.released and not pages.next(stay=True)  # nobody looks any more
        assert "halted" in [change["state"] for change in first["states"]["changes"]]
        assert first["observers_detached"] == second["observers_detached"] == {}
        assert first["page"] == second["page"] == {"hung": False, "hangs": 0}
        assert (pages._folder / "recording-1" / "run.mcap").stat().st_size > 1000
        about = read_recording(pages._folder / "recording-1").about
        assert json.loads(about["options"])["calmness"]["smile"] == 0.5
    hello = next(told for told in visit.seen if told["type"] == "hello" and told["seed"] == 7)
    assert hello["intensity"]["neck"] == 0.5 and hello["calmness"]["nod"] == 4.0  # what was turned stays turned
    errors = [told["error"] for told in visit.seen if told["type"] == "error"]
    assert len(errors) == 1 and "nobody" in errors[0]


@pytest.mark.slow
def test_a_run_leaves_a_mesh_out_that_may_not_be_served_and_names_it_once(tmp_path, caplog, capfd):
    head = tmp_path / "op3_head"
    shutil.copytree(data_dir("configs") / "heads" / "op3_head", head)
    mesh = '<visual><geometry><mesh filename="/etc/passwd"/></geometry></visual></link>'
    robot = (data_dir("sim") / "heads" / "op3_head" / "robot.urdf").read_text()
    (head / "robot.urdf").write_text(robot.replace("</link>", mesh, 1))
    with (head / "head.yaml").open("a") as file:
        file.write("\nurdf: robot.urdf\n")
    options = RunOptions(head=str(head), audio="none", duration_s=0.5, packages=(str(tmp_path / "parts"),))
    with closing(begin_page("0")) as page, page_session(page, options) as pages:
        assert pages.run()["exit"] == "done"
    (line,) = [record.message for record in caplog.records if "/etc/passwd" in record.message]
    assert line.startswith(f"{head}/robot.urdf: link ") and line.endswith("the page leaves it out")
    assert "/etc/passwd" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--fast", "--view"], "--view auto: a page shows what takes real time"),
        (["--dry-run", "--view", "9000"], "--view 9000: nothing moves in a --dry-run"),
        (["--view", "nowhere"], "--view nowhere: not a TCP port"),
        (["--view-cert", "a.pem"], "no page is served"),
        (["--view", "--view-cert", "a.pem"], "https needs both"),
        (["--fast", "--audio", "browser"], "a page shows what takes real time"),
    ],
)
def test_a_page_that_cannot_be_is_refused_in_one_line(command_line, words, problem):
    ended = command_line("run", "--duration", 1, *words)
    assert ended.code == ConfigError.exit_code and problem in ended.err
