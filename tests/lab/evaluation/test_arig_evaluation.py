"""`evaluate interaction`, the ARIG tables and `evaluate papers`, on half a minute of made-up conversation."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from tiny_arig_training import dyad, settings, write

from sfms_robot.lab.corpora import clips
from sfms_robot.lab.evaluation.arig_tables import LABELS
from sfms_robot.lab.evaluation.listener_tables import PRINTED
from sfms_robot.lab.learning.arig.trainer import train_arig
from sfms_robot.listeners import checkpoint

TABLE_2 = ("evaluate", "listener", "--table", "arig-2")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def lively(data, tmp_path_factory):
    """The same, but nothing in a held-out face is ever the same twice."""
    folder, rng = tmp_path_factory.mktemp("lively"), np.random.default_rng(0)
    shutil.copytree(data, folder, dirs_exist_ok=True)
    for place, scene in ((".", "listening"), ("interaction", "interaction")):
        motion = rng.uniform(0.1, 0.3, (2, 300, 58)).astype(np.float32)
        clips.save(folder / place / "test", [replace(dyad("v", scene, 2), speaker=motion[0], listener=motion[1])])
    return folder


@pytest.fixture(scope="module")
def listener(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("listener")
    train_arig(settings(steps=2), data, folder)
    return folder


@pytest.mark.slow
def test_interaction_tells_states_lips_and_borders_beside_what_a_rule_on_voices_gets(command_line, listener, data):
    ended = command_line("evaluate", "interaction", "--listener", listener, "--data", data, "--json")
    found = ended.told
    assert ended.code == 0 and found["dyads"] == {"listening": 1, "speaking": 1, "interaction": 1}
    assert found["voice_rule_accuracy"] > 0.8 > 0.6 > found["majority_accuracy"] > 0.3, "it hears turns a little late"
    assert 0 <= found["state_accuracy"] <= 1 and -1 <= found["lips_speaking_correlation"] <= 1
    table = found["confusion"]["label_by_answer"]
    assert sum(map(sum, table)) == 3 * (300 - 1), "every frame but the first of each dyad"


def test_interaction_is_for_listeners_that_speak(command_line, data):
    ended = command_line("evaluate", "interaction", "--listener", "sfms-small", "--data", data)
    assert ended.code == 2 and "sfms-small: does not speak; this command evaluates listeners of kind arig" in ended.err


def test_table_2_has_a_row_for_every_listener_given_and_the_papers(command_line, listener, lively):
    ended = command_line(*TABLE_2, "--listener", listener, "--listener", "sfms-small", "--data", lively, "--json")
    names = [row["name"] for row in ended.told["rows"]]
    assert ended.code == 0 and names == ["Ground truth", str(listener), "sfms-small", *PRINTED["arig-2"]["rows"]]


@pytest.mark.slow
@pytest.mark.parametrize(("table", "paper"), [(name, PRINTED[name]) for name in ("arig-1", "arig-4", "arig-readings")])
def test_ablations_that_are_missing_are_trained_and_kept(command_line, listener, lively, tmp_path, table, paper):
    file = tmp_path / "arig.yaml"
    file.write_text(yaml.safe_dump(settings(steps=2).model_dump(mode="json")))
    words = ("evaluate", "listener", "--table", table, "--data", lively, "--listener", listener)
    words += ("--models", tmp_path / "m", "--config", file, "--json")
    ended = command_line(*words)
    assert ended.code == 0 and {row["name"] for row in ended.told["rows"]} == {
        "GT", "ARIG", *paper["ablations"], *paper["rows"], str(listener),
    }  # fmt: skip
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "m").rglob("*.safetensors")}
    assert command_line(*words).out == ended.out and before == {path: path.stat().st_mtime_ns for path in before}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--table", "arig-1"), "--table arig-1: needs --models DIR, where its listeners are trained and kept"),
        (("--table", "arig-2", "--order", "motion_first"), "--order"),
        (("--table", "arig-3"), "'arig-3' is not one of"),
    ],
)
def test_what_a_table_cannot_do_without_is_named(command_line, data, words, said):
    ended = command_line("evaluate", "listener", *words, "--data", data)
    assert ended.code == 2 and said in ended.err


def test_a_table_needs_faces_that_move(command_line, listener, data):
    ended = command_line(*TABLE_2, "--listener", listener, "--data", data)
    assert ended.code == 2 and "the clips' own motion: 250 frames differ too little to make 40 clusters" in ended.err


# `evaluate papers`: the papers as written, trained where they are missing and kept, beside the shipped listeners
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
    assert ended.code == 2 and "--table 5: is not one of 1, 2, 3, 4, arig-1, arig-2, arig-4, arig-readings" in ended.err
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
