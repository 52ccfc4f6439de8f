"""What the predictor is trained on: the same features as a stream's, with something missing now and then."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_dyads import made_dyad
from tiny_sfms import tiny_listener

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, FRAME_SAMPLES, POSE_CHANNELS
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.evaluation.rollout import frames_of_dyad
from sfms_robot.lab.learning.corpus import fit_sound
from sfms_robot.lab.learning.sfms.features import SfmsCorpus, context, gather
from sfms_robot.lab.learning.sfms.predictor_trainer import augment, keyframe_scores
from sfms_robot.listeners.sfms.quantizer import Grid
from sfms_robot.listeners.sfms.stream import SfmsListener

OFF = {"steps": 1, "batch": 1, "learning_rate": 1, "neutral_prefix": 0, "drop_audio": 0, "drop_face": 0}


def listener(**changes) -> SfmsListener:
    groups = {
        "neck": {"channels": POSE_CHANNELS, "levels": (5, 3), "keyframes": 8},
        "face": {"channels": BLENDSHAPES, "levels": (2, 2), "keyframes": 4},
    }
    return tiny_listener(groups=groups, placement="static", **changes)


def dyad(frames: int = 60) -> Dyad:
    rng = np.random.default_rng(3)
    motion = rng.uniform(0, 0.3, (frames, 58)).astype(np.float32)
    audio = rng.normal(0, 0.05, frames * FRAME_SAMPLES).astype(np.float32)
    audio[20 * FRAME_SAMPLES : 35 * FRAME_SAMPLES] = 0  # a pause
    speaker = rng.uniform(0, 0.3, (frames, 58)).astype(np.float32)
    speaker[7:12] = np.nan
    return made_dyad(motion, audio=audio, speaker=speaker)


def corpus_of(one: SfmsListener, *dyads: Dyad) -> SfmsCorpus:
    return gather(dyads, 48, one.space, one.frontend)


@pytest.mark.parametrize("changes", [{}, {"phase": False}, {"audio": "mfcc78"}])
@pytest.mark.parametrize("start", [0, 1, 9])
def test_the_context_of_a_window_is_what_a_stream_remembers_there(changes, start):
    one = listener(hop=1, **changes)  # memory is as of the newest plan
    corpus = corpus_of(one, dyad(60), dyad(60))
    fit_sound(one.model, (corpus.frames.sound, corpus.frames.heard))
    memory = one.start(1)
    for frame in frames_of_dyad(dyad(60))[: start + 40]:
        _, memory = one.step(frame, memory)
    tokens = torch.zeros(120, 2).long()
    for at in (start, 60 + start):  # the second dyad does not hear the first
        with torch.no_grad():
            seen = context(one.model, corpus, tokens, torch.tensor([at]))
        heard = memory.speaker
        np.testing.assert_array_equal(seen.heard[0], heard.heard)
        np.testing.assert_array_equal(seen.face_known[0], heard.face_known)
        np.testing.assert_allclose(seen.voice[0], heard.voice, atol=2e-2, rtol=1e-2)  # half precision on the way
        np.testing.assert_allclose(seen.phase[0], heard.phase, atol=1e-6)
        known = heard.face_known
        np.testing.assert_allclose(seen.face[0].numpy()[known], heard.face[known], atol=1e-5)


def augmented(**changes):
    one = listener()
    corpus, tokens = corpus_of(one, dyad()), torch.randint(0, 6, (60, 2), generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        seen = context(one.model, corpus, tokens, torch.tensor([0, 3, 8, 12]))
    training = config.parse(config.PredictorTraining, OFF | {"history_noise": 0} | changes, "tiny")
    neutral = torch.full((40, 2), 5)
    return seen, augment(seen, Grid([[5, 3], [2, 2]]), neutral, training, torch.Generator())


@pytest.mark.parametrize("changes, gone", [({"drop_audio": 1}, "heard"), ({"drop_face": 1}, "face_known")])
def test_a_dropped_modality_is_gone_and_the_other_stays(changes, gone):
    seen, after = augmented(**changes)
    other = {"heard": "face_known", "face_known": "heard"}[gone]
    assert not getattr(after, gone).any() and torch.equal(getattr(seen, other), getattr(after, other))


def test_a_neutral_prefix_is_a_stream_that_has_just_begun():
    seen, after = augmented(neutral_prefix=1)
    for row in range(4):
        cut = int((after.tokens[row, :40] == 5).all(-1).long().cumprod(0).sum())
        assert cut >= 1 and not after.heard[row, :cut].any() and not after.face_known[row, :cut].any()
        assert torch.equal(after.tokens[row, cut:], seen.tokens[row, cut:])
        assert torch.equal(after.heard[row, cut:], seen.heard[row, cut:])


@pytest.mark.parametrize("bias, recall", [(-50.0, 1.0), (50.0, 0.0)])
def test_recall_and_precision_of_one_who_always_or_never_says_keyframe(bias: float, recall: float):
    one = listener()
    corpus = corpus_of(one, dyad(120))
    with torch.no_grad():
        for row in (0, one.model.predictor.classes[0]):  # class 0 of both groups
            one.model.predictor.classify.bias[row] = bias
    scores = keyframe_scores(one.model, corpus)
    assert scores["keyframe_recall"] == recall
    rate = (8 + 4) / 2 / 48  # of the placement
    assert scores["keyframe_precision"] == pytest.approx(recall * rate, rel=0.15)


def test_wav2vec2_that_ships_with_the_data_needs_no_model_to_train_and_one_to_stream():
    one = listener(audio="wav2vec2")
    shipped = np.random.default_rng(0).normal(size=(60, 768)).astype(np.float32)
    corpus = corpus_of(one, replace(dyad(), features={"wav2vec2": shipped}))
    assert corpus.frames.sound.shape == (60, 1, 768) and corpus.frames.heard.all()
    np.testing.assert_allclose(corpus.frames.sound[:, 0], shipped, atol=2e-3)
    for use in (lambda: corpus_of(one, dyad()), lambda: one.step(frames_of_dyad(dyad())[0], one.start(1))):
        with pytest.raises(ConfigError, match="wav2vec2: expected the folder of a model"):
            use()
