"""Both phases on half a minute of made-up conversation."""

import shutil

import numpy as np
import pytest
import torch
from test_training_loop import interrupt_after

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, FRAME_SAMPLES, POSE_CHANNELS
from sfms_robot.lab.corpora import clips
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.evaluation.detection import behaviour
from sfms_robot.lab.evaluation.rollout import rollouts
from sfms_robot.lab.learning.corpus import windows
from sfms_robot.lab.learning.job import Run
from sfms_robot.lab.learning.sfms import features
from sfms_robot.lab.learning.sfms import predictor_trainer as listener
from sfms_robot.lab.learning.sfms import tokenizer_trainer as tokenizer
from sfms_robot.lab.learning.train_runs import calibrate
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.audio_frontend import AudioFrontend
from sfms_robot.listeners.registry import load_folder
from sfms_robot.listeners.sfms.draw import UNDECIDED
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.quantizer import Grid
from sfms_robot.listeners.space import MotionSpace

ARKIT = MotionSpace("arkit58", np.zeros(58))


def settings(placement: str = "exact", **phases) -> config.Training:
    raw = {
        "listener": {
            "kind": "sfms",
            "placement": placement,
            "groups": {
                "neck": {"channels": POSE_CHANNELS, "levels": (5, 3), "keyframes": 8},
                "face": {"channels": BLENDSHAPES, "levels": (4, 4), "keyframes": 8},
            },
            "tokenizer_width": 16,
            "predictor_width": 16,
            "predictor_layers": 1,
            "heads": 2,
        },
        "tokenizer": {"steps": 12, "batch": 8, "learning_rate": 5e-3},
        "predictor": {"steps": 8, "batch": 8, "learning_rate": 5e-3},
    }
    return config.parse(config.Training, raw | phases, "tiny")


def dyad(name: str, frames: int = 300, seed: int = 0) -> Dyad:
    rng, time_s = np.random.default_rng(seed), np.arange(frames)[:, None] / 25
    size = np.random.default_rng(0).uniform(-0.2, 0.2, 58)  # the whole face moves as one
    motion = (0.2 + size * np.sin(2 * np.pi * 0.7 * time_s + seed)).astype(np.float32)
    speaker = motion[::-1].copy()
    speaker[frames // 2 :] = np.nan
    audio = rng.normal(0, 0.05, frames * FRAME_SAMPLES).astype(np.float32)
    return Dyad(name=name, audio=audio, speaker=speaker, listener=motion, listening=np.ones(frames, bool))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    clips.save(folder / "train", [dyad("a"), dyad("b", seed=1)])
    clips.save(folder / "validation", [dyad("c", 160, seed=2)])
    return folder


@pytest.mark.parametrize(
    "placement", ["exact", *(pytest.param(each, marks=pytest.mark.slow) for each in ("static", "learned"))]
)
def test_both_phases_train_into_a_listener_that_streams(data, tmp_path, placement):
    chosen = settings(placement)
    first = tokenizer.train_tokenizer(chosen, data, tmp_path)
    second = listener.train_listener(chosen, data, tmp_path)
    assert np.isfinite([first["loss"], first["mse"], second["loss"], second["held_out_loss"]]).all()
    assert (first["steps"], second["steps"]) == (12, 8)
    calibrate(chosen, data, tmp_path)
    unseen = dyad("c", 160, seed=2)
    ((motion, _),) = rollouts(load_folder(tmp_path), [unseen], 1, "played")
    assert motion.shape == (160, 58) and np.isfinite(motion).all()
    own, people = behaviour([motion], [unseen]), behaviour([unseen.listener], [unseen])
    assert people["blinks"] >= 0 and own["jerk_deg_s3"] > 0


def trained(phase: str, chosen: config.Training, data, out, run=Run()):  # noqa: B008
    return (tokenizer.train_tokenizer if phase == "tokenizer" else listener.train_listener)(chosen, data, out, run)


WRITTEN = {"tokenizer": tokenizer.WEIGHTS, "listener": checkpoint.WEIGHTS}


@pytest.mark.parametrize(
    ("phase", "placement", "stop"),
    [
        ("tokenizer", "exact", 17),
        pytest.param("listener", "exact", 8, marks=pytest.mark.slow),
        pytest.param("tokenizer", "learned", 9, marks=pytest.mark.slow),
        pytest.param("listener", "learned", 11, marks=pytest.mark.slow),
    ],
)
def test_a_phase_interrupted_and_resumed_writes_the_same_bytes(data, tmp_path, phase, placement, stop):
    looks = {"steps": 30, "batch": 8, "learning_rate": 5e-3, "evaluate_every": 7}
    fewer = looks | {"steps": 12}
    chosen = settings(placement, tokenizer=looks, predictor=fewer)
    alone, broken = tmp_path / "alone", tmp_path / "broken"
    if phase == "listener":
        tokenizer.train_tokenizer(chosen, data, alone)
        shutil.copytree(alone, broken)
    figures = trained(phase, chosen, data, alone)
    with pytest.raises(KeyboardInterrupt, match=f"{phase}: interrupted after step {stop} of"):
        trained(phase, chosen, data, broken, Run(watches=(interrupt_after(stop),)))
    assert not (broken / WRITTEN[phase]).exists()  # half trained weights never pass for trained ones
    resumed = trained(phase, chosen, data, broken, Run(resume=True))
    for name in (WRITTEN[phase], "config.yaml"):
        assert (alone / name).read_bytes() == (broken / name).read_bytes()
    assert resumed | {"resumed_at": None} == figures and resumed["resumed_at"] == stop


@pytest.mark.slow
def test_a_listener_is_not_resumed_on_another_tokenizer_or_other_data(data, tmp_path):
    tokenizer.train_tokenizer(settings(), data, tmp_path)
    with pytest.raises(KeyboardInterrupt):
        listener.train_listener(settings(), data, tmp_path, Run(watches=(interrupt_after(2),)))
    clips.save(tmp_path / "other" / "train", [dyad("a", seed=5)])
    clips.save(tmp_path / "other" / "validation", [dyad("c", 160, seed=2)])
    with pytest.raises(ConfigError, match=r"data\.dyads = 2 there, 1 now"):
        listener.train_listener(settings(), tmp_path / "other", tmp_path, Run(resume=True))
    tokenizer.train_tokenizer(settings(seed=2), data, tmp_path)
    with pytest.raises(ConfigError, match="tokenizer weights = "):
        listener.train_listener(settings(), data, tmp_path, Run(resume=True))


def test_the_weight_of_class_0_is_taken_out_of_its_probability_unless_it_is_to_stay():
    weight = settings(predictor={"steps": 1, "batch": 1, "learning_rate": 1, "transition_weight": 0.25})
    assert [g.transition_bias for g in listener.corrected(weight).groups.values()] == [1.386, 1.386]
    kept = settings(predictor={"steps": 1, "batch": 1, "learning_rate": 1e-3, "undo_weight": False})
    assert listener.corrected(kept) == kept.listener


def _corpus() -> features.SfmsCorpus:
    return features.gather([dyad("a"), dyad("short", 40), dyad("b", 130, seed=1)], 48, ARKIT)


@pytest.mark.parametrize("hop", [4, 8])
def test_a_plan_that_is_drawn_as_a_whole_is_learned_as_a_whole(hop):
    """V-C: 8 frames in parallel; a shorter hop finds some of them drawn already."""
    tiny = settings()
    tiny = tiny.model_copy(update={"listener": tiny.listener.model_copy(update={"hop": hop})})
    corpus = features.gather([dyad("a")], 48, ARKIT, AudioFrontend.of(tiny.listener), tiny.listener)
    model, undecided = SfmsModel(tiny.listener), []
    model.predictor.register_forward_pre_hook(lambda _, seen: undecided.append(seen[0].tokens[:, -8:] == UNDECIDED))
    listener.held_out_loss(listener.Lessons(model, corpus), tiny.predictor)
    first = torch.cat(undecided)[..., 0]
    assert first[:, -1].all() and first.all() == (hop == 8)


def test_windows_never_cross_from_one_dyad_into_the_next():
    corpus = _corpus()
    assert corpus.lengths == (300, 130)  # the one shorter than a window is left out
    starts = corpus.starts(48)
    assert len(starts) == (300 - 47) + (130 - 47) and not ((starts < 300) & (starts + 48 > 300)).any()
    assert torch.equal(windows(corpus.frames.motion, starts[-1:], 48)[0], corpus.frames.motion[-48:])


def test_only_short_dyads_and_missing_data_are_one_line(tmp_path):
    with pytest.raises(ConfigError, match="none of 1 dyads can be used: 1 are shorter than a window of 48"):
        features.gather([dyad("short", 40)], 48, ARKIT)
    with pytest.raises(ConfigError, match="no data set that is known here"):
        tokenizer.train_tokenizer(settings(), tmp_path, tmp_path)


@pytest.mark.parametrize("placement", ["exact", "static"])
def test_keyframes_come_at_the_configured_rate_and_never_too_far_apart(placement):
    model, corpus = SfmsModel(settings(placement).listener), _corpus()
    features.fit_scales(model, corpus)
    mask = features.place_all(model.tokenizer, model.standardise(corpus.frames.motion), corpus.lengths)
    assert mask.mean(0) * 48 == pytest.approx(torch.tensor([8.0, 8.0]), rel=0.1)
    for part in mask.split(corpus.lengths):
        assert (part[:, 0].nonzero()[:, 0].diff() <= 48).all()


@pytest.mark.parametrize("placement", ["exact", "static"])
def test_tokens_of_a_window_do_not_depend_on_where_in_a_dyad_it_lies(placement):
    model, corpus = SfmsModel(settings(placement).listener), _corpus()
    features.fit_scales(model, corpus)
    motion = model.standardise(corpus.frames.motion)
    dense, starts = features.keyframe_tokens(model, motion), torch.arange(0, 240, 24)
    own = features.window_tokens(model, motion, dense, starts)
    assert torch.equal(own[3], features.window_tokens(model, motion[60:], dense[60:], starts[:1] + 12)[0])
    assert torch.equal((own > 0).sum(1), torch.full((10, 2), 8))
    later, earlier = own[1:, :24] > 0, own[:-1, 24:] > 0
    assert torch.equal(later, earlier) == (placement == "static"), "the same frames, in another window"


def test_the_predictor_trains_on_tokens_of_each_window(data, tmp_path):
    phase = {"steps": 4, "batch": 4, "learning_rate": 5e-3, "tokens": "windows", "calibration_rounds": 0}
    training = settings("static", predictor=phase, tokenizer={"steps": 2, "batch": 4, "learning_rate": 5e-3})
    tokenizer.train_tokenizer(training, data, tmp_path)
    figures = listener.train_listener(training, data, tmp_path)
    assert np.isfinite(figures["held_out_loss"]) and 0 <= figures["keyframe_recall"] <= 1


def test_a_perturbed_history_moves_keyframes_by_one_level_and_nothing_else():
    grid, tokens = Grid([[5, 3]]), torch.randint(0, 16, (4, 40, 1))
    moved = listener.perturb(tokens, grid, 1.0, torch.Generator().manual_seed(0))
    assert torch.equal(moved > 0, tokens > 0)
    key = (tokens > 0)[..., 0]
    before, after = (grid.codes((t - 1).clamp(min=0))[key] for t in (tokens, moved))
    steps = (after - before).abs() / (2 / (grid.levels - 1))
    assert (steps.sum(-1) < 1.001).all()
