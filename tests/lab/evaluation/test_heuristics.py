import numpy as np
import pytest

from sfms_robot.frames import BLENDSHAPES
from sfms_robot.lab.evaluation import metrics
from sfms_robot.lab.evaluation.baselines.heuristics import HEURISTICS, Heuristic


def given(samples: int = 3, clips: int = 4, frames: int = 60) -> Heuristic:
    rng = np.random.default_rng(1)
    return Heuristic(rng.uniform(0, 1, (5, frames, 58)), rng.uniform(0, 1, (clips, frames, 58)), "arkit58", samples)


@pytest.mark.parametrize("name", HEURISTICS)
def test_every_clip_gets_its_samples(name):
    assert HEURISTICS[name](given()).shape == (4, 3, 60, 58)


@pytest.mark.parametrize("name", ["Median", "MeanFr"])
def test_a_still_face_has_no_variance_and_no_diversity(name):
    still = HEURISTICS[name](given())
    assert [metrics.frvar(still), metrics.frdiv(still), metrics.frdvs(still)] == pytest.approx([0, 0, 0], abs=1e-20)


def test_one_answer_repeated_is_not_diverse():
    answer = HEURISTICS["Mime"](given())
    assert metrics.frdiv(answer) == pytest.approx(0, abs=1e-12) and metrics.frvar(answer) > 0


def test_random_has_the_moments_of_even_numbers():
    """FRVar 1/12, FRDiv and FRDvs 1/6: the paper's row."""
    shapes = HEURISTICS["Random"](given(samples=6, clips=6, frames=200))[..., 6:]
    assert shapes.shape[-1] == len(BLENDSHAPES)
    assert metrics.frvar(shapes) == pytest.approx(1 / 12, rel=0.02)
    assert metrics.frdiv(shapes) == pytest.approx(1 / 6, rel=0.02)
    assert metrics.frdvs(shapes) == pytest.approx(1 / 6, rel=0.02)


def test_random_keeps_to_the_range_that_training_showed():
    seen = given()
    seen.train[..., :6] *= 0.1
    pose = HEURISTICS["Random"](seen)[..., :6]
    assert 0 <= pose.min() and pose.max() <= 0.1


def test_mime_does_what_the_speaker_does_and_the_median_is_that_of_training():
    seen = given()
    assert np.array_equal(HEURISTICS["Mime"](seen)[:, 1], seen.speaker)
    assert np.allclose(HEURISTICS["Median"](seen)[0, 0, 7], np.median(seen.train.reshape(-1, 58), axis=0))
