"""A meeting around one listener is what was annotated; shifting moves the others and leaves him where he was."""

import numpy as np
import pytest
from made_dyads import meeting_person

from sfms_robot.data import data_dir
from sfms_robot.frames import FRAME_HZ, FRAME_S, FaceFrame, SpeakerFrame
from sfms_robot.lab.corpora.compose.ami import phrases
from sfms_robot.lab.corpora.compose.voices import read_voice
from sfms_robot.lab.corpora.phrase_timing import voice_activity
from sfms_robot.lab.evaluation.listener_meetings import SHIFT_S, listener_meeting, part, shifted
from sfms_robot.signals.motion_primitives import read_motions


@pytest.fixture(scope="module")
def person():
    """A speaks for 3 s of every 5, and looks at B in the first minute alone; C says a word meanwhile now and then."""
    starts = np.arange(1.0, 115.0, 5.0)
    a = [(start, start + 3.0, "A") for start in starts]
    c = [(start + 1.0, start + 1.5, "C") for start in starts[::4]]
    return meeting_person(
        until_s=120.0,
        nods=np.stack([starts + 3.2, starts + 4.0], axis=1),
        unseen=np.array([[100.0, 110.0]]),
        gaze=((2.0, 40.0, "A"), (40.0, 50.0, "table"), (50.0, 120.0, "A")),
        laughs=np.array([[50.0, 51.0]]),
        talk=np.array([[80.0, 82.0]]),
        others=phrases((start, end) for start, end, _ in (*a, *c)),
        floor=tuple(sorted(a + c)),
        looked_at=((0.0, 60.0, "A"),),
        gaze_known=frozenset("A"),
    )


@pytest.fixture(scope="module")
def one(person):
    voice = read_voice(data_dir("sim") / "speakers" / "katie" / "speech.flac")
    motions = read_motions(data_dir("sim") / "listeners" / "motions.npz")["validation"]
    return listener_meeting(person, [voice], [], motions, np.random.default_rng(0))


def at(seconds):
    return round(seconds * FRAME_HZ)


def test_it_is_as_it_was(person, one):
    assert one.frames == len(one.speaker) == at(120) and one.participant == person.participant
    np.testing.assert_array_equal(one.spans_s["nod"], person.nods)
    assert len(one.spans_s["laugh"]) == 1 and one.aside.tolist() == [False, True, False]
    assert (voice_activity(np.concatenate([frame.audio for frame in one.speaker])) == one.others).mean() > 0.8
    assert not one.listening[at(100) : at(110)].any() and not one.listening[at(80) : at(82)].any()


def test_the_speaker_looks_at_him_as_annotated_and_two_at_once_speak_to_nobody(one):
    assert np.isnan(one.attention[: at(1)]).all()  # nobody has the floor yet
    assert (one.attention[at(1.1) : at(1.9)] == 1).all() and (one.attention[at(61.5) : at(61.9)] == 0).all()
    assert [frame.attention for frame in one.speaker[at(2) : at(2) + 3]] == [1.0, 1.0, 1.0]
    assert all(frame.face is not None for frame in one.speaker) and one.alone[at(1.5)] and not one.alone[at(2.2)]
    assert one.addressed[at(1.5)] and not one.addressed[at(2.2)]
    assert one.bystander[at(66.5)] and not one.addressed[at(66.5)]


def test_his_history_is_his_events_in_order(one):
    starts = [event.start_s for event in one.history]
    assert starts == sorted(starts)
    assert {event.kind for event in one.history} == {"nod", "laugh", "gaze_shift"}
    looks = [event.target_rad for event in one.history if event.kind == "gaze_shift"]
    assert [look == (0.0, 0.0) for look in looks] == [True, False, True]


def test_inside_a_nod_is_after_its_first_instant_and_before_its_end(one):
    start, end = one.spans_s["nod"][0]
    over_s = (np.flatnonzero(one.inside("nod")) + 1) * FRAME_S
    first = over_s[over_s < start + 2]
    assert start < first.min() <= start + FRAME_S + 1e-9 and end - FRAME_S - 1e-9 <= first.max() < end
    assert (one.instants("nod")[0] + 1) * FRAME_S <= start + 1e-9


def test_a_look_aside_might_begin_while_he_looks_at_the_speaker_and_nods_where_none_is_under_way(one):
    onsets, might = one.begins("gaze_shift")
    assert onsets.tolist() == [at(40) - 1]
    assert one.looks_at_speaker[at(2.1) : at(40)].all() and not one.looks_at_speaker[at(40) : at(50)].any()
    assert not (might & ~one.listening).any() and might[at(39)]
    onsets, might = one.begins("nod")
    assert not (might & one.inside("nod")).any() and might[onsets].all() and len(onsets) > 15


def frames(count):
    """Each says in every input which one it is."""
    return [
        SpeakerFrame(
            (index + 1) * FRAME_S,
            np.full(640, index, np.float32),
            FaceFrame((index + 1) * FRAME_S, np.full(6, index, np.float32), np.zeros(52, np.float32)),
            np.full(640, -index, np.float32),
            float(index % 2),
        )
        for index in range(count)
    ]


@pytest.mark.parametrize(("count", "by"), [(1510, 1500), (1500, 0)])
def test_shifting_puts_another_minute_in_the_place_of_each(count, by):
    assert round(SHIFT_S * FRAME_HZ) % count == by
    before = frames(count)
    late = shifted(before)
    assert len(late) == count and all(frame is before[index - by] for index, frame in enumerate(late))


def test_a_part_is_timed_from_its_own_beginning():
    cut = part(frames(20), 5, 3)
    assert [frame.time_s for frame in cut] == pytest.approx([0.04, 0.08, 0.12])
    assert [frame.audio[0] for frame in cut] == [5, 6, 7] and cut[0].face.time_s == cut[0].time_s
