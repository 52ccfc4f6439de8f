"""The public face: every name is there, typed, and costs nothing until it is used."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sfms_robot


@pytest.mark.parametrize("name", sfms_robot.__all__)
def test_every_public_name_is_there(name):
    assert getattr(sfms_robot, name) is not None and name in dir(sfms_robot)


def test_type_checkers_see_the_same_names_and_an_unknown_one_is_an_attribute_error():
    tree = ast.parse(Path(sfms_robot.__file__).read_text(encoding="utf-8"))
    (guarded,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {alias.asname or alias.name for node in guarded.body for alias in node.names}
    assert seen == set(sfms_robot.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'run_head'"):
        _ = sfms_robot.run_head


LIGHT = {
    "the package": """
import sys; before = set(sys.modules); import sfms_robot
loaded = {name.split(".")[0] for name in set(sys.modules) - before} - {"sfms_robot", *sys.stdlib_module_names}
""",
    "retargeting": """
import sys, numpy as np, sfms_robot as sr
angles = sr.Retargeter(sr.load_head("face28")).angles(np.zeros(58, np.float32))
assert angles.shape == (28,) and angles.dtype == np.float64
loaded = {"torch", "serial", "dynamixel_sdk", "ruckig"} & set(sys.modules)
""",
    "servos and robot": """
import sys, sfms_robot as sr; sr.Robot, sr.open_bus
loaded = {"torch"} & set(sys.modules)
""",
}


@pytest.mark.parametrize("code", LIGHT.values(), ids=LIGHT)
def test_nothing_heavy_is_loaded_before_it_is_used(code):
    code += "sys.exit(f'loaded {loaded}' if loaded else 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
