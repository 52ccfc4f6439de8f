"""Hazards are recovered from events drawn by known ones; lessons and roll-outs are what happened."""

import numpy as np
import pytest
from ami_tables import UNTIL_S, words, write_tables
from made_dyads import NONE, meeting_person

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ
from sfms_robot.lab.corpora.compose.ami import phrases
from sfms_robot.lab.learning.events import event_trainer
from sfms_robot.lab.learning.events.event_trainer import (
    GROUPS,
    hazard,
    inputs,
    lesson,
    looks_of,
    meeting_scene,
    ranked,
    student,
    teach,
)
from sfms_robot.lab.learning.events.event_training import save, train_events
from sfms_robot.listeners.events.evidence import AT
from sfms_robot.listeners.events.model import STEP_FRAMES, EventModel, HazardBank, load_tables


def person(nods=NONE, other=None, **more):
    """A listener who says nothing, in a meeting with one other."""
    other = words(0) if other is None else other
    talk = phrases(map(tuple, other.tolist()))
    floor = tuple((a, b, "B") for a, b in talk)
    return meeting_person(
        agent="A", until_s=UNTIL_S, nods=nods, others=talk, floor=floor, words={"A": NONE, "B": other}, **more
    )


def answering():
    """Nods 0.4 s after every second phrase."""
    starts = np.round(phrases(map(tuple, words(0).tolist()))[::2, 1] + 0.4, 2)
    return np.stack([starts, starts + 0.6], axis=1)


def test_a_known_hazard_is_recovered_and_a_row_that_counts_twice_is_two():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(60_000, 3)).astype(np.float32)
    truth = np.array([1.0, -0.5, 0.0])
    happens = (rng.random(len(rows)) < 1 / (1 + np.exp(3 - rows @ truth))).astype(float)
    found = event_trainer.fit(rows, happens, np.ones(len(rows)))
    assert found.intercept == pytest.approx(-3, abs=0.06)
    np.testing.assert_allclose(found.weights, truth, atol=0.05)
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(500, 2)).astype(np.float32)
    happens = (rng.random(500) < 0.3).astype(float)
    twice = event_trainer.fit(np.r_[rows, rows], np.r_[happens, happens], np.ones(1000), ridge=1.0)
    counted = event_trainer.fit(rows, happens, np.full(500, 2.0), ridge=1.0)
    np.testing.assert_allclose(twice.weights, counted.weights, atol=1e-6)
    assert np.abs(event_trainer.fit(rows, happens, np.ones(500), ridge=1e4).weights).max() < 0.02


def test_a_lesson_holds_the_onsets_within_listening_and_no_step_inside():
    listening = np.zeros(1000, bool)
    listening[100:600] = True
    given = lesson(np.array([[5.0, 6.0], [10.04, 11.0], [30.0, 31.0]]), listening)
    assert given.onsets.tolist() == [62, 125]
    assert given.may[62] and not given.may[63:75].any() and given.may[75] and given.may[125]
    assert not given.may[:51].any() and not given.may[301:].any()


def test_evidence_of_a_meeting_is_what_was_said():
    scene, listening = meeting_scene(person())
    share = np.diff(words(0), axis=1).sum() / UNTIL_S
    assert scene.speaks[:, 1].mean() == pytest.approx(share, rel=0.03)
    assert not scene.speaks[:, 0].any() and np.isnan(scene.looks).all() and listening[scene.speaks[:, 1]].all()


def test_who_nods_behind_phrases_is_learned_to_and_a_random_one_is_not():
    rng = np.random.default_rng(0)
    people = [student(person(answering()), rng)]
    learned = hazard(teach(people, "nod", GROUPS["nod"], ridge=1.0), GROUPS["nod"], "a test", 3.0)
    bank = HazardBank({"nod": learned})
    score = lambda rows: bank.log_odds(bank.contributions(rows))[:, 0]  # noqa: E731
    assert ranked(people, "nod", score).mean() > 0.9
    starts = np.sort(np.random.default_rng(2).uniform(5, 590, 60)).round(2)
    by_lot = [student(person(np.stack([starts, starts + 0.3], axis=1)), rng)]
    assert 0.3 < ranked(by_lot, "nod", score).mean() < 0.7


def test_what_is_written_down_scores_as_what_was_fitted():
    people = [student(person(answering()), np.random.default_rng(0))]
    learned = teach(people, "nod", GROUPS["nod"])
    bank = HazardBank({"nod": hazard(learned, GROUPS["nod"], "a test", 3.0)})
    rows = people[0].evidence[1:2000]
    np.testing.assert_allclose(
        bank.log_odds(bank.contributions(rows))[:, 0], learned.log_odds(inputs(rows, GROUPS["nod"])), atol=0.01
    )


def test_nothing_later_is_known_as_a_step_begins():
    whole, cut = student(person(answering()), np.random.default_rng(0)), words(0)
    other = student(person(answering()[:10], cut[cut[:, 1] < 300]), np.random.default_rng(0))
    steps = int(min(answering()[10, 0], 299.0) / 0.08)
    annotated = [at for name, at in AT.items() if name not in ("smile_end_s", "brow_raise_end_s")]
    np.testing.assert_array_equal(whole.evidence[:steps, annotated], other.evidence[:steps, annotated])


def test_a_look_away_is_from_somebody_who_speaks():
    gaze = ((0.0, 50.0, "B"), (50.0, 52.0, "table"), (52.0, 60.0, "slide-screen"), (60.0, 600.0, "B"))
    one = person(gaze=gaze)
    _, aside, looking = looks_of(one, meeting_scene(one)[0])
    assert looking.onsets.tolist() == [50 * FRAME_HZ // STEP_FRAMES]
    assert aside.tolist()[1:3] == [True, True]
    assert looking.may[40 * FRAME_HZ // STEP_FRAMES] and not looking.may[55 * FRAME_HZ // STEP_FRAMES]


def test_counts_of_a_person_are_his_own():
    found, _ = event_trainer.count(student(person(answering()), np.random.default_rng(0)), answering()[:, 0])
    assert found["nods_per_minute"][0] == len(answering())
    ratio = event_trainer.figures(found)["phrase_end_ratio"]
    assert ratio > 3 or np.isnan(ratio)


@pytest.mark.parametrize(
    ("data", "out", "problem"), [("none", "a.yaml", "no such folder"), (".", "gone/a.yaml", "--out")]
)
def test_a_folder_that_is_not_there_is_one_line(tmp_path, data, out, problem):
    with pytest.raises(ConfigError, match=problem) as raised:
        train_events(tmp_path / data, tmp_path / out, False, 1)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", ["gaze_shift", "laugh"])
def test_meetings_in_which_nobody_does_it_teach_nobody_and_say_so(tmp_path, kind):
    write_tables(tmp_path, lacking=kind)
    with pytest.raises(ConfigError, match=f"there is no {kind}") as raised:
        train_events(tmp_path, None, False, 1)
    assert "\n" not in str(raised.value) and str(tmp_path) in str(raised.value)


def test_without_people_of_validation_nothing_is_ranked(tmp_path):
    write_tables(tmp_path)
    found = train_events(tmp_path, tmp_path / "events.yaml", False, 1)
    assert found["people"]["validation"] == 0 and "rollout" not in found
    assert load_tables(tmp_path / "events.yaml").hazards["nod"].per_minute > 1


def test_one_person_of_validation_is_ranked_without_an_interval(tmp_path):
    write_tables(tmp_path, meetings=("ES2002a", "IS1000a"))
    found = train_events(tmp_path, None, False, 1)
    nods, row = found["kinds"]["nod"], found["rows"][0]
    assert nods["interval"] == [None, None] and row["AUC on validation"] == f"{nods['auc']:.3f}"


def test_smiles_last_as_long_as_composed_ones_and_what_is_saved_is_loaded(tmp_path):
    shipped = EventModel.load().tables
    for kind, (least, most) in {"smile": (2.5, 4.5), "laugh": (2.5, 4.5)}.items():
        assert least < np.median(shipped.shapes[kind].duration_s) < most
    save(tmp_path / "events.yaml", shipped)
    assert load_tables(tmp_path / "events.yaml") == shipped and "Carletta" in (tmp_path / "events.yaml").read_text()
