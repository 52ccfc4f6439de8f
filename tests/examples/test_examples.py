"""Every example runs as it stands, in a plain interpreter, and is short."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples"
RUNS = {
    "retarget.py": ([], "neck_yaw"),
    "own_listener.py": (["2"], "'nods':"),
    "own_source.py": (["1"], "25 frames heard"),
    "servos_alone.py": ([], "arrived: True"),
    "puppeteer.py": (["0.5"], "'blinks':"),
    "voice_agent.py": (["1.5"], "frames heard"),
    "json_avatar.py": (["2"], "avatar.png: 2 faces"),
}


def test_every_example_is_tried_and_under_forty_lines():
    assert {path.name for path in FOLDER.glob("*.py")} == {*RUNS, "assistant_loop.py"}  # that one: test_live_page
    for path in FOLDER.glob("*.py"):
        assert len(path.read_text(encoding="utf-8").splitlines()) < 40, path.name


SLOW = ("json_avatar.py", "own_source.py", "puppeteer.py", "servos_alone.py", "voice_agent.py")


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in RUNS])
def test_an_example_runs(name, tmp_path):
    arguments, said = RUNS[name]
    here = {**os.environ, "XDG_CONFIG_HOME": str(tmp_path), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-W", "error", str(FOLDER / name), *arguments],
        capture_output=True, text=True, check=False, cwd=tmp_path, env=here, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert said in done.stdout
    assert "Traceback" not in done.stderr, done.stderr


def test_the_app_of_reachy_mini_is_what_its_assistant_looks_for():
    app = FOLDER / "reachy_mini_app"
    project = tomllib.loads((app / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["entry-points"]["reachy_mini_apps"] == {project["name"]: "sfms_listener.main:SfmsListener"}
    source = (app / "sfms_listener" / "main.py").read_text(encoding="utf-8")
    assert "class SfmsListener(ReachyMiniApp)" in source and len(source.splitlines()) < 45
    readme = (app / "README.md").read_text(encoding="utf-8")
    assert readme.startswith("---\ntitle: ") and " - reachy_mini\n - reachy_mini_python_app\n" in readme
    assert {"index.html", "style.css"} <= {path.name for path in app.iterdir()}
