"""Hazards are recovered from events drawn by known ones; lessons and roll-outs are what happened.

With SFMS_ROBOT_AMI=DIR (a folder with the AMI tables) the hazard of nods is taught on all meetings and compared with
what others found in them.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from ami_tables import UNTIL_S, words, write_tables

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ
from sfms_robot.lab.corpora.compose.ami import MeetingPerson, phrases
from sfms_robot.lab.evaluation.whole_recordings import Scene, counts_in
from sfms_robot.lab.learning.events import event_rollout, event_trainer
from sfms_robot.lab.learning.events.event_trainer import GROUPS, hazard, inputs, ranked, student, teach
from sfms_robot.lab.learning.events.labels import lesson, looks_of, meeting_evidence
from sfms_robot.listeners.events.evidence import AT
from sfms_robot.listeners.events.model import EventModel, HazardBank, load_tables

NONE = np.zeros((0, 2))


def person(nods=NONE, other=None, **more):
    """A listener who says nothing, in a meeting with one other."""
    other = words(0) if other is None else other
    talk = phrases(map(tuple, other.tolist()))
    given = {
        "shakes": NONE, "tilts": NONE, "unseen": NONE, "gaze": None, "laughs": NONE, "talk": NONE,
        "backchannels": NONE, "others_laughs": NONE, "asked": np.zeros(0),
    } | more  # fmt: skip
    return MeetingPerson(
        meeting="M1a", agent="A", participant="one", until_s=UNTIL_S, nods=nods, others=talk,
        floor=tuple((a, b, "B") for a, b in talk), words={"A": NONE, "B": other}, **given,
    )  # fmt: skip


def answering():
    """Nods 0.4 s after every second phrase."""
    starts = np.round(phrases(map(tuple, words(0).tolist()))[::2, 1] + 0.4, 2)
    return np.stack([starts, starts + 0.6], axis=1)


def test_a_known_hazard_is_recovered():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(60_000, 3)).astype(np.float32)
    truth = np.array([1.0, -0.5, 0.0])
    happens = (rng.random(len(rows)) < 1 / (1 + np.exp(3 - rows @ truth))).astype(float)
    found = event_trainer.fit(rows, happens, np.ones(len(rows)))
    assert found.intercept == pytest.approx(-3, abs=0.06)
    np.testing.assert_allclose(found.weights, truth, atol=0.05)


def test_a_row_that_counts_twice_is_two_rows_and_a_ridge_shrinks():
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
    meeting = meeting_evidence(person())
    share = np.diff(words(0), axis=1).sum() / UNTIL_S
    assert meeting.speaks[:, 1].mean() == pytest.approx(share, rel=0.03)
    assert not meeting.speaks[:, 0].any() and np.isnan(meeting.looks).all()
    assert meeting.listening[meeting.speaks[:, 1]].all()


def test_who_nods_behind_phrases_is_learned_to_and_a_random_one_is_not():
    rng = np.random.default_rng(0)
    people = [student(person(answering()), rng)]
    learned = hazard(teach(people, "nod", GROUPS["nod"], ridge=1.0), GROUPS["nod"], "a test", 3.0)
    bank = HazardBank({"nod": learned})
    score = lambda rows: bank.log_odds(bank.contributions(rows))[:, 0]  # noqa: E731
    assert ranked(people, "nod", score).mean > 0.9
    starts = np.sort(np.random.default_rng(2).uniform(5, 590, 60)).round(2)
    by_lot = [student(person(np.stack([starts, starts + 0.3], axis=1)), rng)]
    assert 0.3 < ranked(by_lot, "nod", score).mean < 0.7


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
    early = person(answering()[:10], cut[cut[:, 1] < 300])
    other = student(early, np.random.default_rng(0))
    steps = int(min(answering()[10, 0], 299.0) / 0.08)
    annotated = [at for name, at in AT.items() if name not in ("smile_end_s", "brow_raise_end_s")]
    np.testing.assert_array_equal(whole.evidence[:steps, annotated], other.evidence[:steps, annotated])


def test_a_look_away_is_from_somebody_who_speaks():
    gaze = ((0.0, 50.0, "B"), (50.0, 52.0, "table"), (52.0, 60.0, "slide-screen"), (60.0, 600.0, "B"))
    one = person(gaze=gaze)
    meeting = meeting_evidence(one)
    scene = Scene(meeting.speaks, meeting.looks, meeting.laughs, meeting.nods, meeting.nods)
    looks = looks_of(one, meeting, counts_in(scene))
    assert looks.away_s.tolist() == [50.0]
    assert looks.aside.tolist()[1:3] == [True, True]
    assert looks.at_speaker[40 * FRAME_HZ] and not looks.at_speaker[55 * FRAME_HZ]


def test_a_roll_out_nods_while_listening_only_and_more_with_the_knob():
    one = student(person(), np.random.default_rng(0))
    model = EventModel.load()
    counts = []
    for knob in (0.5, 2.2, 10.0):
        nods = event_rollout.roll_out(model, one, knob, seed=1)
        starts = np.array([nod.start_s for nod in nods])
        assert one.listening[np.round(starts * FRAME_HZ).astype(int)].all()
        assert all(b.start_s >= a.end_s - 1e-9 for a, b in zip(nods, nods[1:], strict=False))
        counts.append(len(nods))
    assert counts == sorted(counts) and counts[-1] > counts[0]


def test_counts_of_a_person_are_his_own():
    one = student(person(answering()), np.random.default_rng(0))
    found = event_rollout.count(one, event_rollout.people_did(one))
    assert found.listening[0] == len(answering())
    assert found.ratio > 3 or np.isnan(found.ratio)
    assert event_rollout.interval_distance(found, found) == 0


@pytest.mark.parametrize(
    ("data", "out", "problem"), [("none", "a.yaml", "no such folder"), (".", "gone/a.yaml", "--out")]
)
def test_a_folder_that_is_not_there_is_one_line(tmp_path, data, out, problem):
    from sfms_robot.lab.learning.events.event_training import train_events

    with pytest.raises(ConfigError, match=problem) as raised:
        train_events(tmp_path / data, tmp_path / out, False, 1)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", ["gaze_shift", "laugh"])
def test_meetings_in_which_nobody_does_it_teach_nobody_and_say_so(tmp_path, kind):
    from sfms_robot.lab.learning.events.event_training import train_events

    write_tables(tmp_path, lacking=kind)
    with pytest.raises(ConfigError, match=f"there is no {kind}") as raised:
        train_events(tmp_path, None, False, 1)
    assert "\n" not in str(raised.value) and str(tmp_path) in str(raised.value)


def test_without_people_of_validation_nothing_is_ranked(tmp_path):
    from sfms_robot.lab.learning.events.event_training import train_events

    write_tables(tmp_path)
    found = train_events(tmp_path, tmp_path / "events.yaml", False, 1)
    assert found["people"]["validation"] == 0 and "rollout" not in found
    assert load_tables(tmp_path / "events.yaml").hazards["nod"].per_minute > 1


def test_smiles_last_as_long_as_composed_ones():
    tables = EventModel.load().tables
    for kind, (least, most) in {"smile": (2.5, 4.5), "laugh": (2.5, 4.5)}.items():
        assert least < np.median(tables.shapes[kind].duration_s) < most


def test_what_is_saved_is_loaded(tmp_path):
    from sfms_robot.lab.learning.events.event_training import save

    shipped = EventModel.load().tables
    save(tmp_path / "events.yaml", shipped)
    assert load_tables(tmp_path / "events.yaml") == shipped
    assert "Carletta" in (tmp_path / "events.yaml").read_text()


# --- the meetings themselves ------------------------------------------------------------------------------------


# R2 of a study of the same 36 meetings and 134 listeners, in the order of `event_trainer.NOD`, as printed there.
STUDY = {
    "phrase_s": (0.20, -0.02, -0.18, -0.26, -0.24, 0.00, 0.20, 0.33, 0.34),
    "silence_s": (0.19, 0.35, 0.41, 0.27, -0.14, 0.08, -0.39, -0.32),
    "last_phrase_s": (0.04, 0.12, -0.08, -0.07, 0.07, 0.05, 0.07),
    "one_speaks": (-0.12,),
    "several_speak": (0.17,),
    "floor_mine": (-0.41,),
    "floor_s": (0.12, -0.14, -0.18, 0.00, 0.04, 0.19, 0.20, 0.18),
    "holder_silence_s": (-0.01, 0.08, -0.04, 0.40, 0.50, 0.40, 0.08, -0.09, -0.46),
    "own_voice_s": (1.37, 1.28, 0.92, 0.40, 0.25, 0.12, 0.14, 0.05, -0.01),
    "nod_end_s": (-0.08, -0.53, -0.62, 0.70, 0.73, 0.73, 0.53, 0.30, 0.43),
    "root_nods_30s": (0.20,),
    "log_rate": (0.76,),
    "gaze_known": (-0.18,),
    "looked_at": (0.77,),
    "looked_at_s": (-0.39, -0.05, 0.42, 0.57, 0.06, 0.16),
    "looked_at_silence_s": (0.10, 0.37, 0.21, 0.12),
    "laugh_s": (0.01, -0.31, -0.44, -0.24, -0.15),
    "others_nod_s": (0.73, 0.73, 0.56, 0.10, 0.07, -0.03),
}


@pytest.mark.slow
@pytest.mark.skipif("SFMS_ROBOT_AMI" not in os.environ, reason="AMI tables: SFMS_ROBOT_AMI=DIR")
def test_all_meetings_teach_what_a_study_found_in_them():
    """To what another sixth of the steps leaves, but for instants at which a step begins (docs/science/listening.md).

    Those are the value just as an own nod ends (-0.08 there, some 0.3 here) and, of a silence of over 2 s, two that
    cannot occur here.
    """
    from sfms_robot.lab.learning.events.event_training import train_events

    found = train_events(Path(os.environ["SFMS_ROBOT_AMI"]), None, True, seed=1)["nod"]
    assert found["intercept"] == pytest.approx(-7.44, abs=0.12)
    off = {}
    for name, printed in STUDY.items():
        weight = found["weights"][name]
        values = list(weight.values()) if isinstance(weight, dict) else [weight]
        for index, value in enumerate(printed):
            off[name, index] = values[index] - value
    assert abs(off.pop(("nod_end_s", 0))) < 0.5
    assert max(abs(value) for value in off.values()) < 0.2
    assert np.sqrt(np.mean(np.square(list(off.values())))) < 0.06
