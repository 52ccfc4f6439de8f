"""The public face: every name is there, typed, and costs nothing until it is used."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sfms_robot


def done_in_a_fresh_interpreter(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", sfms_robot.__all__)
def test_every_public_name_is_there(name):
    assert getattr(sfms_robot, name) is not None
    assert name in dir(sfms_robot)


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(sfms_robot.__file__).read_text(encoding="utf-8"))
    (guarded,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {alias.asname or alias.name for node in guarded.body for alias in node.names}
    assert seen == set(sfms_robot.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'run_head'"):
        _ = sfms_robot.run_head


def test_importing_the_package_imports_nothing_else():
    done = done_in_a_fresh_interpreter(
        "import sys; before = set(sys.modules); import sfms_robot\n"
        "new = {name.split('.')[0] for name in set(sys.modules) - before} - {'sfms_robot', *sys.stdlib_module_names}\n"
        "sys.exit(f'loaded {new}' if new else 0)"
    )
    assert done.returncode == 0, done.stderr


def test_retargeting_loads_neither_torch_nor_a_serial_port():
    done = done_in_a_fresh_interpreter(
        "import sys, numpy as np, sfms_robot as sr\n"
        "angles = sr.Retargeter(sr.load_head('face28')).angles(np.zeros(58, np.float32))\n"
        "assert angles.shape == (28,) and angles.dtype == np.float64\n"
        "heavy = {'torch', 'serial', 'dynamixel_sdk', 'ruckig'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    assert done.returncode == 0, done.stderr


def test_servos_and_robot_load_no_torch():
    done = done_in_a_fresh_interpreter(
        "import sys, sfms_robot as sr; sr.Robot, sr.open_bus; sys.exit('torch' in sys.modules)"
    )
    assert done.returncode == 0, done.stderr
