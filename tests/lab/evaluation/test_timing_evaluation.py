"""Who nods as people do has their figures, at random none; what follows others is lost when they are shifted."""

import numpy as np
import pytest
from made_dyads import meeting_person

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, Plan
from sfms_robot.lab.evaluation import timing
from sfms_robot.lab.evaluation.detection import Detected, DetectorCalibration, Sightings
from sfms_robot.lab.evaluation.intervals import estimates
from sfms_robot.lab.evaluation.listener_meetings import ListenerMeeting
from sfms_robot.lab.evaluation.meetings import middle, people_of
from sfms_robot.lab.evaluation.rollout import rollout, speaker_frames, spread
from sfms_robot.lab.evaluation.timing import CELLS, cells
from sfms_robot.signals.phase import times

MINUTES = 40
FRAMES = MINUTES * 60 * FRAME_HZ


def spans(starts_s, length_s=0.6):
    starts = np.asarray(starts_s, float)
    return np.stack([starts, starts + length_s], axis=1)


def talk(seed=0):
    """(N,) talk in phrases of 1 to 8 s with pauses of 0.4 to 3 s."""
    rng = np.random.default_rng(seed)
    pieces = [np.r_[np.ones(rng.integers(25, 200), bool), np.zeros(rng.integers(10, 75), bool)] for _ in range(1800)]
    return np.concatenate(pieces)[:FRAMES]


def meeting(nods_s, others=None, participant="A", **changed):
    others = talk() if others is None else others
    silent = np.zeros(len(others), bool)
    whole = {
        "participant": participant, "speaker": (), "spans_s": {"nod": spans(nods_s)},
        "aside": np.zeros(0, bool), "others": others, "own": silent, "unseen": silent, "alone": others,
        "attention": np.full(len(others), np.nan),
    }  # fmt: skip
    return ListenerMeeting(**whole | changed)


def ends_of(others):
    """Seconds at which talk ends."""
    return np.flatnonzero(np.diff(others.astype(int)) == -1) / FRAME_HZ + FRAME_S


def answering(others, share=0.4, seed=0):
    """Nods of somebody who answers a share of the phrases 0.2 to 0.7 s after their end."""
    rng, ends = np.random.default_rng(seed), ends_of(others)
    return (ends + rng.uniform(0.2, 0.7, len(ends)))[rng.random(len(ends)) < share]


def anywhere(count, seed=0):
    return np.sort(np.random.default_rng(seed).uniform(0, MINUTES * 60 - 2, count))


def figures(*meetings):
    """Of (meeting, sums of a listener in it)."""
    everything = np.ones(FRAMES, bool)
    rows = timing.per_person((one.participant, timing.people_sums(one, everything) | sums) for one, sums in meetings)
    return {name: one.value for name, one in estimates(timing.figures_of(rows[0]), rows, seed=1, draws=50).items()}


def test_people_judged_against_themselves_are_themselves():
    one = meeting(answering(talk()))
    runs = [one.spans_s["nod"]] * 3
    found = figures((one, timing.nod_sums("", one, runs) | timing.nod_sums("decided_", one, runs)
                     | {"nod_deg_sizes": np.zeros(400)}))  # fmt: skip
    assert found["interval_ks"] == found["decided_interval_ks"] == 0.0
    for key in ("nods_per_minute", "phrase_end_ratio", "nods_long_silence"):
        assert found[key] == found[f"decided_{key}"] == found[f"people_{key}"]
    assert found["phrase_end_ratio"] > 3


def test_nods_at_random_know_no_phrase_ends_and_rank_nothing():
    one = meeting(answering(talk()))
    runs = [spans(anywhere(4000, seed)) for seed in range(8)]
    contingency = timing.nod_contingency("decided_", runs, one, np.ones(FRAMES, bool))
    found = figures((one, timing.nod_sums("decided_", one, runs) | contingency))
    assert found["decided_phrase_end_ratio"] == pytest.approx(1.0, abs=0.05)
    assert found["decided_nod_auc"] == pytest.approx(0.5, abs=0.05)


def test_who_is_spoken_to_is_told_from_who_only_hears_or_has_just_spoken():
    half = np.arange(FRAMES) < FRAMES // 2
    one = meeting(anywhere(400), attention=np.where(half, 1.0, 0.0))
    counted = timing.nod_sums("", one, [one.spans_s["nod"]])
    addressed, bystander = counted["addressed_nods_per_minute"], counted["bystander_nods_per_minute"]
    assert addressed[1] + bystander[1] == pytest.approx((one.listening & one.alone).sum() / FRAME_HZ / 60)
    assert 0 < addressed[0] and 0 < bystander[0]
    for changed in (np.full(FRAMES, np.nan), one.attention):
        busy = meeting(anywhere(400), attention=changed, alone=one.alone & np.isnan(changed))
        assert not busy.addressed.any() and not busy.bystander.any()
    own = np.zeros(FRAMES, bool)
    own[FRAME_HZ : 2 * FRAME_HZ] = True
    one = meeting([], others=np.ones(FRAMES, bool), own=own, attention=np.ones(FRAMES))
    assert not one.addressed[FRAME_HZ : 3 * FRAME_HZ].any() and one.addressed[3 * FRAME_HZ :].all()


def test_intervals_leave_out_what_was_not_listened_in_and_nods_by_lot_scatter_by_their_mean():
    listening = np.ones(1000, bool)
    listening[100:350] = False
    np.testing.assert_allclose(timing.intervals_s(np.array([50, 200, 400]), listening), [4.0])
    everywhere = np.ones(FRAMES, bool)
    lot, bouts = anywhere(400), np.sort((anywhere(100)[:, None] + np.arange(4)).ravel())
    for nods_s, low, high in ((lot, 0.7, 1.4), (bouts, 2.5, 5.5)):
        scaled, total = timing.scatter((nods_s * FRAME_HZ).astype(int).clip(0, FRAMES - 1), everywhere)
        assert low < scaled / total < high
    assert not timing.scatter(np.array([3]), np.arange(FRAMES) < 60 * FRAME_HZ).any(), "one stretch has no variance"


def test_what_a_finder_misses_is_made_up_for():
    one, motion = meeting([]), np.zeros((1, 3000, 58), np.float32)
    when_s = np.arange(3000) / FRAME_HZ
    for start in range(5, 115, 10):
        inside = (when_s >= start) & (when_s < start + 0.5)
        motion[0, inside, 1] = np.radians(5) * np.sin(np.pi * (when_s[inside] - start) / 0.5) ** 2
    half = DetectorCalibration({"nod": Sightings(np.ones(4), np.array([1.0, 1, 0, 0]), 2, np.full(2, 0.08))})
    detected = [Detected.of(each) for each in motion]
    plain, made_up = (timing.motion_sums(one, motion, detected, 0, known) for known in (DetectorCalibration({}), half))
    assert plain["nods_per_minute"][0] > 0 and made_up["nods_per_minute"][0] == 2 * plain["nods_per_minute"][0]
    assert plain["blinks_per_minute"].tolist() == [0, pytest.approx(2.0)]


def test_moving_a_listeners_own_nods_tells_the_same():
    one, everything = meeting(answering(talk())), np.ones(FRAMES, bool)
    runs = [spans(answering(talk(), seed=seed)) for seed in range(1, 9)]
    found = timing.nod_contingency("", runs, one, everything)
    assert found["nod_auc"][0] / found["nod_auc"][1] > 0.8
    assert found["shifted_nod_auc"][0] / found["shifted_nod_auc"][1] == pytest.approx(0.5, abs=0.03)
    own = timing.nod_contingency("", [spans(anywhere(80, seed)) for seed in range(8)], one, everything)
    assert own["nod_auc_matched_minus_shifted"][0] / own["nod_auc"][1] == pytest.approx(0, abs=0.05)


def test_too_short_a_part_cannot_be_shifted_and_few_nods_or_none_annotated_are_not_ranked():
    one = meeting(answering(talk()))
    found = timing.nod_contingency("", [one.spans_s["nod"]], one, np.arange(FRAMES) < 90 * FRAME_HZ)
    assert found["nod_auc"][1] > 0
    assert not any(found[name].any() for name in ("shifted_nod_auc", "nod_auc_matched_minus_shifted"))
    assert not timing.ranked(np.zeros(FRAMES), meeting([5.0, 9.0])).any()
    assert not timing.ranked(np.zeros(FRAMES), meeting(anywhere(99)), "gaze_shift").any()


def test_an_instant_is_ranked_by_what_is_known_before_it():
    """A score that is high only once a nod has begun knows nothing of when it begins."""
    one = meeting(anywhere(200))
    score, nods = timing.ranked(one.inside("nod").astype(float), one)
    assert score / nods == pytest.approx(0.5, abs=0.01)
    np.testing.assert_array_equal(meeting([10.0, 10.06]).instants("nod"), [249, 250])


def test_the_nod_table_ranks_those_it_was_counted_on_and_not_random_people():
    others = talk(5)
    person = someone(others=event_spans(others), nods=spans(answering(others)), until_s=float(MINUTES * 60))
    rates = timing.table_rates([person])
    ones = [meeting(nods) for nods in (answering(talk()), anywhere(1500))]
    phase, random = (timing.ranked(rates[timing.cells(times(one.others))], one) for one in ones)
    assert phase[0] / phase[1] > 0.8
    assert random[0] / random[1] == pytest.approx(0.5, abs=0.04)


def test_a_persons_auc_is_the_mean_over_his_nods_and_counts_once():
    def sums(auc, nods):
        return {"x_auc": np.array([auc * nods, nods]), "nods_per_minute": np.array([nods, 10.0])}

    rows = timing.per_person([("A", sums(0.6, 30)), ("A", sums(0.9, 10)), ("B", sums(0.5, 400)), ("C", sums(0, 0))])
    assert [row["x_auc"].tolist() for row in rows] == [[pytest.approx(0.675), 1], [0.5, 1], [0, 0]]
    found = {name: one.value for name, one in estimates(timing.figures_of(rows[0]), rows, seed=1).items()}
    assert found["x_auc"] == pytest.approx((0.675 + 0.5) / 2)
    assert found["nods_per_minute"] == pytest.approx(440 / 40)


def event_spans(mask):
    edges = np.flatnonzero(np.diff(np.r_[0, mask.astype(int), 0])) / FRAME_HZ
    return edges.reshape(-1, 2)


def someone(meeting="TS3003a", participant="P1", **changed):
    return meeting_person(meeting=meeting, participant=participant, **changed)


def test_people_who_were_trained_on_are_refused_unless_asked_for_and_a_part_without_people_says_who_is_there():
    everybody = [someone("TS3003a", "P1"), someone("ES2003a", "P2"), someone("ES2003b", "P1")]
    with pytest.raises(ConfigError, match="--split train: .*--allow-training"):
        people_of(everybody, "train", False)
    assert [person.meeting for person in people_of(everybody, "train", True)] == ["TS3003a"]
    assert [person.meeting for person in people_of(everybody, "test", False)] == ["ES2003a"]  # P1 was trained on
    with pytest.raises(ConfigError, match=r"--split validation: the tables have no people of this split \(train 1\)"):
        people_of([someone()], "validation", False)


def test_meetings_are_spread_evenly_and_played_from_their_middle():
    people = list(range(134))
    assert spread(people, 3) == [0, 66, 133] and spread(people, None) == spread(people, 500) == people
    assert (middle(30_000, 5.0), middle(100, 5.0), middle(100, 0.0)[1]) == ((11_250, 7_500), (0, 100), 0)


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

    def step_each(self, speakers, memories):
        return [self.step(*each) for each in zip(speakers, memories, strict=True)]


def test_streams_one_by_one_and_side_by_side_are_rolled_out_alike():
    speaker = speaker_frames(None, np.full((30, 58), np.nan, np.float32))
    alone = rollout(Metronome(), speaker, [3, 5]).motion
    np.testing.assert_array_equal(alone, rollout(Choir(), speaker, [3, 5]).motion)
    np.testing.assert_allclose(alone[:, [1, 4, 5, 29], 1], [[3, 3, 3.04, 3.28], [5, 5, 5.04, 5.28]], rtol=1e-6)
    assert not alone[:, 0].any()  # nothing is planned yet while the first frame is heard


def test_every_cell_has_a_phase_and_one_without_nods_gets_fewer():
    speech = [(s, 0.0) for s in (0.5, 1.5, 3, 6, 20)]
    silence = [(0.0, s) for s in (0.3, 0.6, 1.0, 5.0)]
    phases = np.array([(*now, last) for now in speech + silence for last in (0.0, 2.0, 9.0)])
    assert sorted(cells(phases)) == list(range(CELLS))
    others = talk(5)
    spoken = {"others": event_spans(others), "until_s": float(MINUTES * 60)}
    rates = timing.table_rates([someone(nods=spans(answering(others)), **spoken)])
    pause, phrase = (rates[cells(np.array([now]))[0]] for now in ((0.0, 0.3, 2.0), (6.0, 0.0, 2.0)))
    assert pause > 2 * phrase > 0
    assert not timing.table_rates([someone(**spoken)]).any()
