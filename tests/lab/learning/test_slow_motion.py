"""Slow motion told from fast, and the sway that is fitted on it."""

import numpy as np
import pytest
import torch

from sfms_robot.frames import ListenerEvent
from sfms_robot.lab.learning.corpus import slow_part, sway_of
from sfms_robot.listeners.idle import BANDS_HZ, draw_sway, sway_at

TIMES_S = np.arange(1500) * 0.04
SWAY = 0.02 * np.sin(2 * np.pi * 0.12 * TIMES_S)
NOD = ListenerEvent("nod", 20.0, 1.2, 0.1, swings=3)


def nodded() -> np.ndarray:
    """(N, 1) down and back three times, on top of the sway."""
    since = TIMES_S - NOD.start_s
    during = (since >= 0) & (since < NOD.duration_s)
    return (SWAY + during * 0.05 * (1 - np.cos(2 * np.pi * 3 * since / NOD.duration_s)))[:, None].astype(np.float32)


def test_sway_is_found_under_a_nod_and_without_events_by_a_low_pass():
    slow = slow_part(nodded(), [NOD])[:, 0]
    assert np.abs(slow - SWAY)[50:-50].max() < 0.003
    fast = nodded()[:, 0] - slow
    assert np.ptp(fast) == pytest.approx(0.1, rel=0.06) and fast.min() > -0.004  # no swing the other way before it
    quick = np.sin(2 * np.pi * 3.0 * TIMES_S)[:, None].astype(np.float32)
    assert np.abs(slow_part(quick, [])[50:-50]).max() < 0.02
    slow = SWAY[:, None].astype(np.float32)
    np.testing.assert_allclose(slow_part(slow, [])[50:-50], slow[50:-50], atol=2e-4)


@pytest.mark.parametrize("frames", [0, 1, 2, 5])
def test_a_motion_of_a_few_frames_is_slow(frames: int):
    motion = np.ones((frames, 3), np.float32)
    np.testing.assert_allclose(slow_part(motion, [NOD]), motion, atol=1e-6)


def swaying(mixture: torch.Tensor, count: int, lateral=()) -> list[torch.Tensor]:
    times_s = 5 + np.arange(6000) * 0.04
    every = (draw_sway(mixture.numpy(), 0.3, seed, lateral) for seed in range(count))
    return [torch.from_numpy(sway_at(one, times_s)) for one in every]


def powers(mixture: torch.Tensor) -> torch.Tensor:
    return (mixture @ mixture.mT).diagonal(dim1=-2, dim2=-1)


def test_what_is_fitted_on_sway_is_its_amplitudes():
    hz = torch.tensor(BANDS_HZ)
    amplitude = torch.linspace(0.02, 0.004, len(hz) - 1)[:, None] * torch.tensor([1.0, 0.5])
    found, spread = sway_of(swaying(torch.diag_embed(amplitude), 80))
    torch.testing.assert_close(powers(found)[1:], amplitude[1:].square(), rtol=0.5, atol=2e-6)
    assert 0.2 < float(spread) < 0.5  # that of 0.3, and of how much each is seen to sway in four minutes


@pytest.mark.slow
@pytest.mark.parametrize("lateral", [(), (1,)])
def test_what_channels_do_together_is_found_on_either_side_of_the_mirror(lateral):
    """Two channels that go opposite ways, the second one lateral or not; the third by itself."""
    together = torch.tensor([[0.01, 0.0, 0.0], [-0.008, 0.006, 0.0], [0.0, 0.0, 0.005]])
    found, _ = sway_of(swaying(together.expand(len(BANDS_HZ) - 1, 3, 3), 60, lateral), lateral)
    covariance = (found @ found.mT).sum(0)
    r = covariance / covariance.diagonal().sqrt() / covariance.diagonal().sqrt()[:, None]
    assert abs(float(r[0, 1])) == pytest.approx(0.8, abs=0.1) and abs(float(r[0, 2])) < 0.15
    if not lateral:
        assert float(r[0, 1]) < 0


def test_a_border_between_dyads_is_no_motion_and_too_little_motion_is_refused():
    """Each dyad is fitted by itself: two heads at rest far apart do not sway."""
    amplitude, _ = sway_of([torch.zeros(200, 6), torch.ones(200, 6)])
    assert float(amplitude.max()) < 1e-4
    with pytest.raises(ValueError, match="2 s or more"):
        sway_of([torch.zeros(10, 6)])
