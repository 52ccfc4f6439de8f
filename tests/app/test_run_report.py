"""A run always has its report: after a full disk, after an error, with a joint left out. Virtual time."""

import json
import resource
import subprocess
import sys
from contextlib import contextmanager

from sfms_robot.app.session import RunOptions, run
from sfms_robot.errors import ModelError
from sfms_robot.ports import Source

HEAD = "interbotix_wxxms"


def command(*words, limit_bytes=None):
    """The command line in a process of its own, which may write files of `limit_bytes` at most."""

    def limited():
        if limit_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))

    code = "from sfms_robot.cli.main import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, preexec_fn=limited)
    return done.returncode, done.stdout, done.stderr


def test_a_disk_that_is_full_costs_the_recording_and_neither_the_run_nor_its_report(tmp_path):
    code, out, err = command(
        "run", "--fast", "--json", "--head", HEAD, "--duration", "2", "--record", str(tmp_path / "run"),
        limit_bytes=100_000,
    )  # fmt: skip
    report = json.loads(out.splitlines()[-1])
    assert (code, report["exit"], report["frames"]) == (0, "done", 50)
    assert "too large" in report["recording"]["trouble"] and "the recording ends here" in err


def test_who_watches_a_run_sees_the_figures_of_its_report_as_they_grow():
    documents = []

    @contextmanager
    def panel(document, interrupt, halt, turn_all):
        documents.append(document())
        yield
        documents.append(document())

    report = run(RunOptions(head=HEAD, duration_s=1.0, fast=True), panel)
    before, after = documents
    assert (before["ticks"], before["frames"], before["state"]) == (0, 0, "starting")
    for key in ("head", "listener", "ticks", "frames", "tick", "latency_ms"):
        assert after[key] == report[key]
    assert set(after["motion"]) == set(report["motion"]) and after["duration_s"] == report["duration_s"]


class Broken(Source):
    """A source that breaks after a second."""

    duration_s = 2.0

    def read(self, now_s):
        if now_s > 1.0:
            raise ModelError("the cable was pulled")
        return []


def test_a_run_that_ends_by_an_error_has_its_report_and_says_why(tmp_path):
    options = RunOptions(head=HEAD, fast=True, record=tmp_path / "run")
    report = run(options, source=Broken(), signals=False)
    assert (report["exit"], report["error"], report["exit_code"]) == ("failed", "the cable was pulled", 5)
    assert report["ticks"] > 100 and report["limits"]["violations"] == 0
    assert json.loads((tmp_path / "run" / "report.json").read_text())["error"] == "the cable was pulled"


def test_an_error_that_nobody_expected_is_kept_too():
    class Bug(Broken):
        def read(self, now_s):
            return [][0] if now_s > 0.5 else []

    report = run(RunOptions(head=HEAD, fast=True), source=Bug(), signals=False)
    assert (report["exit"], report["exit_code"]) == ("failed", 1)


def test_a_recording_is_kept_unless_somebody_says_otherwise(tmp_path):
    words = ["run", "--fast", "--head", HEAD, "--duration", "1", "--record", str(tmp_path / "run")]
    assert command(*words)[0] == 0
    code, _, err = command(*words)
    assert code == 2 and "holds a recording already" in err
    assert command(*words, "--overwrite")[0] == 0
