"""A listener that nods where people do scores as they do, at random it does not; scenes hold what was."""

import numpy as np
import pytest

from sfms_robot.corpora.compose.ami import Person, phrases
from sfms_robot.corpora.compose.motions import load as load_motions
from sfms_robot.corpora.compose.voices import read_voice
from sfms_robot.data import data_dir
from sfms_robot.evaluation import timing
from sfms_robot.evaluation.nod_table import Counts, NodTable
from sfms_robot.evaluation.rollout import rollout, speaker_frames
from sfms_robot.evaluation.timing import Answer, Scene
from sfms_robot.frames import FRAME_HZ, FRAME_S, Plan
from sfms_robot.signals.events import voice_activity

NONE = np.zeros((0, 2))
MINUTES = 40


def spans(starts_s, length_s=0.8):
    starts = np.asarray(starts_s, float)
    return np.stack([starts, starts + length_s], axis=1)


def talk(minutes=MINUTES, seed=0):
    """(N,) talk in phrases of 1 to 8 s with pauses of 0.4 to 3 s."""
    rng = np.random.default_rng(seed)
    pieces, total = [], 0
    while total < minutes * 60 * FRAME_HZ:
        piece = np.r_[np.ones(rng.integers(25, 200), bool), np.zeros(rng.integers(10, 75), bool)]
        pieces.append(piece)
        total += len(piece)
    return np.concatenate(pieces)[: minutes * 60 * FRAME_HZ]


def scene(nods_s, others=None, name="M1a_A", series="M1"):
    others = talk() if others is None else others
    silent = np.zeros(len(others), bool)
    return Scene(name, series, (), spans(nods_s), others, silent, silent, laughs=0, gaze_shifts=None)


def ends_of(others, least_s=3.0):
    bounds = np.flatnonzero(np.diff(np.r_[0, others.astype(int), 0]))
    return np.array(
        [b / FRAME_HZ for a, b in zip(bounds[::2], bounds[1::2], strict=True) if b - a > least_s * FRAME_HZ]
    )


def answer(*runs):
    return Answer(tuple(spans(run) for run in runs), (0.1,), blinks=0, smiles=0, gaze_shifts=0)


def anywhere(count, seed=0, minutes=MINUTES):
    return np.sort(np.random.default_rng(seed).uniform(0, minutes * 60 - 2, count))


def tables():
    """A table that has seen people who nod right behind long phrases."""
    one = scene(ends_of(talk(seed=5)) + 0.3, talk(seed=5))
    return NodTable({"other": Counts.of(one.cell, one.onsets, one.listening)})


def figures(nods_s, *runs, others=None):
    one = scene(nods_s, others)
    return timing.summary([one], [answer(*runs)], tables(), seed=1)[0]


def test_a_listener_who_nods_as_the_people_do_has_their_figures():
    nods = ends_of(talk())[::3] + 0.3
    found = figures(nods, nods, nods)
    for key in ("nods_per_minute", "nods_after_long_phrase", "nods_first_second", "nods_late_in_phrase"):
        assert found[key] == found[f"people_{key}"]
    assert found["nod_auc"] == 1.0
    assert found["nods_per_minute"] == pytest.approx(len(nods) / 40, rel=0.1)


def test_random_nods_rank_nothing_and_know_no_phrase_ends():
    runs = [anywhere(4000, seed) for seed in range(8)]
    found = figures(ends_of(talk())[::2] + 0.3, *runs)
    assert found["nod_auc"] == pytest.approx(0.5, abs=0.06)
    assert found["phrase_end_ratio"] == pytest.approx(1.0, abs=0.15)
    assert found["table_nod_auc"] > 0.8


def test_the_table_ranks_random_people_at_a_half():
    found = figures(anywhere(1500, 3), anywhere(80))
    assert found["table_nod_auc"] == pytest.approx(0.5, abs=0.04)


def test_few_seeds_cost_the_table_itself_most_of_its_auc():
    """At two nods a minute 8 runs leave three quarters of the instants without any nod to rank them by."""
    nods = ends_of(talk())[::2] + 0.3
    found = figures(nods, *[anywhere(80, seed) for seed in range(8)])
    assert 0.5 < found["sampled_table_nod_auc"] < found["table_nod_auc"] - 0.05


def test_the_phase_of_own_nods_is_told_without_the_lot():
    nods = ends_of(talk())
    found = figures(nods[::2] + 0.3, *(nods[start::40] + 0.3 for start in range(8)))
    assert found["phase_nod_auc"] > 0.8 > found["nod_auc"]


def test_somebody_who_never_nods_has_no_auc():
    found = figures([], anywhere(10))
    assert found["nod_auc"] is None and found["people_phrase_end_ratio"] is None
    assert found["people_nods_per_minute"] == 0


def test_a_listener_who_never_nods_scores_a_half():
    found = figures(ends_of(talk())[::2] + 0.3, [], [])
    assert found["nod_auc"] == 0.5 and found["nods_per_minute"] == 0 and found["phrase_end_ratio"] is None


def test_rates_are_means_over_seeds():
    once, twice = figures([], anywhere(100)), figures([], anywhere(100), anywhere(100))
    assert once["nods_per_minute"] == twice["nods_per_minute"]


def test_time_off_camera_and_own_talk_are_no_listening():
    one = scene([])
    hidden = np.zeros(len(one.others), bool)
    hidden[: len(hidden) // 2] = True
    for changed in ({"unseen": hidden}, {"own": hidden}):
        half = Scene(**{**vars(one), **changed})
        assert not half.listening[: len(hidden) // 2].any()
        assert not timing.kinds_of_time(half)["long_silence"][: len(hidden) // 2].any()


def test_people_are_spread_evenly_over_the_meetings():
    people = list(range(134))
    assert timing.choose_people(people, 3) == [0, 66, 133]
    assert timing.choose_people(people, None) == timing.choose_people(people, 500) == people


@pytest.fixture(scope="module")
def person():
    others = phrases([(start, start + 3.0) for start in np.arange(1, 295, 5.0)])
    nods = np.array([(start + 3.2, start + 4.0) for start in np.arange(1, 290, 10.0)])
    return Person(
        "M1a", "B", "MEE1", 300.0, nods=nods, shakes=NONE, tilts=NONE, unseen=NONE,
        gaze=((0.0, 140.0, "A"), (140.0, 150.0, "table"), (150.0, 300.0, "A")), laughs=np.array([[150.0, 151.0]]),
        talk=NONE, backchannels=NONE, others=others, floor=(), others_laughs=NONE, asked=np.zeros(0),
    )  # fmt: skip


def test_a_scene_is_the_middle_of_the_meeting_as_it_was(person):
    voice = read_voice(data_dir("sim") / "speakers" / "katie" / "speech.wav")
    motions = load_motions(data_dir("sim") / "listeners" / "motions.npz")["validation"]
    one = timing.scene(person, 2.0, [voice], motions, np.random.default_rng(0))
    assert one.minutes == 2 and len(one.speaker) == 3000 and one.series == "M1"
    np.testing.assert_allclose(one.nods_s[0], person.nods[person.nods[:, 0] >= 90][0] - 90)
    assert one.laughs == 1 and one.gaze_shifts == 2
    heard = voice_activity(np.concatenate([frame.audio for frame in one.speaker]))
    assert (heard == one.others).mean() > 0.8


def test_a_table_is_fitted_by_series(person):
    table = timing.fit_table([person])
    assert set(table.series) == {"M1"}
    assert table.series["M1"].nods.sum() == pytest.approx(len(person.nods), abs=1)
    assert table.series["M1"].minutes.sum() == pytest.approx(5, abs=0.5)


class Metronome:
    """Listens to nobody: after every 4th frame a plan of 8, whose pitch is the seed plus the frames heard so far."""

    hop, horizon = 4, 8

    def start(self, seed):
        return (seed, 0)

    def step(self, speaker, memory):
        seed, heard = memory
        plan = None
        if heard % self.hop == 0:
            times_s = speaker.time_s + FRAME_S * np.arange(1, 9)
            plan = Plan(speaker.time_s, times_s, np.full((8, 58), seed + heard / 100, np.float32))
        return plan, (seed, heard + 1)


class Choir(Metronome):
    """The same, all streams at once."""

    def step_many(self, speaker, memories):
        steps = [self.step(speaker, memory) for memory in memories]
        return [plan for plan, _ in steps if plan is not None], [memory for _, memory in steps]


def test_streams_one_by_one_and_side_by_side_are_rolled_out_alike():
    speaker = speaker_frames(None, np.full((30, 58), np.nan, np.float32))
    alone = rollout(Metronome(), speaker, [3, 5]).motion
    np.testing.assert_array_equal(alone, rollout(Choir(), speaker, [3, 5]).motion)
    np.testing.assert_allclose(alone[:, [1, 4, 5, 29], 1], [[3, 3, 3.04, 3.28], [5, 5, 5.04, 5.28]], rtol=1e-6)
    assert not alone[:, 0].any()  # nothing is planned yet while the first frame is heard
