"""The base installation, without torch, drives an emulated head; each command starts in it or names its extra."""

import json
import os
import subprocess
import sys
import tomllib
import venv
from functools import partial
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version
from pins import COMMANDS, golden, key_paths, write_inputs

from sfms_robot.errors import install_command

ROOT = Path(__file__).parents[2]
MAIN = "from sfms_robot.cli.main import main; main()"


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WANTED = [Requirement(each) for each in PROJECT["dependencies"]]
EXTRAS = [Requirement(each) for extra in PROJECT["optional-dependencies"].values() for each in extra]


@pytest.mark.parametrize("one", [each for each in WANTED + EXTRAS if each.name != "sfms-robot"], ids=str)
def test_every_dependency_has_a_lower_bound_and_ends_at_a_major_version(one):
    bounds = {each.operator: each.version for each in one.specifier}
    if "==" in bounds or "<=" in bounds:  # one version, or the last before a change named beside it
        return
    assert set(bounds) == {">=", "<"} and bounds["<"].isdigit() and Version(bounds[">="]).major < int(bounds["<"])


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
    """A new environment with the base dependencies, linked from here: nothing is downloaded."""
    folder = tmp_path_factory.mktemp("robot")
    venv.create(folder / "venv", symlinks=True)
    site = folder / "site"
    site.mkdir()
    for name in installed(WANTED):
        dist = distribution(name)
        for entry in {file.parts[0] for file in dist.files or () if file.parts[0] not in ("..", "__pycache__")}:
            if not (site / entry).exists():
                (site / entry).symlink_to(Path(str(dist.locate_file(entry))))
    environment = {"PYTHONPATH": os.pathsep.join([str(site), str(ROOT)]), "PYTHONDONTWRITEBYTECODE": "1"}
    return folder / "venv" / "bin" / "python", os.environ | environment


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="links and the emulator's terminal")
@pytest.mark.parametrize("how", [["--fast", "--listener", "arig-small"], []], ids=["fast", "real time"])
def test_base_installation_drives_a_head(bare, how):
    python, environment = bare
    done = subprocess.run(
        [python, "-c", MAIN, "run", "--duration", "2", "--json", *how],
        env=environment, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["exit"] == "done" and report["listener_state"]["engine"].startswith("onnx")


def test_the_command_that_adds_an_extra_can_be_typed_in_the_present_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))  # another pip, or none: that of this Python is named
    for folder, checkout in ((ROOT, "."), (tmp_path, ROOT)):
        monkeypatch.chdir(folder)
        python, said = install_command("plots").split(" -m ")
        assert said == f"pip install -e '{checkout}[plots]'" and Path(folder, python) == Path(sys.executable)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.skipif(sys.platform == "win32", reason="links")
def test_the_demo_of_a_wheel_runs_in_an_empty_folder_and_says_what_draws_its_plot(bare, tmp_path):
    pytest.importorskip("hatchling")
    here, python = tmp_path / "here", tmp_path / "venv" / "bin" / "python"
    here.mkdir()
    venv.create(tmp_path / "venv", symlinks=True)
    environment = {**bare[1], "PYTHONPATH": bare[1]["PYTHONPATH"].split(os.pathsep)[0]}  # without the checkout
    done = partial(subprocess.run, capture_output=True, text=True, check=False, timeout=120)
    built = done([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path], cwd=ROOT)
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel]
    put = done(pip)
    assert put.returncode == 0, put.stderr
    shown = done([python.with_name("sfms-robot"), *"demo --duration 2 --view 0".split()], cwd=here, env=environment)
    assert shown.returncode == 0, shown.stderr
    assert "face28 listened for 2.0 s" in shown.stdout and (here / "runs" / "demo" / "run.mcap").is_file()
    assert shown.stderr.splitlines()[-1].endswith(f"{python} -m pip install 'sfms-robot[plots]'")


# Commands up to the first use of an optional package, with the package that each names where it is missing.
NEEDS = {
    "run --engine torch --fast --duration 1": "torch",
    "export sfms-small": "torch",
    "train tokenizer --config configs/training/sfms-small.yaml --data {tmp} --out {tmp}/out": "torch",
    "train listener --config configs/training/sfms-small.yaml --data {tmp} --out {tmp}/out": "torch",
    "bench listener": "torch",
    "replay {tmp}/run --plot {tmp}/run.png": "matplotlib",
    "replay {tmp}/run --sheet {tmp}/head.png": "vtkmodules",
    "head show face28 --urdf {tmp}/head.png": "vtkmodules",
    "run --listener zenoh/arig-small --duration 1": "zenoh",
    "run --face webcam --fast --duration 1": "mediapipe",
    "mcp": "mcp",
}


@pytest.fixture(scope="module")
def folder(bare, tmp_path_factory):
    """A folder with what the commands read, and the recording of a run."""
    path = tmp_path_factory.mktemp("base")
    write_inputs(path)
    start(bare, f"run --fast --duration 1 --record {path}/run")
    return path


def start(bare, words: str) -> subprocess.CompletedProcess[str]:
    python, environment = bare
    return subprocess.run(
        [python, "-c", MAIN, *words.split()],
        env=environment, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="links")
@pytest.mark.parametrize(("words", "package"), NEEDS.items())
def test_what_needs_an_extra_names_it_in_one_line(bare, folder, words, package):
    done = start(bare, words.format(tmp=folder))
    (line,) = done.stderr.splitlines()[-1:]
    assert done.returncode == 2 and f"needs {package}, which is not installed: " in line and " install -e " in line
    assert "Traceback" not in done.stderr


EACH = """
import sys
from sfms_robot.cli.main import main
for words in sys.argv[1:]:
    try: main([*words.split(), "--json"])
    except SystemExit: print("ENDED")
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="links")
def test_every_other_command_prints_the_keys_that_it_printed(bare, tmp_path):
    write_inputs(tmp_path)
    python, environment = bare
    typed = [words.format(tmp=tmp_path) for words in COMMANDS]
    done = subprocess.run([python, "-c", EACH, *typed], env=environment, capture_output=True, text=True, timeout=600)
    told = [each.splitlines()[-1] for each in done.stdout.split("ENDED\n")[:-1]]
    assert "Traceback" not in done.stderr and "not installed" not in done.stderr and len(told) == len(COMMANDS), done
    for words, now in zip(COMMANDS, told, strict=True):
        lacks = set(golden("keys")[words]) - {path.lstrip(".") for path in key_paths(json.loads(now))}
        assert lacks <= {"pictures[]"}, words  # of the demo, with [plots]
