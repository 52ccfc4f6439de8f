"""`sfms-robot demo`: in virtual time, with a visitor, and on a computer without pseudo terminals."""

import json
import os
import subprocess
import sys
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from websockets.sync.client import connect

from sfms_robot.app.listen.demo import compare_seeds, demo, free_folder, next_speaker, nods_over_seeds
from sfms_robot.app.options import RunOptions, begin_page
from sfms_robot.errors import install_command

SHORT = RunOptions(head="op3_head", duration_s=1.0, fast=True)
ELSEWHERE = Path(__file__).parents[1] / "elsewhere"
WAIT_S = 60.0


@pytest.mark.slow
def test_the_demo_draws_what_it_saw(tmp_path, monkeypatch, command_line):
    pytest.importorskip("matplotlib")
    pytest.importorskip("vtkmodules")
    monkeypatch.chdir(tmp_path)
    ended = command_line("demo", "--fast", "--head", "op3_head", "--duration", 20, "--json")
    told = ended.told
    assert ended.code == 0 and told["exit"] == "done" and told["nods"] >= 1 and told["neck_travel_deg"] > 10
    assert told["pictures"] == ["runs/demo/run.png", "runs/demo/head.png"]
    assert all((tmp_path / png).stat().st_size > 10_000 for png in told["pictures"])
    assert (tmp_path / "runs" / "demo" / "run.mcap").is_file()


@pytest.mark.slow
@pytest.mark.realtime
def test_while_a_visitor_is_there_the_bundled_people_talk_one_after_the_other(tmp_path):
    seen = []

    def visit(url):
        with connect(url.replace("http", "ws", 1) + "ws") as page:
            while len(seen) < 3:
                told = json.loads(page.recv(timeout=WAIT_S))
                if told["type"] == "hello":
                    seen.append(told["speaker"])

    with closing(begin_page("0")) as page:
        page.wait()
        threading.Thread(target=visit, args=(page.url,), daemon=True).start()
        told = demo(replace(SHORT, fast=False), tmp_path / "demo", page=page)
    first, second, third = seen
    assert (second, third) == (next_speaker(first), next_speaker(second)) and first != second
    assert told["exit"] == "done" and told["pictures"] == []
    assert json.loads((tmp_path / "demo" / "report.json").read_text())["exit"] == "done"  # of the first


def elsewhere(folder, *words):
    """Run a command where `tests/elsewhere` is the computer; return the object that it prints."""
    done = subprocess.run(
        [sys.executable, "-c", "from sfms_robot.cli.main import main; main()", *words, "--json"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ELSEWHERE), str(Path(__file__).parents[2])])},
        cwd=folder, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_head_receives_the_same_bytes_over_tcp_as_over_a_pseudo_terminal(tmp_path, command_line):
    words = ("run", "--fast", "--duration", "1", "--head", "reachy_mini", "--audio", "katie")
    assert elsewhere(tmp_path, *words)["wire"] == command_line(*words, "--json").told["wire"]


def test_a_second_demo_writes_beside_the_first(tmp_path):
    first = tmp_path / "demo"
    for name in ("demo", "demo-2", "demo-3"):
        assert free_folder(first) == tmp_path / name
        (tmp_path / name).mkdir()


def test_seeds_are_told_one_by_one_with_the_mean_and_scatter_of_their_nods():
    seen = []
    told = compare_seeds(SHORT, 2, seen.append)
    assert [row["seed"] for row in seen] == [0, 1] and seen == told["runs"]
    assert (told["exit"], told["exit_code"]) == ("done", 0)
    assert told["nods"] == nods_over_seeds([row["nods"] for row in seen])
    assert nods_over_seeds([4, 0, 8, 4]) == {"mean": 4.0, "variance_over_mean": 2.67, "seeds_without": 1}
    assert nods_over_seeds([0, 0])["variance_over_mean"] is None is nods_over_seeds([3])["variance_over_mean"]


@pytest.mark.parametrize(
    ("package", "extra", "pictures"), [("matplotlib", "plots", []), ("vtkmodules", "pictures", ["run.png"])]
)
def test_without_a_package_of_pictures_the_run_is_kept_and_the_pip_install_named(
    package, extra, pictures, tmp_path, monkeypatch
):
    for module in (package, f"{package}.figure"):  # as if it were not installed
        monkeypatch.setitem(sys.modules, module, None)
    told = demo(SHORT, tmp_path / "demo")
    assert told["exit"] == "done" and (tmp_path / "demo" / "run.mcap").is_file()
    assert told["pictures"] == [str(tmp_path / "demo" / name) for name in pictures]
    assert told["missing"].count("\n") == 0 and told["missing"].endswith(install_command(extra))
