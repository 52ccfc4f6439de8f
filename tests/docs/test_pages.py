"""Links of the pages lead somewhere, commands can be typed as they stand, and every message is explained."""

import ast
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from sfms_robot.cli.main import _completed, app

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TYPED = [ROOT / "README.md", *sorted((ROOT / "docs" / "start").glob("*.md"))]
RUNS_LONG = ("demo", "run --audio browser", "--view")  # end by a person
ERRORS = {"PortError", "BusError", "ServoError", "ModelError", "TorqueError", "HaltedError"}  # exit codes 3, 4 and 5


def name_of(page):
    return str(page.relative_to(ROOT))


def anchors(page):
    """Return the anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title).lower()).replace(" ", "-")
        for title in titles
    }


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_leads_to_a_file_and_a_heading(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"", text):
        path, _, anchor = next(filter(None, target)).partition("#")
        if re.match(r"[a-z]+:", path):
            continue
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{name_of(page)}: {path}"
        assert not anchor or anchor in anchors(file), f"{name_of(page)}: {path}#{anchor}"


def commands(page):
    """Yield (line, hardware) for each line of the page's shell fences, `sfms-robot ...` without its folder."""
    for info, body in re.findall(
        r"^```sh([^\n]*)\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    ):
        for line in body.splitlines():
            words = line.split(" #")[0].strip()
            if words:
                yield re.sub(r"^\S*/sfms-robot", "sfms-robot", words), "hardware" in info


LINES = [(page, *found) for page in TYPED for found in commands(page)]
OURS = [line for line in LINES if line[1].startswith("sfms-robot ")]


def parse(words):
    """Parse a command without running it. Raises click's UsageError."""
    command, rest = typer.main.get_command(app), _completed(words)
    context = typer.Context(command)
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, rest)
    command.make_context(name, rest, parent=context)


@pytest.mark.parametrize("line", [line for _, line, _ in OURS], ids=str)
def test_every_command_of_the_first_pages_is_understood(line):
    parse(shlex.split(line)[1:])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the head of docs/start/own_head.md."""
    path = tmp_path_factory.mktemp("typed")
    page = (ROOT / "docs" / "start" / "own_head.md").read_text(encoding="utf-8")
    (path / "my_head").mkdir()
    (path / "my_head" / "head.yaml").write_text(re.search(r"```yaml\n(.*?)```", page, re.DOTALL)[1], encoding="utf-8")
    return path


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    "line", [line for _, line, hard in OURS if not hard and not any(each in line for each in RUNS_LONG)]
)
def test_every_command_without_hardware_succeeds(line, folder):
    program = [sys.executable, "-P", "-c", "from sfms_robot.cli.main import main; main()"]
    words = shlex.split(re.sub(r"--duration \d+", "--duration 3", line))[1:]  # as typed, but for less long
    done = subprocess.run([*program, *words], cwd=folder, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stderr


def literal(node):
    """Return the text of a string expression, with ... for what is filled in; "" where it is not literal."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "..." for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return literal(node.left) + literal(node.right)
    return ""


def messages():
    """Return the longest fixed part of each warning, and of each error that ends a run with exit code 3, 4 or 5."""
    found = {}
    for file in sorted((ROOT / "sfms_robot").rglob("*.py")):
        if "lab" in file.relative_to(ROOT).parts:
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not node.args:
                continue
            name = ast.unparse(node.func).split(".")
            logged = name[-1] in ("warning", "error") and "log" in name[0]
            if logged or name[-1] in ERRORS:
                parts = re.split(r"\.\.\.|%[.\d]*[a-z]|%%", literal(node.args[0]))
                fixed = max((part.strip(" :;,.()'") for part in parts), key=len)
                if len(fixed) >= 12:
                    found[fixed] = f"{file.relative_to(ROOT)}:{node.lineno}"
    return found


def test_every_warning_and_error_is_explained():
    page = (ROOT / "docs" / "start" / "troubleshooting.md").read_text(encoding="utf-8")
    assert {text: place for text, place in messages().items() if text not in page} == {}


SPEED = r"\d[\d.,]* (?:ms|us|ticks/s|ticks a second|plans a second|of a core|MB resident)\b"


def test_the_first_page_states_no_speed_that_the_measured_page_does_not():
    measured = (ROOT / "docs" / "science" / "performance.md").read_text(encoding="utf-8")
    said = re.findall(SPEED, (ROOT / "README.md").read_text(encoding="utf-8"))
    assert [each for each in said if each not in measured] == []
