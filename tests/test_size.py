"""The size of the project stays within `budget.toml`.

    python tests/test_size.py            print each figure beside its ceiling
    python tests/test_size.py --lower    lower every ceiling of the file to the figure of this checkout

Code tokens are names, operators, numbers and strings (an f-string is one), without comments, docstrings and the `name=`
of keyword arguments: longer lines, fewer comments and positional calls make nothing smaller.
"""

import ast
import io
import re
import sys
import tokenize
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BUDGET = ROOT / "budget.toml"
KINDS = {tokenize.NAME, tokenize.OP, tokenize.NUMBER, tokenize.STRING}
LONG_BODY = 60
LONG_BY_NATURE = {"run"}  # the option list of `sfms-robot run`


def docstring_of(node):
    first = node.body[0] if getattr(node, "body", None) else None
    text = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str)
    return first if text else None


def code_tokens(text, tree):
    """Return the number of code tokens of a file."""
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    docstrings = [docstring_of(node) for node in ast.walk(tree) if isinstance(node, documented)]
    skipped = {line for text in docstrings if text for line in range(text.lineno, text.end_lineno + 1)}
    f_string = {getattr(tokenize, "FSTRING_START", -1): 1, getattr(tokenize, "FSTRING_END", -1): -1}
    count, depth = 0, 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        depth += f_string.get(token.type, 0)
        whole = (token.type in KINDS and not depth) or (f_string.get(token.type) == 1 and depth == 1)
        count += whole and token.start[0] not in skipped
    keywords = (node.keywords for node in ast.walk(tree) if isinstance(node, ast.Call))
    return count - 2 * sum(keyword.arg is not None for found in keywords for keyword in found)


def body_lines(function):
    docstring = docstring_of(function)
    return function.end_lineno - (docstring.end_lineno if docstring else function.body[0].lineno - 1)


def imported_by(tree):
    """Yield the dotted names that a module imports at module level, and each name inside them."""
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def reach_of(start, trees):
    """Return the number of package files that a module loads, itself included."""
    found, todo = set(), [start]
    while todo:
        name = todo.pop()
        if name in trees and name not in found:
            found.add(name)
            todo += imported_by(trees[name])
    return len(found)


def measured():
    """Return the figures of this checkout, by the keys of budget.toml."""
    figures = dict.fromkeys(("robot_tokens", "robot_files", "lab_tokens", "lab_files", "positional_calls"), 0)
    lengths, bodies, trees = [], [], {}
    for file in sorted((ROOT / "sfms_robot").rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        tree = ast.parse(text)
        part = "lab" if file.relative_to(ROOT).parts[1] == "lab" else "robot"
        figures[f"{part}_tokens"] += code_tokens(text, tree)
        figures[f"{part}_files"] += 1
        lengths.append(text.count("\n"))
        trees[".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")] = tree
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name not in LONG_BY_NATURE:
                bodies.append(body_lines(node))
            elif isinstance(node, ast.Call) and len(node.args) >= 8:
                figures["positional_calls"] += ast.unparse(node.func).split(".")[-1][:1].isupper()
    tests = sorted((ROOT / "tests").rglob("*.py"))
    return figures | {
        "test_lines": sum(file.read_text(encoding="utf-8").count("\n") for file in tests),
        "longest_file": max(lengths),
        "longest_body": max(bodies),
        "short_files": sum(length <= LONG_BODY for length in lengths),
        "reach_of_session": reach_of("sfms_robot.app.session", trees),
    }


def ceilings():
    return tomllib.loads(BUDGET.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def figures():
    return measured()


@pytest.mark.parametrize("key", list(ceilings()))
def test_size_is_within_the_budget(figures, key):
    assert figures[key] <= ceilings()[key], f"{key}: shorten the code, or remove what it replaces"


def test_every_figure_has_a_ceiling(figures):
    assert set(figures) == set(ceilings())


def lower(figures):
    """Lower the ceilings in budget.toml to the figures; none is raised."""
    text = BUDGET.read_text(encoding="utf-8")
    for key, figure in figures.items():
        text = re.sub(
            rf"(?m)^{key} = (\d+)", lambda found, f=figure: f"{found[0].split()[0]} = {min(f, int(found[1]))}", text
        )
    BUDGET.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    now = measured()
    if "--lower" in sys.argv:
        lower(now)
    for key, ceiling in ceilings().items():
        sys.stdout.write(f"{key:18} {now[key]:8} of {ceiling}\n")
