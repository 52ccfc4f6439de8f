"""`evaluate people`: the study's folder, its answers and what goes wrong with them."""

import json

import numpy as np
import pytest
import soundfile

from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora import clips
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.evaluate.people_study import Study, StudyOptions, clip_name, prepare, read_answers, table
from sfms_robot.lab.evaluation.preferences import QUESTIONS

ALL_LEFT = dict.fromkeys(QUESTIONS, "left")


def study(folder):
    told = {"conditions": ["sfms-small", "recorded"], "voices": ["one", "two", "three"], "seed": 5}
    (folder / "study.json").write_text(json.dumps(told))
    return Study(folder)


def test_answers_are_kept_as_they_are_given_and_a_person_goes_on(tmp_path):
    first = study(tmp_path)
    me = first.begin()
    before = first.next(me)
    assert before["trials"] == 3 and before["answered"] == 0
    first.answer(me, before["trial"], ALL_LEFT)
    again = Study(tmp_path)  # the program was started anew
    assert again.next(me)["answered"] == 1 and again.next(me)["trial"] != before["trial"]
    assert again.next(again.begin())["answered"] == 0
    told = table(tmp_path / "answers.csv")
    assert told["answers"] == 4 and told["participants"] == 1 and told["sides"] == {"left": 4, "right": 0}


def test_the_page_is_not_told_which_is_which(tmp_path):
    shown = study(tmp_path).next("me")
    assert shown["left"] != shown["right"] and "recorded" not in json.dumps(shown) and "sfms" not in json.dumps(shown)
    names = {clip_name(5, name, int(shown["audio"][6])) for name in ("sfms-small", "recorded")}
    assert names == {shown[side].removesuffix(".f32") for side in ("left", "right")}


def test_all_answered_is_the_end_and_an_answer_counts_once(tmp_path):
    here = study(tmp_path)
    for number in range(3):
        here.answer("me", number, ALL_LEFT)
        here.answer("me", number, ALL_LEFT)
    assert here.next("me") == {"answered": 3, "trials": 3} and len(read_answers(tmp_path / "answers.csv")) == 12


def test_recorded_motion_is_a_clip_like_that_of_a_listener(tmp_path):
    draw, frames = np.random.default_rng(0), 60
    speaker, listener = draw.uniform(0, 0.4, (2, frames, 58)).astype(np.float32)
    audio = draw.normal(0, 0.1, frames * 640).astype(np.float32).clip(-1, 1)
    clips.save(tmp_path / "data" / "test", [Dyad("one", audio, speaker, listener, np.ones(frames, bool))])
    options = StudyOptions(["sfms-small", "recorded"], tmp_path / "data", 1, 2.0, 5, tmp_path / "study")
    made = prepare(options)
    shown = {
        name: np.fromfile(made.clips / f"{clip_name(5, name, 0)}.f32", "<f4").reshape(-1, 58)
        for name in options.conditions
    }
    np.testing.assert_allclose(shown["recorded"], listener[-50:], atol=1e-3)
    assert shown["sfms-small"].shape == (50, 58) and np.isfinite(shown["sfms-small"]).all()
    voice, rate_hz = soundfile.read(made.clips / "voice-0.wav")
    assert (len(voice), rate_hz) == (32_000, 16_000)
    assert prepare(options).conditions == ["sfms-small", "recorded"]  # it goes on


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
        ("{head}\nme,0,0,taste,a,b,a\n", "line 2: question = 'taste' is not asked (person, attentive"),
        ("{head}\nme,0,0,person,a,b,c\n", "line 2: chosen = 'c' was not to choose (a, b, neither)"),
        ("{head}\nme,0\n", "line 2 is not an answer"),
    ],
)
def test_a_file_that_holds_something_else_is_one_line(tmp_path, text, told):
    file = tmp_path / "answers.csv"
    file.write_text(text.replace("{head}", "participant,trial,voice,question,left,right,chosen"))
    with pytest.raises(ConfigError) as caught:
        table(file)
    assert str(caught.value).startswith(str(file)) and told in str(caught.value)


@pytest.mark.parametrize(
    "conditions, told",
    [
        (("sfms-small",), "--listener: two or more"),
        (("sfms-small", "sfms-small"), "each once"),
        (("sfms-small", "recorded"), "--listener recorded: --data says whose motion"),
        (("sfms-small", "nobody"), "'nobody' is neither a shipped name nor a folder"),
    ],
)
def test_what_cannot_be_compared_is_said_before_anything_is_made(tmp_path, conditions, told):
    with pytest.raises(ConfigError, match=told.replace("(", r"\(")):
        prepare(StudyOptions(conditions, None, 2, 4.0, 1, tmp_path / "study"))
    assert not (tmp_path / "study").exists()


@pytest.mark.slow
def test_clips_are_made_once(tmp_path):
    options = StudyOptions(("sfms-small", "arig-small"), None, 2, 2.0, 1, tmp_path / "study")
    made = prepare(options)
    shown = made.next("me")
    motion = np.fromfile(made.clips / shown["left"], "<f4").reshape(-1, 58)
    assert motion.shape == (50, 58) and np.isfinite(motion).all() and np.ptp(motion, axis=0).max() > 0.01
    files = {file.name: file.stat().st_mtime_ns for file in made.clips.iterdir()}
    prepare(options)
    assert files == {file.name: file.stat().st_mtime_ns for file in made.clips.iterdir()}
    with pytest.raises(ConfigError, match="another study"):
        prepare(StudyOptions(("sfms-small", "arig-small"), None, 2, 2.0, 2, tmp_path / "study"))
