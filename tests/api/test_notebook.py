"""The public face in a notebook: a kernel of its own, where signals and the main thread belong to somebody else."""

import json

import nbformat
import pytest
from nbclient import NotebookClient

CELLS = (
    """
import sfms_robot as sr
robot = sr.Robot("op3_head", port="sim", audio="katie", duration_s=20.0).start()
""",
    """
robot.show({"pitch": 0.1}, seconds=0.2)
robot.wait(1.5)
print(robot.state)
""",
    """
robot.stop()
import json
report = robot.report()
print(json.dumps({"exit": report["exit"], "violations": report["limits"]["violations"], "ticks": report["ticks"]}))
""",
)


@pytest.mark.slow
def test_a_robot_is_worked_cell_by_cell(tmp_path):
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    NotebookClient(notebook, timeout=60, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    said = ["".join(out["text"] for out in cell["outputs"] if out.get("name") == "stdout") for cell in notebook.cells]
    assert said[1].strip() in ("listening", "idle")
    report = json.loads(said[2])
    assert (report["exit"], report["violations"]) == ("interrupted", 0) and report["ticks"] > 100
