"""`evaluate people`: the study's folder, its answers and what goes wrong with them."""

import json
import resource
from collections import Counter

import numpy as np
import pytest
import soundfile
from made_dyads import made_dyad

from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora import clips
from sfms_robot.lab.evaluation.people_study import (
    NEITHER,
    QUESTIONS,
    Preference,
    Study,
    bradley_terry,
    clip_name,
    prepare,
    read_answers,
    summary,
    trials,
)

ALL_LEFT = dict.fromkeys(QUESTIONS, "left")


def study(folder):
    told = {"conditions": ["sfms-small", "recorded"], "voices": ["one", "two", "three"], "seed": 5}
    (folder / "study.json").write_text(json.dumps(told))
    return Study(folder)


def options_for(tmp_path, conditions, data=None, voices=1, seed=1, split="test"):
    same = {"seconds": 2.0, "folder": tmp_path / "study"}
    return {"conditions": conditions, "data": data, "voices": voices, "seed": seed, "split": split, **same}


def test_answers_are_kept_a_person_goes_on_and_each_counts_once(tmp_path):
    first = study(tmp_path)
    me = first.begin()
    before = first.next(me)
    assert before["trials"] == 3 and before["answered"] == 0
    first.answer(me, before["trial"], ALL_LEFT)
    again = Study(tmp_path)  # the program was started anew
    assert again.next(me)["answered"] == 1 and again.next(me)["trial"] != before["trial"]
    assert again.next(again.begin())["answered"] == 0
    told = summary(read_answers(tmp_path / "answers.csv"))
    assert told["answers"] == 4 and told["participants"] == 1 and told["sides"] == {"left": 4, "right": 0}
    for number in range(3):
        again.answer("me", number, ALL_LEFT)
        again.answer("me", number, ALL_LEFT)
    assert again.next("me") == {"answered": 3, "trials": 3} and len(read_answers(tmp_path / "answers.csv")) == 16


@pytest.mark.parametrize("given", [0, 1])
def test_a_full_disk_leaves_no_part_of_an_answer(tmp_path, given):
    first, file, limits = study(tmp_path), tmp_path / "answers.csv", resource.getrlimit(resource.RLIMIT_FSIZE)
    for number in range(given):
        first.answer("me", number, ALL_LEFT)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10 + (file.stat().st_size if given else 0), limits[1]))
    try:
        with pytest.raises(ConfigError, match=r"answers\.csv: cannot be written: File too large"):
            first.answer("me", 2, ALL_LEFT)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert len(read_answers(file)) == 4 * given and Study(tmp_path).next("me")["answered"] == given
    first.answer("me", 2, ALL_LEFT)
    assert len(read_answers(file)) == 4 * given + 4


def test_the_page_is_not_told_which_is_which(tmp_path):
    shown = study(tmp_path).next("me")
    assert shown["left"] != shown["right"] and "recorded" not in json.dumps(shown) and "sfms" not in json.dumps(shown)
    names = {clip_name(5, name, int(shown["audio"][6])) for name in ("sfms-small", "recorded")}
    assert names == {shown[side].removesuffix(".f32") for side in ("left", "right")}


@pytest.mark.parametrize("split", ["validation", "test"])
def test_recorded_motion_is_a_clip_like_that_of_a_listener(tmp_path, split):
    speaker, listener = np.random.default_rng(0).uniform(0, 0.4, (2, 60, 58)).astype(np.float32)
    clips.save(tmp_path / "data" / split, [made_dyad(listener, speaker=speaker)])
    options = options_for(tmp_path, ["sfms-small", "recorded"], tmp_path / "data", seed=5, split=split)
    made = prepare(**options)
    shown = {
        name: np.fromfile(made.clips / f"{clip_name(5, name, 0)}.f32", "<f4").reshape(-1, 58)
        for name in options["conditions"]
    }
    np.testing.assert_allclose(shown["recorded"], listener[-50:], atol=1e-3)
    assert shown["sfms-small"].shape == (50, 58) and np.isfinite(shown["sfms-small"]).all()
    voice, rate_hz = soundfile.read(made.clips / "voice-0.wav")
    assert (len(voice), rate_hz) == (32_000, 16_000)
    assert prepare(**options).conditions == ["sfms-small", "recorded"]  # it goes on
    for other in ({"split": "train"}, {"seed": 2}):
        with pytest.raises(ConfigError, match="another study"):
            prepare(**options | other)


@pytest.mark.parametrize(
    "number, chosen, told",
    [
        (7, ALL_LEFT, "trial = 7 is not one of this study (0 to 2)"),
        (0, {"person": "left"}, "answers: person, attentive, natural, in_time want left, right or neither each"),
        (0, ALL_LEFT | {"person": "both"}, "want left, right or neither each"),
    ],
)
def test_answers_that_cannot_be_are_refused(tmp_path, number, chosen, told):
    with pytest.raises(ConfigError) as caught:
        study(tmp_path).answer("me", number, chosen)
    assert told in str(caught.value) and not (tmp_path / "answers.csv").exists()


@pytest.mark.parametrize(
    "text, told",
    [
        ("a,b\n1,2\n", "not answers of a comparison"),
        ("{head}\nme,zero,0,person,a,b,a\n", "line 2 is not an answer"),
        ("{head}\nme,0,0,taste,a,b,a\n", "line 2: question = 'taste' is not a question (person, attentive"),
        ("{head}\nme,0,0,person,a,b,c\n", "line 2: chosen = 'c' is not a choice (a, b, neither)"),
        ("{head}\nme,0\n", "line 2 is not an answer"),
    ],
)
def test_a_file_that_holds_something_else_is_one_line(tmp_path, text, told):
    file = tmp_path / "answers.csv"
    file.write_text(text.replace("{head}", "participant,trial,voice,question,left,right,chosen"))
    with pytest.raises(ConfigError) as caught:
        read_answers(file)
    assert str(caught.value).startswith(str(file)) and told in str(caught.value)


@pytest.mark.parametrize(
    "conditions, told",
    [
        (("sfms-small",), "--listener: two or more"),
        (("sfms-small", "sfms-small"), "each once"),
        (("sfms-small", "recorded"), "--listener recorded: needs --data"),
        (("sfms-small", "nobody"), "'nobody' is neither a shipped name nor a folder"),
    ],
)
def test_what_cannot_be_compared_is_said_before_anything_is_made(tmp_path, conditions, told):
    with pytest.raises(ConfigError, match=told.replace("(", r"\(")):
        prepare(**options_for(tmp_path, conditions))
    assert not (tmp_path / "study").exists()


@pytest.mark.slow
def test_clips_are_made_once(tmp_path):
    options = options_for(tmp_path, ("sfms-small", "arig-small"), voices=2)
    made = prepare(**options)
    motion = np.fromfile(made.clips / made.next("me")["left"], "<f4").reshape(-1, 58)
    assert motion.shape == (50, 58) and np.isfinite(motion).all() and np.ptp(motion, axis=0).max() > 0.01
    files = {file.name: file.stat().st_mtime_ns for file in made.clips.iterdir()}
    prepare(**options)
    assert files == {file.name: file.stat().st_mtime_ns for file in made.clips.iterdir()}


def answers(counts, question="person", left="a", right="b"):
    """`counts`: chosen -> how often."""
    flat = [chosen for chosen, count in counts.items() for _ in range(count)]
    shared = {"question": question, "left": left, "right": right}
    return [Preference(participant="p", trial=n, voice=n, chosen=chosen, **shared) for n, chosen in enumerate(flat)]


def test_everybody_sees_every_pair_with_every_voice_once_with_even_sides():
    shown = trials(["a", "b", "c"], 4, seed=1, participant="x")
    pairs = Counter((trial.voice, frozenset((trial.left, trial.right))) for trial in shown)
    assert len(pairs) == 12 and set(pairs.values()) == {1} and [t.trial for t in shown] == list(range(12))
    assert shown == trials(["a", "b", "c"], 4, seed=1, participant="x")
    assert shown != trials(["a", "b", "c"], 4, seed=1, participant="y")
    left = sum(trial.left == "a" for n in range(200) for trial in trials(["a", "b"], 5, 0, str(n)))
    assert left / 1000 == pytest.approx(0.5, abs=0.06)


def test_a_pair_has_its_exact_interval_whatever_the_sides_and_none_without_answers():
    told = summary(answers({"a": 8, "b": 2, NEITHER: 3}))
    (row,) = told["rows"]
    assert (row["first_chosen"], row["second_chosen"], row["neither"], row["share"]) == (8, 2, 3, 0.8)
    assert row["interval"] == pytest.approx([0.4439, 0.9748], abs=1e-4)  # Clopper and Pearson
    assert row["p"] == pytest.approx(0.109375)  # 2 (C(10,8) + C(10,9) + C(10,10)) / 2^10
    assert told["sides"] == {"left": 8, "right": 2} and told["bradley_terry"] == {}
    told = summary(answers({"a": 3}) + answers({"a": 4}, left="b", right="a"))
    assert told["rows"][0]["first_chosen"] == 7 and told["sides"] == {"left": 3, "right": 4}
    assert summary([])["rows"] == [] and summary([])["answers"] == 0
    (row,) = summary(answers({NEITHER: 2}))["rows"]
    assert row["share"] is None and row["interval"] is None


def test_strengths_are_found_again():
    rng, true = np.random.default_rng(0), np.array([0.8, 0.1, -0.9])
    wins = np.zeros((3, 3))
    for one in range(3):
        for other in range(one):
            won = rng.binomial(4000, 1 / (1 + np.exp(true[other] - true[one])))
            wins[one, other], wins[other, one] = won, 4000 - won
    np.testing.assert_allclose(bradley_terry(wins), true, atol=0.08)
