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
    "errors",
    "frames",
    "ports",
    "signals",
    "data",
    "config",
    "ranges",
    "endpoint",
    "network",
    "plugins",
    "processes",
}
PEERS = {"sources", "listeners", "retarget", "motion", "servo", "face", "runtime"}
ALLOWED = {
    **{layer: BASE | {layer} for layer in BASE | PEERS},
    "runtime": BASE | {"runtime", "motion", "retarget"},  # the loop calls both at every tick
    "viewer": BASE | {"viewer", "face"},
    "emulator": BASE | {"emulator", "servo"},
    "app": BASE | PEERS | {"viewer", "emulator", "app"},
    "cli": {"app", "config", "errors", "data", "cli", "lab"},
    "lab": BASE | PEERS | {"viewer", "emulator", "app", "lab"},
}
SERVO_PARTS_FOR_THE_EMULATOR = {"codecs", "registers"}

MODULES = sorted(PACKAGE.rglob("*.py"))


def imports_of(module: Path) -> set[tuple[str, ...]]:
    """Every `sfms_robot.x.y` that a module imports, as ("x", "y")."""
    found: set[tuple[str, ...]] = set()
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        found |= {tuple(name.split(".")[1:]) for name in names if name.split(".")[0] == "sfms_robot"}
    return found


def layer_of(module: Path) -> str:
    return module.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("module", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_module_imports_only_what_its_layer_may(module: Path) -> None:
    layer = layer_of(module)
    if layer == "__init__":
        return
    for target in imports_of(module):
        if not target or target[0] == "__version__":
            continue
        assert target[0] in ALLOWED[layer], f"{layer} may not import {'.'.join(target)}"
        if layer == "emulator" and target[0] == "servo":
            assert set(target[1:2]) <= SERVO_PARTS_FOR_THE_EMULATOR, f"emulator may not import {'.'.join(target)}"


def test_no_two_classes_share_a_name() -> None:
    trees = [ast.parse(module.read_text(encoding="utf-8")) for module in MODULES]
    names = Counter(node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef))
    assert not [name for name, count in names.items() if count > 1]


def test_every_layer_has_a_rule() -> None:
    assert {layer_of(module) for module in MODULES} - {"__init__"} <= set(ALLOWED)


def test_help_loads_neither_torch_nor_numpy_nor_a_serial_port() -> None:
    code = (
        "import sys; from sfms_robot.cli.main import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'numpy', 'scipy', 'serial', 'pydantic', 'vtkmodules'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_python_keeps_out_of_the_data_folders() -> None:
    root = PACKAGE.parent
    for folder in ("configs", "firmware_maps", "sim"):
        assert not list((root / folder).rglob("*.py"))


def test_no_two_modules_import_one_another() -> None:
    paths = {path.relative_to(PACKAGE).with_suffix("").parts: path for path in MODULES}
    modules = {parts[:-1] if parts[-1] == "__init__" else parts: path for parts, path in paths.items()}
    imported = {
        name: {target if target in modules else target[:-1] for target in imports_of(path)}
        for name, path in modules.items()
    }
    assert not [(a, b) for a in modules for b in imported[a] - {a} if a in imported.get(b, ())]


def test_the_vendors_sdk_is_known_to_one_file_and_to_the_bench_that_measures_it():
    knows = {
        str(module.relative_to(PACKAGE))
        for module in MODULES
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
        if name and name.split(".")[0] == "dynamixel_sdk"
    }
    assert knows == {"servo/chain/sdk_packets.py", "lab/bench/bus_bench.py"}
