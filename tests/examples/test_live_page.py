"""What docs/guide/live.md says of voice agents works as typed, and nothing more is kept than it says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-P", "-c", "from sfms_robot.cli.main import main; main()"]


def section(title):
    page = (ROOT / "docs" / "guide" / "live.md").read_text(encoding="utf-8")
    return page.split(f"\n## {title}\n")[1].split("\n## ")[0]


def blocks(text, language=""):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


@pytest.fixture
def here(tmp_path):
    """Every folder that a program might write to."""
    paths = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    folders = {name: str(tmp_path / name) for name in ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME")}
    return {**os.environ, **folders, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}


@pytest.mark.slow
def test_an_assistant_joins_as_typed(here, tmp_path):
    robot, assistant = (line.split("#")[0].split() for line in blocks(section("Voice agents"))[0].splitlines())
    assert (robot[0], assistant) == ("sfms-robot", ["python", "examples/assistant_loop.py"])
    (lines,) = blocks(section("Voice agents"), "python")
    assert len([line for line in lines.splitlines() if line]) == 5
    with subprocess.Popen([*COMMAND, *robot[1:]], cwd=tmp_path, env=here, stderr=subprocess.PIPE, text=True) as running:
        assert "tcp://127.0.0.1:8765" in running.stderr.readline()
        program = subprocess.run([sys.executable, "-c", lines], env=here, capture_output=True, text=True, timeout=60)
        assert '"welcome"' in program.stdout and not program.stderr, program
        joined = subprocess.run(
            [sys.executable, str(ROOT / assistant[1])], env=here, capture_output=True, text=True, timeout=60
        )
        assert joined.returncode == 0, joined.stderr
        rest = running.stderr.read()
        assert running.wait(60) == 0, rest
    states = [line for line in joined.stdout.split() if line in ("listening", "speaking")]
    assert "listening speaking listening" in " ".join(states), joined.stdout


def test_nothing_is_kept_without_record_and_with_it_what_the_page_says(here, tmp_path):
    work = tmp_path / "work"
    work.mkdir()
    run = [*COMMAND, "run", "--head", "interbotix_wxxms", "--fast", "--duration", "1"]
    for more in ([], ["--record", "kept"]):
        done = subprocess.run([*run, *more], cwd=work, env=here, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        files = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
        assert files == ({"work/kept/run.mcap", "work/kept/report.json"} if more else set())
    text = section("What is kept where")
    with (work / "kept" / "run.mcap").open("rb") as file:
        topics = {channel.topic for channel in make_reader(file).get_summary().channels.values()}
    assert topics == set(re.findall(r"`(/\w+)`", text)) and "`DIR/run.mcap`" in text and "`DIR/report.json`" in text
