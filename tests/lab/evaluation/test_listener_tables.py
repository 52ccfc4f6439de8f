import json
from dataclasses import replace

import numpy as np
import pytest
from made_dyads import made_dyad
from tiny_sfms import tiny_listener

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES, SPACE_CHANNELS
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Clip, Dataset
from sfms_robot.lab.evaluation import listener_tables as tables
from sfms_robot.lab.evaluation import metrics
from sfms_robot.lab.evaluation.metrics import cut
from sfms_robot.lab.evaluation.rollout import frames_of_dyad, load_at_hop, offline_rollout, rollout, rollouts
from sfms_robot.listeners.sfms.stream import SfmsListener

COLUMNS = {1: ("L2", "FD", "Var", "SI", "P-FD", "RPCC"), 2: ("FRCorr", "FRDist", "FRDiv", "FRVar", "FRDvs", "FRSyn")}


def clips_of(truth, speaker, train, people=(), space="arkit58") -> tables.Clips:
    return tables.Clips(space=space, truth=truth, speaker=speaker, train=train, people=people)


def listener(space: str = "arkit58", **changes) -> SfmsListener:
    groups = {"preset": "one", "levels": [3, 2], "keyframes": 6}
    return tiny_listener(motion_space=space, groups=groups, **changes)


def dyad(name: str, frames: int = 70, seed: int = 0, space: str = "arkit58") -> Dyad:
    rng, width = np.random.default_rng(seed), len(SPACE_CHANNELS[space])
    time_s = np.arange(frames)[:, None] / 25
    swing = rng.uniform(0.05, 0.2, width) * np.cos(0.9 * time_s)
    motion = (0.3 + swing * np.sin(3 * time_s + rng.uniform(0, 6, width))).astype(np.float32)
    speaker = motion[::-1].copy()
    speaker[10:20] = np.nan
    if space == "arkit58":
        audio, rows = rng.normal(0, 0.05, frames * FRAME_SAMPLES).astype(np.float32), None
    else:  # as L2L comes: mel rows and no waveform
        audio, rows = None, rng.normal(-5, 1, (4 * frames, 128)).astype(np.float32)
    return made_dyad(motion, name=name, audio=audio, speaker=speaker, space=space, mel=rows)


@pytest.mark.parametrize("changes", [{}, {"hop": 1}, {"phase": False, "sequential": False}, {"audio": "mfcc78"}])
def test_a_rollout_from_arrays_is_that_of_a_stream(changes):
    model, one = listener(**changes), dyad("a", 45)
    streamed = rollout(model, frames_of_dyad(one), [4]).motion[0]
    shown = model.space.decode(offline_rollout(model, one, [3, 4]).motion[1].numpy())[0]
    np.testing.assert_allclose(shown[1:], streamed[1:], atol=2e-3)  # sound is kept in half precision


@pytest.mark.parametrize("space", ["arkit58", "faceverse58", "deca56"])
@pytest.mark.parametrize("number, columns", COLUMNS.items())
def test_a_table_has_the_truth_the_heuristics_the_listener_and_the_paper(space, number, columns):
    one, data = listener(space), [dyad("a", 130, 1, space), dyad("b", 130, 2, space)]
    clips, given = tables.collect(number, {"tiny": one}, tables.shared_space({"tiny": one}), data, data, range(2))
    result = tables.table(number, clips, given, samples=2)
    json.dumps(result, allow_nan=False)
    rows = {row["name"]: row for row in result["rows"] if row["source"] == "here"}
    told = ["tiny"] if number == 1 else ["Last frame held", "tiny", "tiny, true past"]
    assert list(rows) == ["Ground truth", "Random", "Median", "Mime", "MeanFr", *told]
    assert {row["name"] for row in result["rows"] if row["source"] == "paper"} >= {"Ground truth", "Random", "SFMS"}
    wanted = [f"{part} {key}" for part in ("expression", "rotation") for key in columns] if number == 1 else columns
    assert all(isinstance(rows["tiny"][key], float) for key in wanted)
    assert result["features"].startswith("L2L-standardised" if (number, space) == (1, "deca56") else space)


def test_the_truth_has_no_error_and_random_the_most():
    rng = np.random.default_rng(0)
    truth, speaker, train = (rng.uniform(0.4, 0.6, (6, 64, 58)) for _ in range(3))
    rows = {row["name"]: row for row in tables.table(1, clips_of(truth, speaker, train), {}, 2)["rows"][:5]}
    assert rows["Ground truth"]["expression L2"] == 0
    assert rows["Ground truth"]["expression FD"] == pytest.approx(0, abs=1e-9)
    assert rows["Random"]["expression L2"] == max(row["expression L2"] for row in rows.values())
    assert rows["Median"]["expression Var"] < rows["Ground truth"]["expression Var"] < rows["Random"]["expression Var"]


def test_mime_of_a_speaker_who_copies_the_listener_is_the_truth():
    truth = np.random.default_rng(0).uniform(0, 1, (3, 60, 58))
    rows = {row["name"]: row for row in tables.table(2, clips_of(truth, truth, truth), {}, 2)["rows"][:5]}
    assert rows["Mime"]["FRDist"] == pytest.approx(0, abs=1e-4) and rows["Mime"]["FRSyn"] == 0
    assert rows["Mime"]["FRCorr per sample"] == pytest.approx(1, abs=1e-6)
    assert rows["Mime"]["FRCorr"] == pytest.approx(2, abs=1e-6)  # the challenge's sum over the samples


def test_what_clips_say_one_by_one_is_what_the_metrics_say_of_them_together():
    rng = np.random.default_rng(3)
    truth, speaker, train = rng.normal(0, 1, (3, 4, 60, 58))
    made = rng.normal(0, 1, (4, 2, 60, 58)).cumsum(axis=2)
    made[1, 0] = 0.5  # no lag can be told of what never moves
    found = tables.table(2, clips_of(truth, speaker, train, [*"aabc"]), {"ours": made}, 2)["rows"][6]
    assert found["FRCorr"] == pytest.approx(2 * metrics.frc(made, truth))
    assert found["FRDist"] == pytest.approx(metrics.reactface_frd(made, truth))
    assert found["FRDiv"] == pytest.approx(metrics.frdiv(made)) and found["FRVar"] == pytest.approx(metrics.frvar(made))
    assert found["FRSyn"] == pytest.approx(metrics.frsyn(made, speaker, as_challenge=False))
    assert set(found["interval"]) == {*COLUMNS[2], "FRCorr per sample"}


def test_the_last_true_frame_held_scores_high_without_any_listener():
    """FRCorr of a repeated past: a plan of 8 frames that begins from the truth is scored beside it."""
    truth = np.cumsum(np.random.default_rng(4).normal(0, 1, (3, 400, 58)), axis=1)
    still = tables.held(truth)
    assert (still[:, 8:16] == np.repeat(truth[:, 7:8], 8, axis=1)).all() and (still[:, 0] == truth[:, 0]).all()
    assert metrics.frc(still[:, None], truth) > 0.9


def test_a_plan_from_the_true_past_begins_where_the_truth_is():
    one, model = dyad("a", 90), listener(hop=8)
    free, told = (offline_rollout(model, one, [1], true_past=true).motion[0].numpy() for true in (False, True))
    truth, first = one.listener, np.arange(57, 90, 8)  # the first frame of each plan
    near, far = (np.abs(motion[first] - truth[first]).mean() for motion in (told, free))
    assert near < 0.7 * far


def test_dyads_of_any_lengths_are_played_together_as_each_alone():
    dyads, model = [dyad("a", 45), dyad("b", 60), dyad("c", 20)], listener()
    for number, (motion, states) in enumerate(rollouts(model, dyads, 3, "played")):
        alone = rollout(model, frames_of_dyad(dyads[number]), [3 + number])
        np.testing.assert_allclose(motion, alone.motion[0], atol=1e-5)
        np.testing.assert_array_equal(states, alone.states[0])


def test_clips_are_cut_one_behind_the_other():
    motion = np.arange(10.0)[:, None]
    assert cut([motion, motion[:3], motion[:4]], 4)[..., 0].tolist() == [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 2, 3]]
    with pytest.raises(ConfigError, match="no clip is as long as 11 frames"):
        cut([motion], 11)


def test_some_dyads_are_spread_over_all():
    one = dyad("one", 60)
    clips = tuple(
        Clip(name=str(row), frames=60, row=row, read=lambda row=row: replace(one, name=str(row))) for row in range(10)
    )
    clips = (*clips[:3], Clip(name="broken", frames=60, row=3, read=lambda: open("gone")), *clips[4:])
    whole = Dataset(layout="composed", split="train", space="arkit58", fps=25.0, clips=clips)
    assert [each.name for each in tables.spread_clips(whole, 4)] == ["0", "2", "5", "7"]
    assert [each.name for each in tables.spread_clips(whole, None)] == [*"012456789"], "what cannot be read is left out"
    with pytest.raises(ConfigError, match="none of 1 clips can be read"):
        tables.spread_clips(whole[3:4], None)


def test_what_makes_no_table_is_refused():
    with pytest.raises(ConfigError, match=r"a: arkit58, b: faceverse58\): evaluate them one by one"):
        tables.shared_space({"a": listener(), "b": listener("faceverse58")})
    one, data = listener(), [dyad("a", 49)]
    with pytest.raises(ConfigError, match="table 2 needs clips of 51 frames, the longest has 49"):
        tables.collect(2, {"tiny": one}, tables.shared_space({"tiny": one}), data, data, range(1))
    clip = np.random.default_rng(0).uniform(0, 1, (1, 64, 56))
    with pytest.raises(ConfigError, match="L2L's units need training clips that differ, there is 1"):
        tables.table(1, clips_of(clip, clip, clip, space="deca56"), {}, 1)


def test_random_has_the_moments_of_even_numbers_in_the_range_of_training():
    """FRVar 1/12, FRDiv and FRDvs 1/6: the paper's row."""
    rng = np.random.default_rng(1)
    train, speaker = rng.uniform(0, 1, (5, 200, 58)), rng.uniform(0, 1, (6, 200, 58))
    train[..., :6] *= 0.1
    random = tables.heuristics(clips_of(speaker, speaker, train), 6, seed=0)["Random"]
    shapes, pose = random[..., 6:], random[..., :6]
    assert metrics.frvar(shapes) == pytest.approx(1 / 12, rel=0.02)
    assert metrics.frdiv(shapes) == pytest.approx(1 / 6, rel=0.02)
    assert metrics.frdvs(shapes) == pytest.approx(1 / 6, rel=0.02)
    assert 0 <= pose.min() and pose.max() <= 0.1


@pytest.mark.parametrize(("hop", "plans_every"), [(None, 4), (2, 2), (8, 8)])
def test_a_listener_plans_as_often_as_it_is_told(hop, plans_every):
    assert load_at_hop("sfms-small", hop).hop == plans_every


@pytest.mark.parametrize(
    ("listener", "hop", "choices"), [("sfms-small", 9, "1, 2, 3, 4, 5, 6, 7, 8"), ("arig-small", 2, "1")]
)
def test_a_hop_that_it_cannot_be_run_with_is_refused_with_the_choices(listener, hop, choices):
    with pytest.raises(ConfigError, match=rf"^--hop {hop}: not a hop of listener {listener} \(valid: {choices}\)$"):
        load_at_hop(listener, hop)
