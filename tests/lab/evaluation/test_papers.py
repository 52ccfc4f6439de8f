"""`evaluate papers`: the papers as written, trained where they are missing and kept, beside the shipped listeners."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_arig_training import dyad, write

from sfms_robot.lab.corpora import clips
from sfms_robot.lab.evaluation.arig_tables import LABELS
from sfms_robot.listeners import checkpoint


@pytest.fixture
def lively(tmp_path: Path) -> Path:
    """Dyads of three scenes; nothing in a held-out face is ever the same twice."""
    folder, rng = write(tmp_path / "data"), np.random.default_rng(0)
    for place, scene in ((".", "listening"), ("interaction", "interaction")):
        motion = rng.uniform(0.1, 0.3, (2, 300, 58)).astype(np.float32)
        clips.save(folder / place / "test", [replace(dyad("v", scene, 2), speaker=motion[0], listener=motion[1])])
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("table", "kind", "ours"), [("1", "sfms", "sfms-small"), ("arig-2", "arig", "arig-small")])
def test_a_table_has_the_paper_as_written_beside_ours(command_line, lively, tmp_path, table, kind, ours) -> None:
    words = ("evaluate", "papers", "--data", lively, "--models", tmp_path / "m", "--table", table, "--steps", 1)
    words += ("--clips", 1, "--samples", 2, "--json")
    trained = command_line(*words)
    assert trained.code == 0
    rows = {row["name"]: row for row in trained.told["tables"][table]["rows"]}
    assert rows[LABELS[kind]]["source"] == rows[ours]["source"] == "here"
    assert rows[kind.upper()]["source"] == "paper"
    weights = tmp_path / "m" / f"{kind}-as-written" / checkpoint.WEIGHTS
    before, again = weights.stat().st_mtime_ns, command_line(*words)
    assert json.dumps(again.told) == json.dumps(trained.told) and weights.stat().st_mtime_ns == before


def test_a_table_that_neither_paper_has_is_named(command_line, tmp_path) -> None:
    ended = command_line("evaluate", "papers", "--data", tmp_path, "--models", tmp_path / "m", "--table", "5")
    assert ended.code == 2 and "--table 5: is not one of 1, 2, 3, 4, arig-1, arig-2, arig-4" in ended.err
    assert not (tmp_path / "m").exists()


@pytest.mark.slow
def test_without_a_folder_for_models_a_table_says_what_is_not_trained_and_how_it_would_be(command_line, lively) -> None:
    words = ("evaluate", "papers", "--data", lively, "--clips", 1, "--samples", 2)
    words += ("--table", "1", "--table", "arig-1")
    tables = command_line(*words, "--json").told["tables"]
    for name, label in (("1", LABELS["sfms"]), ("arig-1", "ARIG")):
        assert label not in {row["name"] for row in tables[name]["rows"] if row.get("source") == "here"}
        assert tables[name]["not_trained"][label]
    assert "configs/training/arig-as-written.yaml" in tables["arig-1"]["not_trained"]["w/o long-range context"]
