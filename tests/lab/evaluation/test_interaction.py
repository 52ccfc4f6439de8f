"""Figures of listeners that speak: what each measures, on motion and states made up for it."""

import numpy as np
import pytest
from motion_rows import motions
from tiny_arig_training import HZ, dyad

from sfms_robot.frames import FRAME_SAMPLES
from sfms_robot.lab.evaluation import arig_tables as tables
from sfms_robot.lab.evaluation import interaction as scores
from sfms_robot.lab.evaluation.metrics import centres_of
from sfms_robot.lab.evaluation.rollout import frames_of_dyad


def jaw(values: np.ndarray) -> np.ndarray:
    return motions(len(values), jawOpen=values)


def talk(frames: int = 500, seed: int = 0) -> np.ndarray:
    return np.convolve(np.random.default_rng(seed).random(frames + 4), np.ones(5) / 5, "valid")


def test_confusion_counts_frames_that_have_both_and_adds_up():
    table = scores.confusion(np.array([0, 1, 1, -1], np.int8), np.array([0, 1, 0, 2], np.int8))
    assert table.sum() == 3 and table[0, 0] == table[1, 1] == table[0, 1] == 1
    assert scores.accuracies(table) == pytest.approx((2 / 3, (0.5 + 1) / 2))
    assert np.isnan(scores.accuracies(np.zeros((7, 7), int))).all()


def test_a_listener_hears_the_user_one_frame_late_and_itself_at_once():
    agent, user = scores.voice_tracks(dyad("a", "interaction", 0)).T
    speaks = np.arange(len(agent)) // HZ % 2 == 0
    assert (agent == speaks).mean() > 0.9 and (user[1:] == ~speaks[:-1]).mean() > 0.9 and not user[0]


@pytest.mark.parametrize("lag", [-3, 0, 2])
def test_the_lag_of_a_jaw_is_found(lag):
    values = talk(600)
    recorded, late = values[20:-20], values[20 - lag : len(values) - 20 - lag]
    found = scores.jaw_tracking([jaw(0.5 * late)], [jaw(recorded)])
    assert found["lag_frames"] == lag and found["correlation_at_lag"] == pytest.approx(1, abs=1e-5)
    assert found["correlation"] == pytest.approx(1, abs=1e-5) if lag == 0 else found["correlation"] < 0.9
    assert found["jaw_spread"] == pytest.approx(0.5, abs=0.02)


def test_a_still_jaw_follows_nothing_short_clips_do_not_count_and_each_is_taken_less_its_mean():
    found = scores.jaw_tracking([jaw(np.zeros(100))], [jaw(talk(100))])
    assert found["correlation"] == 0 and found["jaw_spread"] == 0
    first, short = talk(100), talk(20)
    assert scores.jaw_tracking([jaw(first), jaw(-short)], [jaw(first), jaw(short)]) == scores.jaw_tracking(
        [jaw(first)], [jaw(first)]
    )
    assert scores.jaw_tracking([jaw(short)], [jaw(short)])["correlation"] == 0
    first, second = talk(200), talk(200, seed=1)
    found = scores.jaw_tracking([jaw(first), jaw(second + 5)], [jaw(first), jaw(second)])
    assert found["correlation"] == pytest.approx(1, abs=1e-4)


def turning(frames: int = 3000) -> np.ndarray:
    motion = np.zeros((frames, 58))
    motion[:, :3] = np.random.default_rng(0).normal(size=(frames, 3)).cumsum(0)
    return motion


def test_motion_without_chunks_has_a_ratio_of_one_and_jumps_are_seen_at_borders_alone():
    assert scores.border_ratio([turning()], 6) == pytest.approx(1, abs=0.08)
    motion = turning()
    for at, high in ((1, True), (4, False)):  # frame 1 is the first of chunk 0
        jumped = motion + 30 * ((np.arange(len(motion)) - at) // 6 % 2)[:, None]
        assert (scores.border_ratio([jumped], 6) > 1.5) == high


def test_a_jaw_that_stays_open_after_speech_is_seen():
    one = dyad("a", "speaking", 0)
    assert np.isnan(scores.listening_again([one.listener], [one]))  # it never stays silent for more than a second
    silent, still = dyad("b", "listening", 1), jaw(np.full(300, 0.2))
    assert scores.listening_again([one.listener, still], [one, silent]) == pytest.approx(0.5, abs=0.05)


def test_the_agents_sound_comes_one_frame_early():
    one = dyad("a", "interaction", 0)
    frames = frames_of_dyad(one)
    for index in (0, 30, len(frames) - 2):
        said = one.agent_audio[(index + 1) * FRAME_SAMPLES : (index + 2) * FRAME_SAMPLES]
        assert np.array_equal(frames[index].agent_audio, said)
        assert np.array_equal(frames[index].audio, one.audio[index * FRAME_SAMPLES : (index + 1) * FRAME_SAMPLES])
    assert not frames[-1].agent_audio.any()


def clips(seed: int = 0) -> np.ndarray:
    return 0.01 * np.random.default_rng(seed).normal(size=(3, 250, 58)).cumsum(1)


def test_the_truth_is_at_no_distance_of_itself_and_a_still_face_has_no_variance():
    found = tables.scores(clips(), clips(), clips(1), CENTRES)
    for part in ("exp", "pose"):
        assert found[f"FD {part}"] == pytest.approx(0, abs=1e-6) and found[f"RPCC {part}"] == 0
        assert 0 < found[f"SID {part}"] <= np.log2(tables._CLUSTERS[part])
    found = tables.scores(clips(), np.zeros_like(clips()), clips(1), CENTRES)
    assert found["Var exp"] == found["Var pose"] == 0
    assert found["SID exp"] == pytest.approx(0, abs=1e-5) and np.isnan(found["RPCC exp"])


CENTRES = centres_of(clips(), tables.PARTS, tables._CLUSTERS)


def test_clips_without_a_speakers_face_do_not_count_for_rpcc():
    other = clips(1)
    other[0] = np.nan
    found = tables.scores(clips(), clips(2), other, CENTRES)
    assert found["RPCC exp"] == tables.scores(clips()[1:], clips(2)[1:], clips(1)[1:], CENTRES)["RPCC exp"]
    assert np.isnan(tables.scores(clips(), clips(2), np.full_like(other, np.nan), CENTRES)["RPCC exp"])


def verdicts(size: float, trainings: int = 3) -> dict[str, str]:
    """Return the verdicts of `claims` on ARIG with `size` times people's variance, beside a row with 0.75."""
    name, noise = "w/o continuous AR modeling", np.random.default_rng(0).normal(1, 0.01, 200)
    rows, draws = {}, {}
    for row, times in (("GT", 1.0), ("ARIG", size), (name, 0.75)):
        figures = {"SID": times, "RPCC": 1 / times, "Var": times * clips().var(), "FD": 0.0}
        of_parts = {f"{key} {part}": value for key, value in figures.items() for part in tables.PARTS}
        rows[row] = {"trainings": trainings, **of_parts}
        draws[row] = {key: value * noise for key, value in of_parts.items()}
    found = tables.claims("arig-4", rows, draws, clips())
    assert {claim["name"] for claim in found} == {name}, "the other row is not there"
    return {claim["figure"]: claim["verdict"] for claim in found}


def test_a_statement_of_the_paper_holds_by_one_rule_and_noise_decides_nothing():
    assert set(verdicts(1.0).values()) == {"holds"}, "three quarters of people's motion, and all of it"
    noisy = verdicts(6.0)
    assert noisy["Var exp"] == "does not hold" and noisy["SID exp"] == "open", "six times as much has every kind"
    assert set(verdicts(1.0, trainings=1).values()) == {"open"}
