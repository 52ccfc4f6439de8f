"""`evaluate naturalness`, `timing`, `robustness`: what their documents hold, and one line for what cannot be judged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ami_tables import write_tables
from tiny_arig_training import dyad

from sfms_robot.frames import AUDIO_HZ, CHANNEL_INDEX, FRAME_HZ, FRAME_SAMPLES
from sfms_robot.lab.corpora import clips
from sfms_robot.lab.corpora.formats import open_dataset
from sfms_robot.lab.evaluation import naturalness
from sfms_robot.lab.evaluation.detection import movement, nods_of
from sfms_robot.lab.evaluation.naturalness import FOLDS, REGIONS, compared, listening, nod_ratios, notes
from sfms_robot.lab.evaluation.robustness import CONDITIONS, RANGES, cases

LEAST = 2 * FOLDS
SERIES = {"train": "ES2008a", "validation": "IS1000a", "test": "ES2003a"}
NOBODY_KNOWS = ("nod_deg", "nod_s", "nod_swings", "blink_s", "smile_s")


def people(folder: Path, parts, count=LEAST, **changed) -> Path:
    """Dyads of 12 s, whose listeners nod, blink and smile, each in their own way."""
    for split in parts:
        made = []
        for number in range(count):
            rng = np.random.default_rng([len(split), number])
            one = dyad(f"{split}{number}", "listening", number)
            motion = one.listener + rng.normal(0, 0.005, one.listener.shape).astype(np.float32)
            motion[5 * FRAME_HZ : 8 * FRAME_HZ, CHANNEL_INDEX["mouthSmileLeft"]] = 0.6
            motion[:: 3 * FRAME_HZ, CHANNEL_INDEX["eyeBlinkLeft"]] = 0.9
            attention = (np.arange(len(motion)) // FRAME_HZ % 2).astype(np.float32)
            made.append(replace(one, **{"listener": motion, "attention": attention} | changed))
        clips.save(folder / split, made)
    return folder


def one_line(ended, *said: str) -> None:
    """A wrong value is told in one line that names it."""
    assert ended.code == 2
    for part in said:
        assert part in ended.complaint


@pytest.mark.slow
def test_naturalness_tells_how_it_moves_and_who_it_is_told_from(command_line, tmp_path, monkeypatch):
    monkeypatch.setattr(naturalness, "_STEPS", 6)  # the document is looked at here, not how well the nets tell apart
    data = people(tmp_path / "dyads", ("train", "test"))
    found = command_line("evaluate", "naturalness", "--data", data, "--drift", 30, "--json").told
    assert found["listener"] == "sfms-small" and found["split"] == "test" and found["dyads"] == LEAST
    assert found["minutes"] == pytest.approx(LEAST * 12 / 60, abs=0.05) and "onnx" in found["engine"]
    rows = [f"{who}two_sample_auc" for who in ("", "person_", "training_", "imitated_")]
    assert {"nod_amplitude_ratio", "nod_length_ratio", "nod_cycle_ratio"} < found.keys()
    for name in (*rows, *(f"levelled_{row}" for row in rows)):
        assert set(found[name]) == set(found["interval"][name]) == set(REGIONS)
        for region, auc in found[name].items():
            low, high = found["interval"][name][region]
            assert 0 <= low <= high <= 1 and 0 <= auc <= 1
    assert found["people_smile_s"] == pytest.approx(3.0, abs=0.3) and found["people_gaze_on_person"] > 0.9
    assert found["drift_deg"] >= 0 and set(found["people_pose_deg"]) == {"roll", "pitch", "yaw"}


def test_windows_in_which_the_listener_talks_himself_are_not_judged(tmp_path):
    one = replace(open_dataset(people(tmp_path, ("validation",), count=1), "validation")[0], agent_audio=None)
    (every,) = listening([one], [one.listener])
    audio = np.zeros(len(one.listener) * FRAME_SAMPLES, np.float32)
    audio[3 * AUDIO_HZ : 5 * AUDIO_HZ] = np.random.default_rng(0).normal(0, 0.1, 2 * AUDIO_HZ)
    (some,) = listening([replace(one, agent_audio=audio)], [one.listener])
    np.testing.assert_array_equal(some, np.delete(every, [1, 2], axis=0))


def test_people_who_do_nothing_and_whose_gaze_nobody_knows_leave_figures_out(tmp_path):
    """No laugh, no nod, no annotated gaze, nobody to be trained on: None and a note, no number made up."""
    still = np.zeros((12 * FRAME_HZ, 58), np.float32)
    data = people(tmp_path, ("validation",), count=3, listener=still, attention=None, events=())
    dyads = open_dataset(data, "validation")
    nothing = movement([dyad.listener for dyad in dyads], [np.ones(len(still), bool)] * len(dyads))
    ratios = nod_ratios([nods_of([still])] * 3, [nods_of([still])] * 3, np.arange(3))
    found = compared({**ratios, **nothing}, nothing)
    assert [found[who + name] for who in ("", "people_") for name in NOBODY_KNOWS] == [None] * 2 * len(NOBODY_KNOWS)
    assert {found[name] for name in ratios} == {None} and found["gaze_on_person"] == 1.0
    gaze, training = notes(dyads, [])
    assert "in 3 dyads: gaze" in gaze and "training" in training


@pytest.mark.parametrize(
    ("parts", "split", "said"),
    [
        (("train", "test"), "train", "--split train: listeners were trained on these people"),
        (("train", "test"), "validation", "has no split validation (train, test)"),
        (("test",), "holdout", "has no split holdout (test)"),
    ],
)
def test_naturalness_is_held_against_people_nobody_was_trained_on(command_line, tmp_path, parts, split, said):
    data = people(tmp_path / "dyads", parts, count=1)
    one_line(command_line("evaluate", "naturalness", "--data", data, "--split", split), said)


def test_a_few_dyads_are_too_few_to_tell_people_apart(command_line, tmp_path):
    data = people(tmp_path / "dyads", ("test",), count=3)
    one_line(command_line("evaluate", "naturalness", "--data", data), str(data), "3 dyads of test", "10 or more")


@pytest.fixture(scope="module")
def tables(tmp_path_factory) -> Path:
    """Two minutes of a meeting in each part."""
    return write_tables(tmp_path_factory.mktemp("tables"), meetings=tuple(SERIES.values()), until_s=120.0)


@pytest.mark.slow
def test_timing_tells_people_decisions_motion_and_the_reference_apart_and_who_speaks_himself(command_line, tables):
    words = ("evaluate", "timing", "--data", tables, "--minutes", 0.5, "--seeds", 2, "--jobs", 1, "--json")
    found = command_line(*words).told
    assert (found["split"], found["people"], found["meetings"], found["seeds"]) == ("test", 2, 2, 2)
    for prefix in ("", "people_", "decided_"):
        for name in ("nods_per_minute", "addressed_nods_per_minute", "bystander_nods_per_minute", "phrase_end_ratio"):
            assert prefix + name in found and prefix + name in found["interval"]
    auc = ("nod_hazard_auc", "nod_hazard_auc_without_own_speech", "shifted_nod_hazard_auc")
    assert all(0 <= found[who + name] <= 1 for name in auc for who in ("", "annotated_", "one_voice_", "r2_"))
    assert found["people_nods_per_minute"] == pytest.approx(5, abs=1.5)
    assert {"interval_ks", "table_nod_auc", "blinks_per_minute", "smiles_per_minute", "detector"} <= set(found)
    assert found["people_smiles_per_minute"] is None and found["notes"]
    speaking = command_line(*words, "--own-voice").told
    assert (found["own_voice"], speaking["own_voice"]) == (False, True)
    assert speaking["decided_gaze_shifts_per_minute"] > found["decided_gaze_shifts_per_minute"], "talk looks aside"
    assert speaking["gaze_shifts_per_minute"] != found["gaze_shifts_per_minute"]
    for name in ("nod_hazard_auc", "shifted_nod_hazard_auc", "people_nods_per_minute"):
        assert speaking[name] == found[name]
    of_nods = ("nod_auc", "decided_nod_auc")  # how its nods hang on the others
    assert any(name.startswith(of_nods) for name in found) and not any(name.startswith(of_nods) for name in speaking)


@pytest.mark.slow
@pytest.mark.parametrize(("lacking", "figure"), [("gaze_shift", "gaze_shifts"), ("laugh", "laughs")])
def test_what_nobody_annotated_of_the_people_is_not_told(command_line, tmp_path, lacking, figure):
    data = write_tables(tmp_path, lacking, tuple(SERIES.values()), 120.0)
    words = ("evaluate", "timing", "--data", data, "--minutes", 0, "--seeds", 1, "--jobs", 1, "--json")
    found = command_line(*words).told
    assert not found[f"people_{figure}_per_minute"] and found["people_nods_per_minute"] > 0
    assert found["nod_hazard_auc"] is not None and found[f"{lacking}_hazard_auc"] is None


@pytest.mark.slow
def test_robustness_has_a_row_for_every_way_and_names_those_outside(command_line):
    words = ("evaluate", "robustness", "--speakers", 1, "--minutes", 0.1, "--seeds", 2, "--jobs", 1, "--json")
    found = command_line(*words).told
    ways = [(inputs, CONDITIONS[number].name) for inputs, number in cases()]
    assert [(row["inputs"], row["condition"]) for row in found["rows"]] == ways
    for kind in RANGES:
        rates = [row[f"{kind}s_per_minute"] for row in found["rows"]]
        assert found[f"{kind}s_per_minute"] == [min(rates), max(rates)]
    smiles = found["returned_smiles"]
    assert smiles["difference"] == pytest.approx(smiles["answered"] - smiles["shifted"], abs=2e-4)
    assert smiles["false_per_minute"] <= smiles["never_smiles_per_minute"]
    named = {(row["inputs"], row["condition"]) for row in found["outside"]}
    low, high = found["people"]["nods_per_minute"]
    assert named >= {
        (row["inputs"], row["condition"])
        for row in found["rows"]
        if row["nods_per_minute"] > high or (row["tells_speech"] and row["nods_per_minute"] < low)
    }


@pytest.mark.parametrize("command", ["timing", "robustness"])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--split", "train"), "--split train: listeners were trained on these"),
        (("--data", "gone"), "--data gone: no such folder"),
        (("--listener", "nobody"), "nobody"),
    ],
)
def test_what_cannot_be_played_is_named(command_line, tables, command, words, said):
    data = ("--data", tables) if command == "timing" else ()  # the other one has speakers of its own
    one_line(command_line("evaluate", command, *data, *words), said)
