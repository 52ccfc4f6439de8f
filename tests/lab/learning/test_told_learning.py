"""Learning to move for events that are told: what is learned from a dyad, and that both phases learn it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_dyads import made_dyad

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, POSE_CHANNELS, ListenerEvent
from sfms_robot.lab.corpora import clips
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.evaluation.rollout import rollouts
from sfms_robot.lab.learning.corpus import GAZE, without_gaze
from sfms_robot.lab.learning.sfms import predictor_trainer, tokenizer_trainer
from sfms_robot.lab.learning.sfms.features import (
    context,
    fit_scales,
    frames_of,
    gather,
    held_tokens,
    place_all,
    tokenise,
    without_last_keyframes,
)
from sfms_robot.lab.learning.sfms.predictor_trainer import augment, starts_with_events
from sfms_robot.lab.learning.sfms.tokenizer_trainer import batches
from sfms_robot.lab.learning.train_runs import calibrate
from sfms_robot.listeners.registry import load_folder
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS, control_track

ARKIT = MotionSpace("arkit58", np.zeros(58))
FACE = [name for name in BLENDSHAPES if not name.startswith("eyeLook")]


def settings(**predictor) -> config.Training:
    raw = {
        "listener": {
            "kind": "sfms", "events": True, "sway": True, "placement": "penalised", "ramp_frames": 5,
            "max_gap_frames": 25,
            "groups": {
                "neck": {"channels": POSE_CHANNELS, "levels": (9, 3), "keyframe_cost": 0.5},
                "face": {"channels": FACE, "levels": (4, 4), "keyframe_cost": 0.5},
            },
            "tokenizer_width": 16, "predictor_width": 16, "predictor_layers": 1, "heads": 2, "hop": 2,
        },
        "tokenizer": {"steps": 150, "batch": 8, "learning_rate": 5e-3},
        "predictor": {"steps": 200, "batch": 16, "learning_rate": 5e-3, "event_windows": 0.5,
                      "missed_keyframes": 0.2} | predictor,
    }  # fmt: skip
    return config.parse(config.Training, raw, "tiny")


def dyad(name: str = "a", frames: int = 500, seed: int = 0) -> Dyad:
    """A head that sways, looks aside and nods; eyes that look about."""
    rng, times_s = np.random.default_rng(seed), (1 + np.arange(frames)) * 0.04
    motion = np.zeros((frames, 58), np.float32)
    motion[:, :3] = 0.01 * np.sin(2 * np.pi * 0.1 * times_s + rng.uniform(0, 6, 3)[:, None]).T
    head = np.zeros((frames, 3), np.float32)
    head[frames // 2 :, 2] = 0.3
    motion[:, :3] += head
    motion[:, GAZE] = 0.4
    events = []
    for start_s in np.arange(1.0, frames * 0.04 - 2, 2.6) + rng.uniform(0, 0.5):
        event = ListenerEvent("nod", float(start_s), 0.8, 0.1, swings=2)
        since = times_s - event.start_s
        during = (since >= 0) & (since < event.duration_s)
        motion[:, CHANNEL_INDEX["pitch"]] += during * 0.05 * (1 - np.cos(2 * np.pi * 2 * since / event.duration_s))
        events.append(event)
    return made_dyad(motion, name=name, events=tuple(events), head_of_gaze_rad=head)


def test_gaze_is_taken_out_of_our_motion_alone_eyes_are_still_and_the_head_has_lost_it():
    one = without_gaze(dyad())
    assert not one.listener[:, GAZE].any() and one.head_of_gaze_rad is None
    np.testing.assert_allclose(one.listener[:, :3], dyad().listener[:, :3] - dyad().head_of_gaze_rad)
    others = [index for index in range(3, 58) if index not in GAZE]
    np.testing.assert_array_equal(one.listener[:, others], dyad().listener[:, others])
    np.testing.assert_array_equal(without_gaze(one).listener, one.listener)
    with pytest.raises(ConfigError, match="dyad a is in deca56: gaze can be taken out of arkit58 alone"):
        without_gaze(replace(dyad(), space="deca56", speaker=np.zeros((500, 56), np.float32),
                             listener=np.zeros((500, 56), np.float32)))  # fmt: skip


def test_motion_and_sway_of_a_dyad_are_its_motion_without_gaze():
    one, listener = dyad(), settings().listener
    frames = frames_of(one, ARKIT, None, listener)
    np.testing.assert_allclose(frames.motion[:, :6] + frames.sway, without_gaze(one).listener[:, :6], atol=1e-6)
    np.testing.assert_array_equal(frames.control, control_track(one.events, 0, 500))
    near_nod = np.convolve(control_track(one.events, -6, 512)[:, 0].astype(bool), np.ones(13), "valid") > 0
    assert np.ptp(frames.motion[:, 1].numpy()) == pytest.approx(0.1, rel=0.1)
    assert float(frames.motion[:, :6][~near_nod].abs().max()) < 0.004  # nothing for a keyframe to do


@pytest.mark.parametrize(
    "changes, text",
    [({"events": None}, "expected events of its"), ({"fps": 30.0, "audio": None}, "dyad a: 30 frames a second")],
)
def test_a_dyad_without_events_at_our_rate_is_refused(changes, text):
    with pytest.raises(ConfigError, match=text):
        frames_of(replace(dyad(), **changes), ARKIT, None, settings().listener)


def test_no_border_between_dyads_counts_as_motion():
    """What is worked out frame by frame is that of each dyad alone; a jump between two heads is nowhere in it."""
    listener = settings().listener
    apart = replace(dyad("b", seed=1), listener=dyad("b", seed=1).listener + 0.5)
    both, alone = gather([dyad(), apart], 48, ARKIT, None, listener), [
        gather([one], 48, ARKIT, None, listener) for one in (dyad(), apart)
    ]  # fmt: skip
    for name in ("motion", "sway", "control"):
        joined = torch.cat([getattr(one.frames, name) for one in alone])
        assert torch.equal(getattr(both.frames, name), joined)
    model = SfmsModel(listener)
    fit_scales(model, both)
    fastest = max(float(one.steps(one.frames.motion).abs().max()) for one in alone)
    assert float((model.motion_speed * model.motion_std)[:6].max()) <= fastest
    mask = place_all(model.tokenizer, model.standardise(both.frames.motion), both.lengths)
    parts = [place_all(model.tokenizer, model.standardise(one.frames.motion), one.lengths) for one in alone]
    assert torch.equal(mask, torch.cat(parts))
    tokens = tokenise(model, both)
    assert torch.equal(held_tokens(tokens, both.lengths), torch.cat([held_tokens(t, [500]) for t in tokens.split(500)]))


def learner():
    listener = settings().listener
    return SfmsModel(listener), gather([dyad()], 48, ARKIT, None, listener)


def test_a_window_begins_with_the_keyframe_that_is_held_there():
    tokens = torch.tensor([[0, 3], [2, 0], [0, 0], [0, 5], [0, 0]])
    assert held_tokens(tokens, [5]).tolist() == [[0, 3], [2, 3], [2, 3], [2, 5], [2, 5]]
    assert held_tokens(tokens, [2, 3]).tolist() == [[0, 3], [2, 3], [0, 0], [0, 5], [0, 5]]
    model, corpus = learner()
    placed = torch.zeros(500, 2).long()
    placed[10] = 4
    at = torch.tensor([5, 30])
    with torch.no_grad():
        seen = context(model, corpus_with_sound(corpus), placed, at, held=held_tokens(placed, [500]))
    assert seen.tokens[:, 0].tolist() == [[0, 0], [4, 4]]
    torch.testing.assert_close(seen.control[1], corpus.frames.control[30:78])


def corpus_with_sound(corpus):
    n = len(corpus.frames.motion)
    return replace(corpus, frames=replace(corpus.frames, sound=torch.zeros(n, 4, 128).half(), phase=torch.zeros(n, 21)))


def test_windows_begin_with_a_keyframe_and_those_with_events_have_one_in_their_future():
    model, corpus = learner()
    fit_scales(model, corpus)
    draw = batches(model.tokenizer, model.standardise(corpus.frames.motion), corpus.lengths, 8)
    _, mask = draw(8, torch.Generator().manual_seed(0))
    assert mask.shape == (8, 48, 2) and (mask[:, 0] == 1).all() and mask.mean() < 0.5
    listener = settings().listener
    corpus = gather([dyad()], 48, ARKIT, None, listener)
    starts = starts_with_events(corpus, corpus.starts(48), listener)
    active = corpus.frames.control[:, COLUMNS.index("nod.active")]
    assert 0 < len(starts) < len(corpus.starts(48))
    assert all(active[start + 40 : start + 48].any() for start in starts.tolist())


def test_a_stream_that_has_just_begun_was_told_of_nothing_before():
    training = settings(neutral_prefix=1.0).predictor
    model, corpus = learner()
    corpus = corpus_with_sound(corpus)
    corpus = replace(corpus, frames=replace(corpus.frames, control=torch.ones(500, len(COLUMNS))))
    with torch.no_grad():
        seen = context(model, corpus, torch.zeros(500, 2).long(), torch.arange(6))
    after = augment(seen, None, torch.full((40, 2), 5), training, torch.Generator().manual_seed(0))
    for row in range(6):
        begun = (after.tokens[row, :40] != 5).any(-1)
        assert not after.control[row, :40][~begun].any() and after.control[row, 40:].all()


def test_keyframes_are_missed_only_where_that_is_worth_one_and_are_made_up_for_at_once():
    tokens = torch.zeros(2, 48, 2).long()
    tokens[:, 5], tokens[:, 38, 0], tokens[:, 39, 1] = 1, 7, 3
    dense, motion = torch.full_like(tokens, 9), torch.zeros(2, 48, 4)
    motion[0, 38:, :2] = 2.0  # of the first group, in the first window: it has moved since frame 5
    member = torch.tensor([[1.0, 1, 0, 0], [0, 0, 1, 1]])
    arguments = dense, motion, torch.tensor([42, 42]), member, torch.tensor([1.0, 1.0])
    after = without_last_keyframes(tokens, *arguments, 1.0, torch.Generator())
    wanted = tokens.clone()
    wanted[0, 38, 0], wanted[0, 42, 0] = 0, 9
    assert torch.equal(after, wanted)
    assert torch.equal(without_last_keyframes(tokens, *arguments, 0.0, torch.Generator()), tokens)


@pytest.mark.slow
def test_both_phases_learn_to_nod_when_they_are_told(tmp_path):
    chosen = settings()
    clips.save(tmp_path / "data" / "train", [dyad("a"), dyad("b", seed=1)])
    clips.save(tmp_path / "data" / "validation", [dyad("c", seed=2)])
    tokenizer_trainer.train_tokenizer(chosen, tmp_path / "data", tmp_path / "out")
    predictor_trainer.train_listener(chosen, tmp_path / "data", tmp_path / "out")
    calibrate(chosen, tmp_path / "data", tmp_path / "out")
    unseen, listener = dyad("c", seed=2), load_folder(tmp_path / "out")
    told, quiet = (rollouts(listener, [each], 1, "played")[0][0] for each in (unseen, replace(unseen, events=())))
    people = unseen.listener[:, 1]
    agrees = [float(np.corrcoef(people, motion[:, 1])[0, 1]) for motion in (told, quiet)]
    assert agrees[0] > 0.3 > agrees[1]
    assert not told[:, GAZE].any()
