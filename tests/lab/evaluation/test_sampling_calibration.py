from dataclasses import replace

import numpy as np
import pytest
import torch
from made_dyads import made_dyad
from tiny_sfms import tiny_settings

from sfms_robot import config
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, POSE_CHANNELS, ListenerEvent
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.learning.train_runs import LEAST, coursed, placing
from sfms_robot.listeners.sfms.model import SfmsModel


def settings(**changes) -> config.Sfms:
    groups = {
        "neck": {"channels": POSE_CHANNELS, "levels": (5, 3), "keyframes": 8},
        "face": {"channels": BLENDSHAPES, "levels": (2, 2), "keyframes": 4},
    }
    return tiny_settings(**{"groups": groups} | changes)


def dyad(frames: int = 200, nods: int = 4) -> Dyad:
    motion = np.zeros((frames, 58), np.float32)
    for nod in range(nods):
        at = 15 + nod * 47
        motion[at : at + 26, CHANNEL_INDEX["pitch"]] = 0.1 * (0.5 - 0.5 * np.cos(np.linspace(0, 4 * np.pi, 26)))
    return made_dyad(motion)


@pytest.fixture(scope="module")
def model() -> SfmsModel:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return SfmsModel(settings()).eval()


def test_a_group_that_places_too_many_keyframes_gets_a_bias_against_them(model):
    """Untrained, a keyframe is as likely as 15 of 16 classes: far above the data's 8 in 48."""
    after = placing(settings(), model, [dyad()])
    assert all(group.transition_bias > 0.5 for group in after.groups.values())


def test_rounds_come_to_rest(model):
    rounds = [settings()]
    for _ in range(6):
        rounds.append(placing(rounds[-1], model, [dyad(120, 2)]))
    bias = np.array([[group.transition_bias for group in one.groups.values()] for one in rounds])
    assert (abs(np.diff(bias, axis=0))[-1] < 0.5).all()


def nodding(sizes_rad) -> Dyad:
    """One that is told of its nods, each of its size, in two swings of which the second is 0.6 of the first."""
    motion = np.zeros((50 * (len(sizes_rad) + 1), 58), np.float32)
    swing, nods = 0.5 - 0.5 * np.cos(np.linspace(0, 2 * np.pi, 21))[1:], []
    for number, size in enumerate(sizes_rad):
        at = 25 + 50 * number
        motion[at : at + 40, CHANNEL_INDEX["pitch"]] = size * np.concatenate([swing, 0.6 * swing])
        nods.append(ListenerEvent("nod", at * 0.04, 1.6, float(size), swings=2))
    return made_dyad(motion, events=tuple(nods))


def told_settings(**changes) -> config.Sfms:
    face = [name for name in BLENDSHAPES if not name.startswith("eyeLook")]
    groups = {
        "neck": {"channels": POSE_CHANNELS, "levels": (5, 3), "keyframe_cost": 1.0},
        "face": {"channels": face, "levels": (2, 2), "keyframe_cost": 1.0},
    }
    return settings(events=True, sway=True, placement="penalised", groups=groups, **changes)


def test_how_nods_die_away_is_found_at_every_size_and_not_of_single_swings():
    asked = told_settings(sampling={"nod": {"spread": 0.1}})
    found = coursed(asked, [nodding(np.linspace(0.04, 0.2, LEAST))]).sampling.nod
    assert found.fall == pytest.approx(0.6, abs=0.02) and found.spread == 0.1
    single = nodding([0.1] * LEAST)
    single = replace(single, events=tuple(replace(event, swings=1) for event in single.events))
    assert coursed(asked, [single]) == asked


def smiling(count: int) -> Dyad:
    """Smiles of many sizes, of 3 s: straight up within 0.96 s, straight down in the last 0.96 s."""
    motion = np.zeros((100 * (count + 1), 58), np.float32)
    times_s, smiles = (1 + np.arange(len(motion))) * 0.04, []
    for number in range(count):
        event = ListenerEvent("smile", 1.0 + 4 * number, 3.0, 0.3 + 0.02 * number)
        knots_s = np.array([event.start_s, event.start_s + 0.96, event.end_s - 0.96, event.end_s])
        for name in ("mouthSmileLeft", "mouthSmileRight"):
            motion[:, CHANNEL_INDEX[name]] += event.size * np.interp(times_s, knots_s, [0, 1, 1, 0])
        smiles.append(event)
    return made_dyad(motion, events=tuple(smiles))


def test_the_course_of_smiles_is_found_at_every_size_and_not_of_too_few():
    asked = told_settings(sampling={"smile": {"spread": 0.1}})
    found = coursed(asked, [smiling(LEAST)]).sampling.smile
    np.testing.assert_allclose(found.rise, np.array(found.RISE_S) / 0.96, atol=2e-3)
    np.testing.assert_allclose(found.fall, np.array(found.FALL_S) / 0.96, atol=2e-3)
    assert found.spread == 0.1
    assert coursed(asked, [smiling(LEAST - 1)]) == asked and coursed(asked, []) == asked
    assert coursed(told_settings(), [smiling(LEAST)]) == told_settings()
