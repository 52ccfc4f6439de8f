"""robot.txt is what a run needs: a bare environment of it, without torch, drives an emulated head."""

import json
import os
import subprocess
import sys
import tomllib
import venv
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
LEFT_OUT = {"torch", "scipy"}
MAIN = "from sfms_robot.cli.main import main; main()"


def requirements() -> list[Requirement]:
    lines = (ROOT / "robot.txt").read_text(encoding="utf-8").splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith("#")]


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WANTED = [Requirement(each) for each in PROJECT["dependencies"]]
EXTRAS = [Requirement(each) for extra in PROJECT["optional-dependencies"].values() for each in extra]


def test_it_is_what_the_package_depends_on_without_torch():
    assert sorted(map(str, requirements())) == sorted(str(each) for each in WANTED if each.name not in LEFT_OUT)


@pytest.mark.parametrize("one", [each for each in WANTED + EXTRAS if each.name != "sfms-robot"], ids=str)
def test_every_dependency_has_a_lower_bound_and_ends_at_a_major_version(one):
    bounds = {each.operator: each.version for each in one.specifier}
    if "==" in bounds or "<=" in bounds:  # one version, or the last before a change named beside it
        return
    assert set(bounds) == {">=", "<"} and bounds["<"].isdigit()
    assert Version(bounds[">="]).major < int(bounds["<"])


@pytest.mark.parametrize(
    ("neighbour", "needs"),
    [
        ("pipecat", ["soxr==1.0.0"]),
        ("lerobot", ["dynamixel-sdk==3.8.4"]),
        ("reachy-mini", ["numpy==2.2.5", "onnxruntime==1.27.0", "starlette==0.52.1", "websockets==15.0.1"]),
    ],
)
def test_versions_that_neighbours_need_are_in_the_ranges(neighbour, needs):
    ranges = {each.name: each.specifier for each in WANTED}
    for name, _, version in (each.partition("==") for each in needs):
        assert version in ranges[name], f"{neighbour}: {name}"


def installed(wanted: list[Requirement]) -> set[str]:
    """Names of these distributions and of all that they need here."""
    found: set[str] = set()
    waiting = [each for each in wanted if each.marker is None or each.marker.evaluate()]
    while waiting:
        one = waiting.pop()
        if one.name.lower() not in found:
            found.add(one.name.lower())
            needs = [Requirement(each) for each in distribution(one.name).requires or ()]
            waiting += [each for each in needs if each.marker is None or each.marker.evaluate({"extra": ""})]
    return found


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A new environment with robot.txt alone, its packages linked from here: nothing is downloaded."""
    folder = tmp_path_factory.mktemp("robot")
    venv.create(folder / "venv", symlinks=True)
    site = folder / "site"
    site.mkdir()
    for name in installed(requirements()):
        dist = distribution(name)
        for entry in {file.parts[0] for file in dist.files or () if file.parts[0] not in ("..", "__pycache__")}:
            if not (site / entry).exists():
                (site / entry).symlink_to(Path(str(dist.locate_file(entry))))
    environment = {"PYTHONPATH": os.pathsep.join([str(site), str(ROOT)]), "PYTHONDONTWRITEBYTECODE": "1"}
    return folder / "venv" / "bin" / "python", os.environ | environment


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="links and the emulator's terminal")
@pytest.mark.parametrize("how", [["--fast", "--listener", "arig-small"], []], ids=["fast", "real time"])
def test_an_environment_of_it_alone_drives_a_head(bare, how):
    python, environment = bare
    done = subprocess.run(
        [python, "-c", MAIN, "run", "--duration", "2", "--json", *how],
        env=environment, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["exit"] == "done" and report["listener_state"]["engine"].startswith("onnx")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="links")
def test_what_wants_torch_says_so_in_one_line(bare):
    python, environment = bare
    done = subprocess.run(
        [python, "-c", MAIN, "run", "--engine", "torch", "--fast", "--duration", "1"],
        env=environment, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 2 and "pip install torch" in done.stderr and "Traceback" not in done.stderr
