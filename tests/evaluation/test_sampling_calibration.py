import numpy as np
import pytest
import torch

from sfms_robot import config
from sfms_robot.corpora.clips import Dyad
from sfms_robot.evaluation.sampling_calibration import placing
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, FRAME_SAMPLES, POSE_CHANNELS
from sfms_robot.listeners.sfms.model import SfmsModel


def settings(**changes) -> config.Sfms:
    raw = {
        "kind": "sfms",
        "groups": {
            "neck": {"channels": POSE_CHANNELS, "levels": (5, 3), "keyframes": 8},
            "face": {"channels": BLENDSHAPES, "levels": (2, 2), "keyframes": 4},
        },
        "tokenizer_width": 16, "predictor_width": 16, "predictor_layers": 1, "heads": 2,
    }  # fmt: skip
    return config.parse(config.Sfms, raw | changes, "tiny")


def dyad(frames: int = 200, nods: int = 4) -> Dyad:
    motion = np.zeros((frames, 58), np.float32)
    for nod in range(nods):
        at = 15 + nod * 47
        motion[at : at + 26, CHANNEL_INDEX["pitch"]] = 0.1 * (0.5 - 0.5 * np.cos(np.linspace(0, 4 * np.pi, 26)))
    audio = np.random.default_rng(0).normal(0, 0.05, frames * FRAME_SAMPLES).astype(np.float32)
    return Dyad("a", audio, motion * 0, motion, np.ones(frames, bool))


@pytest.fixture(scope="module")
def model() -> SfmsModel:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return SfmsModel(settings()).eval()


def test_a_group_that_places_too_many_keyframes_gets_a_bias_against_them(model):
    """Untrained, a keyframe is as likely as 15 of 16 classes: far above the data's 8 in 48."""
    after = placing(settings(), model, [dyad()], seed=1)
    assert all(group.transition_bias > 0.5 for group in after.groups.values())


def test_rounds_come_to_rest(model):
    rounds = [settings()]
    for _ in range(6):
        rounds.append(placing(rounds[-1], model, [dyad(120, 2)], seed=1))
    bias = np.array([[group.transition_bias for group in one.groups.values()] for one in rounds])
    assert (abs(np.diff(bias, axis=0))[-1] < 0.5).all()
