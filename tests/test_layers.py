"""The dependency rule, read from the imports of every module."""

import ast
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import sfms_robot

PACKAGE = Path(sfms_robot.__file__).parent
BASE = {
    *("errors", "frames", "ports", "signals", "data", "config", "ranges", "endpoint", "network", "plugins"),
    "processes",
}
PEERS = {"sources", "listeners", "retarget", "motion", "servo", "face", "outputs", "runtime"}
ALLOWED = {
    **{layer: BASE | {layer} for layer in BASE | PEERS},
    "runtime": BASE | {"runtime", "motion", "retarget"},  # the loop calls both at every tick
    "outputs": BASE | {"outputs", "motion"},  # a machine that is moved passes the same limiter as joints
    "viewer": BASE | {"viewer", "face"},
    "emulator": BASE | {"emulator", "servo"},
    "app": BASE | PEERS | {"viewer", "emulator", "app"},
    "agents": {"agents", "errors", *sfms_robot.__all__},  # the public API, as any program
    "cli": {"app", "config", "errors", "data", "cli", "lab", "agents"},
    "lab": BASE | PEERS | {"viewer", "emulator", "app", "lab"},
}
SERVO_PARTS_FOR_THE_EMULATOR = {"codecs", "registers"}
SDK_FILES = {"servo/chain/sdk_packets.py", "lab/bench/bus_bench.py"}  # of Dynamixel's maker: one file, and its bench


@pytest.fixture(scope="module")
def trees():
    """Return the syntax tree of every module, by its path in the package."""
    return {
        str(file.relative_to(PACKAGE)): ast.parse(file.read_text(encoding="utf-8")) for file in PACKAGE.rglob("*.py")
    }


def imported(tree) -> set[str]:
    """Return the dotted names that a module imports anywhere."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import: {ast.unparse(node)}"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def own(tree) -> set[tuple[str, ...]]:
    """Return every `sfms_robot.x.y` that a module imports, as ("x", "y")."""
    return {tuple(name.split(".")[1:]) for name in imported(tree) if name.split(".")[0] == "sfms_robot"}


def layer_of(path: str) -> str:
    return path.split("/")[0].removesuffix(".py")


def test_modules_import_only_what_their_layer_may(trees):
    wrong = [
        f"{path} may not import {'.'.join(target)}"
        for path, tree in trees.items()
        for target in own(tree)
        if layer_of(path) != "__init__" and target and target[0] != "__version__"
        if target[0] not in ALLOWED[layer_of(path)]
        or (layer_of(path), target[0]) == ("emulator", "servo")
        and not set(target[1:2]) <= SERVO_PARTS_FOR_THE_EMULATOR
    ]
    assert wrong == []


def test_no_two_classes_share_a_name_and_no_two_modules_import_one_another(trees):
    names = Counter(node.name for tree in trees.values() for node in tree.body if isinstance(node, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []
    names = {path: tuple(path.removesuffix(".py").split("/")) for path in trees}
    parts = {name[:-1] if name[-1] == "__init__" else name: trees[path] for path, name in names.items()}
    known = {name: {target if target in parts else target[:-1] for target in own(tree)} for name, tree in parts.items()}
    assert [(a, b) for a in parts for b in known[a] - {a} if a in known.get(b, ())] == []


def test_the_vendors_sdk_is_known_to_one_file_and_the_bench_and_python_keeps_out_of_the_data_folders(trees):
    assert {
        path for path, tree in trees.items() if "dynamixel_sdk" in {name.split(".")[0] for name in imported(tree)}
    } == SDK_FILES
    for folder in ("configs", "firmware_maps", "sim"):
        assert not list((PACKAGE.parent / folder).rglob("*.py"))


def test_help_loads_neither_torch_nor_numpy_nor_a_serial_port():
    code = (
        "import sys; from sfms_robot.cli.main import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'numpy', 'scipy', 'serial', 'pydantic', 'vtkmodules'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
