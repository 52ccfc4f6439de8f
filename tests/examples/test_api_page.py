"""The code of docs/reference/api.md and the README does what it says."""

import re
from pathlib import Path

import pytest

import sfms_robot

ROOT = Path(__file__).parents[2]


def blocks(page):
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("number", range(5))
def test_a_block_of_the_page_runs(number):
    code = blocks("docs/reference/api.md")
    assert len(code) == 5
    exec(compile(code[number], f"docs/reference/api.md, block {number}", "exec"), {})


def test_the_readmes_program_runs():
    (code,) = blocks("README.md")
    exec(compile(code.replace("robot.wait(20)", "robot.wait(0.5)"), "README.md", "exec"), {})


def test_every_public_name_is_on_the_page():
    page = (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    assert [name for name in sfms_robot.__all__ if not re.search(rf"\b{name}\b", page) and name != "PacketError"] == []
