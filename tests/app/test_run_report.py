"""A run always has its report: after a full disk, after an error, with a joint left out. Virtual time."""

import json
import resource
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import pytest

from sfms_robot.app.head.pose import NobodyThere
from sfms_robot.app.open_head import open_head, run_log
from sfms_robot.app.options import HeadOptions, RunOptions
from sfms_robot.app.session import drive_head, run, run_parts
from sfms_robot.errors import BusError, ConfigError, ModelError, PortError
from sfms_robot.ports import Source
from sfms_robot.runtime.safety import Interrupt, Released

HEAD = "interbotix_wxxms"


def test_a_disk_that_is_full_costs_the_recording_and_neither_the_run_nor_its_report(tmp_path):
    words = ["run", "--fast", "--json", "--head", HEAD, "--duration", "2", "--record", str(tmp_path / "run")]
    code = "from sfms_robot.cli.main import main; main()"
    full = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (100_000, 100_000))
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, preexec_fn=full)
    report = json.loads(done.stdout.splitlines()[-1])
    assert (done.returncode, report["exit"], report["frames"]) == (0, "done", 50)
    assert report["recording"]["trouble"] == f"--record {tmp_path / 'run'}: File too large"
    assert "the recording ends here" in done.stderr


def test_who_watches_a_run_sees_the_figures_of_its_report_as_they_grow():
    documents = []

    @contextmanager
    def panel(controls):
        documents.append(controls.document())
        yield
        documents.append(controls.document())

    report = run(RunOptions(head=HEAD, duration_s=1.0, fast=True), panel)
    before, after = documents
    assert (before["ticks"], before["frames"], before["state"]) == (0, 0, "starting")
    for key in ("head", "listener", "ticks", "frames", "tick", "latency_ms"):
        assert after[key] == report[key]
    assert set(after["motion"]) == set(report["motion"]) and after["duration_s"] == report["duration_s"]
    assert (after["state"], after["torque_unconfirmed"], report["torque_unconfirmed"]) == ("stopped", [], [])


@pytest.mark.parametrize(("error", "code"), [(ModelError("the cable was pulled"), 5), (IndexError("a bug"), 1)])
def test_a_run_that_ends_by_an_error_has_its_report_and_says_why(error, code, tmp_path):
    class Broken(Source):
        """A source that breaks after a second."""

        duration_s = 2.0

        def read(self, now_s):
            if now_s > 1.0:
                raise error
            return []

    report = run(RunOptions(head=HEAD, fast=True, record=tmp_path / "run"), source=Broken(), signals=False)
    assert (report["exit"], report["error"], report["exit_code"]) == ("failed", str(error), code)
    assert report["ticks"] > 100 and report["limits"]["violations"] == 0
    assert json.loads((tmp_path / "run" / "report.json").read_text())["error"] == str(error)


class Ending(NobodyThere):
    """A person with whom a run ends after 0.2 s: by so many requests, by an error, or with the duration (0)."""

    def __init__(self, how, interrupt):
        self.how, self.interrupt = how, interrupt

    def read(self, now_s):
        if now_s > 0.2 and isinstance(self.how, Exception):
            raise self.how
        if now_s > 0.2 and not self.interrupt():
            for _ in range(self.how):
                self.interrupt.ask()
        return ()


def drive(how=0, fault=None, bus=lambda bus: bus):
    """The report and log of a drive of 0.4 s, and if each servo has torque after it. `fault`: from torque on."""
    interrupt = Interrupt()
    with open_head(HeadOptions(head=HEAD, fast=True)) as opened:
        chain = opened.opened["main"]
        if fault is not None:
            chain.inject(f"{fault}@{opened.clock.now_s() + 0.2}-1000")
        there = replace(opened, bus=bus(opened.bus))
        parts, log = run_parts(there, Ending(how, interrupt), NobodyThere()), run_log(there.config, there.rate_hz)
        report = drive_head(there, parts, interrupt, duration_s=0.4, log=log)
        return report, log, [chain.state(joint.id)["torque"] for joint in opened.config.joints.values()]


@pytest.mark.parametrize("fault", [None, "silent", "silent:2"])
@pytest.mark.parametrize(
    ("how", "code"),
    [
        (0, 0),
        (1, 130),
        (2, 130),
        (ZeroDivisionError("by zero"), 1),
        (ConfigError("a flag"), 2),
        (PortError("a port"), 3),
        (BusError("a bus"), 4),
        (ModelError("weights"), 5),
    ],
    ids=str,
)
def test_torque_that_is_not_confirmed_off_overrides_success_and_interruption_and_no_error(how, code, fault):
    report, log, torques = drive(how, fault)
    named = {None: [], "silent": ["pan", "tilt"], "silent:2": ["tilt"]}[fault]
    assert report["torque_unconfirmed"] == log.torque_unconfirmed == named
    assert torques == [joint in named for joint in ("pan", "tilt")]
    own = code in (0, 130)
    assert report["exit_code"] == (4 if named and own else code)
    assert log.states[-1][1].name == ("fault" if named or not own else "stopped")
    if named and own:
        told = (
            f"torque of {', '.join(named)} could not be confirmed off: run sfms-robot servo release or switch off "
            "the supply before you touch it"
        )
        assert (report["exit"], report["error"]) == ("failed", told)


class CutShort:
    """A bus whose first `stop` is cut short by a second Ctrl-C, before anything is sent."""

    def __init__(self, bus):
        self._bus, self.cut = bus, False

    def __getattr__(self, name):
        return getattr(self._bus, name)

    def stop(self, policy):
        if not self.cut:
            self.cut = True
            raise Released
        self._bus.stop(policy)


@pytest.mark.parametrize(("fault", "code"), [(None, 130), ("silent", 4)])
def test_a_second_interrupt_in_the_middle_of_stop_does_not_skip_the_confirmation(fault, code):
    report, _, torques = drive(1, fault, CutShort)
    assert (report["exit_code"], any(torques)) == (code, fault is not None)
