"""A listener that cannot show everything says so before anything moves."""

import json

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import save_file

from sfms_robot.app.head.head_check import check
from sfms_robot.app.listen.report import limitation
from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run
from sfms_robot.config.listener import load_listener
from sfms_robot.errors import ConfigError
from sfms_robot.listeners.sfms.model import SfmsModel

TINY = {
    "kind": "sfms",
    "motion_space": "deca56",
    "groups": {"preset": "one", "levels": [3, 2], "keyframes": 6},
    "tokenizer_width": 16,
    "predictor_width": 16,
    "predictor_layers": 1,
    "heads": 2,
}


@pytest.fixture
def deca(tmp_path):
    """A folder with a tiny, untrained listener that works in deca56."""
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(TINY))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = SfmsModel(load_listener(tmp_path / "config.yaml"))
    save_file(model.state_dict(), tmp_path / "model.safetensors")
    return tmp_path


def test_only_a_listener_in_deca56_without_a_matrix_shows_pose_and_jaw_only(deca):
    assert limitation("sfms-small") is None and check("op3_head", listener="sfms-small")["limitation"] is None
    assert "pose and jaw only" in limitation(str(deca))
    assert "pose and jaw only" in check("op3_head", listener=str(deca))["limitation"]
    np.save(deca / "mine.npy", np.random.default_rng(0).normal(size=(52, 50)))
    (deca / "config.yaml").write_text(yaml.safe_dump(TINY | {"flame_matrix": "mine.npy"}))
    assert limitation(str(deca)) is None


def test_a_matrix_that_is_not_there_is_told_before_anything_moves(deca):
    (deca / "config.yaml").write_text(yaml.safe_dump(TINY | {"flame_matrix": "gone.npy"}))
    with pytest.raises(ConfigError, match=r"gone\.npy"):
        run(RunOptions(listener=str(deca), duration_s=0.4, fast=True))


def test_a_run_logs_it_and_reports_it(deca, caplog):
    report = run(RunOptions(head="op3_head", listener=str(deca), duration_s=0.4, fast=True))
    assert "pose and jaw only" in report["limitation"] and "pose and jaw only" in caplog.text and json.dumps(report)
