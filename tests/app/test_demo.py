"""`sfms-robot demo` in virtual time."""

import sys

import pytest

from sfms_robot.app.listen.demo import compare_seeds, demo, free_folder, nods_over_seeds
from sfms_robot.app.options import RunOptions

SHORT = RunOptions(head="op3_head", duration_s=1.0, fast=True)


@pytest.mark.slow
def test_the_demo_draws_what_it_saw(tmp_path, monkeypatch, command_line):
    pytest.importorskip("matplotlib")
    pytest.importorskip("vtkmodules")
    monkeypatch.chdir(tmp_path)
    ended = command_line("demo", "--fast", "--head", "op3_head", "--duration", 20, "--json")
    told = ended.told
    assert ended.code == 0 and told["exit"] == "done" and told["nods"] >= 1 and told["neck_travel_deg"] > 10
    assert told["pictures"] == ["sfms-demo/run.png", "sfms-demo/head.png"]
    assert all((tmp_path / png).stat().st_size > 10_000 for png in told["pictures"])
    assert (tmp_path / "sfms-demo" / "run.mcap").is_file()


@pytest.mark.slow
def test_a_recording_of_an_earlier_demo_is_replaced_only_when_told(tmp_path, command_line):
    words = ("demo", "--fast", "--head", "op3_head", "--duration", 1, "--json", "--out", tmp_path / "shown")
    assert command_line(*words).code == 0
    before = (tmp_path / "shown" / "run.mcap").read_bytes()
    again = command_line(*words, "--seed", 2)
    assert again.code == 2 and "holds a recording already" in again.err and "--overwrite" in again.err
    assert (tmp_path / "shown" / "run.mcap").read_bytes() == before
    assert command_line(*words, "--seed", 2, "--overwrite").code == 0
    assert (tmp_path / "shown" / "run.mcap").read_bytes() != before


def test_a_second_demo_writes_beside_the_first(tmp_path):
    first = tmp_path / "sfms-demo"
    for name in ("sfms-demo", "sfms-demo-2", "sfms-demo-3"):
        assert free_folder(first) == tmp_path / name
        (tmp_path / name).mkdir()


def test_seeds_are_told_one_by_one():
    seen = []
    told = compare_seeds(SHORT, 2, seen.append)
    assert [row["seed"] for row in seen] == [0, 1] and seen == told["runs"]
    assert (told["exit"], told["exit_code"]) == ("done", 0)
    assert told["nods"] == nods_over_seeds([row["nods"] for row in seen])


def test_nods_of_several_seeds_have_a_mean_a_scatter_and_those_without():
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
    assert told["missing"].count("\n") == 0 and f"pip install 'sfms-robot[{extra}]'" in told["missing"]
