"""Hazards asked with a given history go by it; decisions go by their own, whatever is decided beside them."""

import numpy as np
import pytest
from ami_tables import write_tables

from sfms_robot.config import Calmness
from sfms_robot.frames import EVENT_KINDS, FRAME_HZ, FRAME_S, FRAME_SAMPLES
from sfms_robot.lab.corpora.compose.ami import read_people
from sfms_robot.lab.evaluation import timing
from sfms_robot.lab.evaluation.listener_meetings import SHIFT_S, ListenerMeeting, shifted
from sfms_robot.lab.evaluation.meetings import annotated, sensed
from sfms_robot.lab.evaluation.rollout import speaker_frames
from sfms_robot.lab.evaluation.whole_recordings import Scene, decisions, event_spans, hazards_in, heard_in, unspoken
from sfms_robot.lab.learning.events.event_trainer import meeting_scene, muted, student
from sfms_robot.listeners.events.evidence import AT, HEARD, Sensed
from sfms_robot.listeners.events.model import STEP_FRAMES, EventModel, EventTables
from sfms_robot.signals.audio import AudioFile
from sfms_robot.signals.events import runs
from sfms_robot.sources.registry import shipped_speaker

MINUTES = 6
FRAMES = MINUTES * 60 * FRAME_HZ
SHIFT_FRAMES = round(SHIFT_S * FRAME_HZ)


def model(intercept=-4.0, **nod_weights):
    """Nothing ever happens but nods, by these weights."""
    never = {"learned_from": "nobody", "per_minute": 1.0, "intercept": -30.0, "weights": {"gaze_known": 0.0}}
    hazards = dict.fromkeys(EVENT_KINDS, never)
    hazards["nod"] = {**never, "intercept": intercept, "weights": nod_weights}
    shape = {"duration_s": (0.4, 0.6), "size": (4.0, 5.0), "swings_hz": (2.0, 2.5)}
    return EventModel(EventTables(hazards=hazards, shapes=dict.fromkeys(EVENT_KINDS, shape)))


PHASE = {"silence_s": {0.0: -3.0, 0.1: 3.0, 0.8: 3.0, 1.0: -3.0}}
HISTORY = {"nod_end_s": {0.0: -3.0, 0.5: 3.0, 2.0: 3.0, 3.0: -3.0}}


@pytest.fixture(scope="module")
def talk():
    """(N,) phrases of 1 to 4 s with pauses of 0.4 to 1.6 s."""
    rng = np.random.default_rng(1)
    pieces = [np.r_[np.ones(rng.integers(25, 100), bool), np.zeros(rng.integers(10, 40), bool)] for _ in range(400)]
    return np.concatenate(pieces)[:FRAMES]


@pytest.fixture(scope="module")
def speaker(talk):
    noise = np.random.default_rng(2).standard_normal(FRAMES * FRAME_SAMPLES).astype(np.float32)
    audio = noise * np.where(np.repeat(talk, FRAME_SAMPLES), np.float32(0.1), np.float32(1e-4))
    return speaker_frames(audio, np.full((FRAMES, 58), np.nan, np.float32))


def meeting(talk, nods_s):
    silent, spans = np.zeros(FRAMES, bool), np.stack([nods_s, nods_s + 0.5], axis=1)
    return ListenerMeeting(
        participant="A", speaker=(), spans_s={"nod": spans}, aside=np.zeros(0, bool), others=talk, own=silent,
        unseen=silent, alone=talk, attention=np.full(FRAMES, np.nan),
    )  # fmt: skip


def contingency(decides, speaker, one):
    """AUC matched, and matched minus shifted."""
    heard = (sensed(frames, Calmness())[1] for frames in (speaker, shifted(speaker)))
    matched, other = (hazards_in(decides, each, one.history, Calmness())["nod"] for each in heard)
    found = timing.contingent("", "x", matched, [other], one)
    return found["x"][0] / found["x"][1], found["x_matched_minus_shifted"][0] / found["x"][1]


def test_shifting_destroys_hazards_of_speech_phase(talk, speaker):
    ends = np.array([end for _, end in runs(talk)]) / FRAME_HZ
    auc, gained = contingency(model(**PHASE), speaker, meeting(talk, ends[:-1] + 0.3))
    assert auc > 0.8 and gained > 0.25


def test_shifting_leaves_hazards_of_own_history_as_they_were(talk, speaker):
    first = np.arange(3.0, MINUTES * 60 - 5, 20.0)
    auc, gained = contingency(model(**HISTORY), speaker, meeting(talk, np.sort(np.r_[first, first + 1.7])))
    assert auc > 0.6 and abs(gained) < 0.03


def test_what_has_not_begun_changes_no_hazard(talk, speaker):
    one, decides = meeting(talk, np.arange(2.0, 300.0, 5.0)), model(**HISTORY)
    heard = sensed(speaker[:3000], Calmness())[1]
    whole = hazards_in(decides, heard, one.history, Calmness())["nod"]
    early = [event for event in one.history if event.start_s < 60.0]
    begun = hazards_in(decides, heard, early, Calmness())["nod"]
    np.testing.assert_array_equal(whole[: 60 * FRAME_HZ - 1], begun[: 60 * FRAME_HZ - 1])
    assert (whole != begun).any()


def test_a_seed_decides_the_same_alone_and_beside_others(speaker):
    decides, heard = model(-3.0, **PHASE), sensed(speaker[:3000], Calmness())[1]
    together = decisions(decides, heard, [1, 2, 3], Calmness())
    assert together == [decisions(decides, heard, [seed], Calmness())[0] for seed in (1, 2, 3)]
    assert together[0] != together[1]
    nods = event_spans(together[0], "nod")
    assert len(nods) > 3 and (np.diff(nods[:, 0]) > 0).all() and not len(event_spans(together[0], "blink"))


@pytest.mark.parametrize("asked", [Calmness(), Calmness(nod=0, blink=60), Calmness(nod=40, addressed="never")])
def test_what_is_decided_is_what_deciding_every_frame_decides(speaker, asked):
    when = EventModel.load()
    _, heard = sensed(speaker[:4000], asked)
    memory, every = when.start(7, asked), []
    for index, row in enumerate(heard):
        ((decided, memory),) = when.decide_each([Sensed(index, row)], [memory])
        every += decided
    assert decisions(when, heard, [7], asked) == [tuple(every)] and "blink" in {event.kind for event in every}


# Deciles of the lengths [s] of phrases and of pauses in meetings: of oneself, and of the others.
TURNS_S = (
    ((0.03, 0.3, 0.4, 0.6, 1, 1.5, 2.4, 3.9, 6.4, 11.7, 30), (0.2, 1.1, 1.5, 2, 2.8, 4.1, 6, 9.2, 15.7, 31.9, 120)),
    ((0.03, 0.3, 0.6, 1.1, 1.9, 2.9, 4.6, 6.8, 10.5, 17.8, 40), (0.2, 0.4, 0.7, 1, 1.2, 1.5, 1.9, 2.6, 4.1, 7.7, 30)),
)


def turns(deciles_s, frames, rng):
    """(frames,) pauses and phrases of these lengths, one after the other."""
    phrases, pauses = ([np.interp(rng.random(2000), np.linspace(0, 1, 11), each)] for each in deciles_s)
    lengths = np.concatenate([*pauses, *phrases]).reshape(2, -1).T.ravel() * FRAME_HZ
    return np.repeat(np.tile([False, True], 2000), np.round(lengths).astype(int))[:frames]


@pytest.mark.parametrize("speaks", [True, False])
def test_a_rate_is_true_of_a_head_that_speaks_and_of_one_that_never_does(speaks):
    rng, frames = np.random.default_rng(1), 60 * 60 * FRAME_HZ
    asked = {"nod": 2.0, "smile": 1.2, "brow_raise": 1.0, "mm_hm": 1.2}
    voices = np.stack([turns(each, frames, rng) for each in TURNS_S], axis=1)
    shares = ((0.02, 50), (0.01, 50), (0.08, 20))  # of laughs, smiles, two others at once: a table of four
    laughs, smiles, joins = (np.repeat(rng.random(frames // each) < share, each) for share, each in shares)
    voices, nods = np.c_[voices, voices[:, 1] & joins], rng.random(frames) < 5.8 / 60 / FRAME_HZ
    scene = Scene(voices, np.full(voices.shape, np.nan), laughs, nods, 0.6 * (laughs | smiles))
    heard = heard_in(scene if speaks else unspoken(scene))
    decided = decisions(EventModel.load(), heard, range(8), Calmness(**asked, blink=0, gaze_shift=0))
    listening = (heard[:, AT["silence_s"]] <= 2.0) & (heard[:, AT["own_voice_s"]] > 0)
    for kind, rate in asked.items():
        count = sum(len(event_spans(events, kind)) for events in decided)
        assert count / (8 * listening.sum() / FRAME_HZ / 60) == pytest.approx(rate, rel=0.15), kind


@pytest.mark.slow
def test_seeds_scatter_as_people_do_and_some_do_not_nod_in_the_demo_at_all():
    """Three hundred seeds hear the person of the demo for 48 s. Counts of people vary by 1.28 to 1.82 of their mean."""
    recording = AudioFile(shipped_speaker("facegood_1114_3_16").audio)
    voice = recording.read(recording.length)
    recording.close()
    frames, when = len(voice) // FRAME_SAMPLES, EventModel.load()
    unseen = np.full((frames, 58), np.nan, np.float32)
    _, heard = sensed(speaker_frames(voice[: frames * FRAME_SAMPLES], unseen), Calmness())
    counts = np.array([len(event_spans(events, "nod")) for events in decisions(when, heard, range(300), Calmness())])
    assert 3 <= counts.mean() / (frames * FRAME_S / 60) <= 7, "addressed: as many a minute as people's"
    assert 1.28 <= counts.var(ddof=1) / counts.mean() <= 1.82 and 0.03 <= (counts == 0).mean() <= 0.15


def test_what_annotators_saw_is_what_hazards_were_taught_on(tmp_path):
    person = read_people(write_tables(tmp_path, until_s=120.0))[0]
    frames = int(person.until_s * FRAME_HZ)
    own, alone, elsewhere = annotated(meeting_scene(person)[0], frames)
    one = student(person, np.random.default_rng(0))
    for given, told in ((one, own), (muted(one), alone)):
        taught = given.evidence[1:, : len(HEARD)]  # as steps begin
        seen = told[STEP_FRAMES - 1 :: STEP_FRAMES][: len(taught)]
        same = [name not in ("others_smile_s", "others_smile") for name in HEARD]  # those are drawn for the student
        assert np.array_equal(seen[:, same], taught[:, same], equal_nan=True)
    assert not np.array_equal(own, alone, equal_nan=True)
    assert np.array_equal(elsewhere[SHIFT_FRAMES:], alone[:-SHIFT_FRAMES], equal_nan=True)
