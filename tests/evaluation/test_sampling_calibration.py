import numpy as np
import pytest
import torch

from sfms_robot import config
from sfms_robot.corpora.clips import Dyad
from sfms_robot.evaluation.sampling_calibration import (
    GAINS,
    LEAST_NODS,
    LEAST_SMILES,
    coursed,
    made_size,
    placing,
    sized,
)
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, FRAME_SAMPLES, POSE_CHANNELS, ListenerEvent
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


def test_the_line_from_sizes_told_to_sizes_made_is_found_in_scatter():
    rng = np.random.default_rng(0)
    told = rng.uniform(2, 10, 400)
    found = made_size(told, 0.7 * told + 0.9 + rng.normal(0, 1, 400))
    assert found.gain == pytest.approx(0.7, abs=0.06) and found.offset_deg == pytest.approx(0.9, abs=0.4)


@pytest.mark.parametrize("gain", [-0.2, 0.0, 0.1, 5.0])
def test_a_model_that_does_not_heed_sizes_is_told_none_beyond_reason(gain: float):
    """The usual size still comes out as asked."""
    told = np.linspace(2, 10, 50)
    found = made_size(told, gain * (told - 6) + 6)
    assert found.gain in GAINS
    assert found.gain * 6 + found.offset_deg == pytest.approx(6, abs=1e-3)


def nodding(sizes_rad) -> Dyad:
    """One that is told of its nods, each of its size."""
    motion = np.zeros((50 * (len(sizes_rad) + 1), 58), np.float32)
    nods = []
    for number, size in enumerate(sizes_rad):
        at = 25 + 50 * number
        motion[at : at + 20, CHANNEL_INDEX["pitch"]] = size * (0.5 - 0.5 * np.cos(np.linspace(0, 2 * np.pi, 20)))
        nods.append(ListenerEvent("nod", at * 0.04, 0.8, float(size)))
    frames = len(motion)
    audio = np.random.default_rng(0).normal(0, 0.05, frames * FRAME_SAMPLES).astype(np.float32)
    return Dyad("a", audio, motion * 0, motion, np.ones(frames, bool), events=tuple(nods))


def told_settings(**changes) -> config.Sfms:
    face = [name for name in BLENDSHAPES if not name.startswith("eyeLook")]
    groups = {
        "neck": {"channels": POSE_CHANNELS, "levels": (5, 3), "keyframe_cost": 1.0},
        "face": {"channels": face, "levels": (2, 2), "keyframe_cost": 1.0},
    }
    return settings(events=True, sway=True, placement="penalised", groups=groups, **changes)


@pytest.fixture(scope="module")
def told_model() -> SfmsModel:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return SfmsModel(told_settings()).eval()


def test_sizes_are_found_whatever_was_found_before(told_model):
    """An untrained model nods at nothing: as little heed of sizes as is taken for an answer."""
    dyads = [nodding(np.linspace(0.04, 0.2, LEAST_NODS))]
    once = sized(told_settings(), told_model, dyads)
    assert once.sampling.nod_size.gain == GAINS[0]
    assert sized(once, told_model, dyads) == once


@pytest.mark.parametrize("sizes_rad", [[0.04, 0.1], [0.1] * LEAST_NODS, []])
def test_too_few_nods_or_all_of_a_size_tell_nothing(told_model, sizes_rad):
    assert sized(told_settings(), told_model, [nodding(sizes_rad)]) == told_settings()


def smiling(count: int) -> Dyad:
    """Smiles of many sizes, of 3 s: straight up within 0.96 s, straight down in the last 0.96 s."""
    motion = np.zeros((100 * (count + 1), 58), np.float32)
    times_s = (1 + np.arange(len(motion))) * 0.04
    smiles = []
    for number in range(count):
        event = ListenerEvent("smile", 1.0 + 4 * number, 3.0, 0.3 + 0.02 * number)
        knots_s = np.array([event.start_s, event.start_s + 0.96, event.end_s - 0.96, event.end_s])
        for name in ("mouthSmileLeft", "mouthSmileRight"):
            motion[:, CHANNEL_INDEX[name]] += event.size * np.interp(times_s, knots_s, [0, 1, 1, 0])
        smiles.append(event)
    frames = len(motion)
    silence = np.zeros(frames * FRAME_SAMPLES, np.float32)
    return Dyad("a", silence, motion * 0, motion, np.ones(frames, bool), events=tuple(smiles))


def test_the_course_of_smiles_is_found_at_every_size():
    asked = told_settings(sampling={"smile": {"spread": 0.1}})
    found = coursed(asked, [smiling(LEAST_SMILES)]).sampling.smile
    np.testing.assert_allclose(found.rise, np.array(found.RISE_S) / 0.96, atol=2e-3)
    np.testing.assert_allclose(found.fall, np.array(found.FALL_S) / 0.96, atol=2e-3)
    assert found.spread == 0.1


def test_too_few_smiles_tell_no_course_and_a_listener_without_gets_none():
    asked = told_settings(sampling={"smile": {"spread": 0.1}})
    assert coursed(asked, [smiling(LEAST_SMILES - 1)]) == asked
    assert coursed(asked, []) == asked
    assert coursed(told_settings(), [smiling(LEAST_SMILES)]) == told_settings()
