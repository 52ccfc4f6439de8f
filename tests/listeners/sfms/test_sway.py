"""Slow sway: a function of time, of the amplitudes asked for, slow, and from rest."""

import pytest
import torch

from sfms_robot.listeners.sfms.sway import BANDS, BANDS_HZ, EASE_S, draw_sway, sway_at


def made(seed: int = 0, amplitude: float = 0.01, spread: float = 0.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return draw_sway(torch.full((BANDS, 6), amplitude), torch.tensor(spread), generator)


@pytest.mark.parametrize("chunk", [1, 7, 100])
def test_frame_by_frame_it_is_the_whole(chunk: int):
    times_s = torch.arange(700, dtype=torch.float64) * 0.04
    whole = sway_at(made(), times_s)
    parts = [sway_at(made(), some) for some in times_s.split(chunk)]
    torch.testing.assert_close(torch.cat(parts), whole, rtol=0, atol=1e-9)


def test_it_begins_at_rest_and_has_set_in_soon():
    out = sway_at(made(), torch.tensor([-1.0, 0.0, EASE_S / 100, EASE_S, 60.0]))
    assert not out[:2].any() and out[2].abs().max() < 1e-4 < out[3:].abs().max()


def test_its_size_is_what_was_asked_also_after_an_hour():
    some = torch.stack([made(seed) for seed in range(200)])
    wanted = 0.01 * BANDS**0.5
    for since_s in (10.0, 3600.0):
        out = sway_at(some, since_s + torch.arange(20) * 11.0)
        assert float(out.std()) == pytest.approx(wanted, rel=0.05)


def test_people_differ_in_size_by_the_spread():
    times_s = 10 + torch.arange(400) * 1.7
    sizes = torch.stack([sway_at(made(seed, spread=0.5), times_s).std().log() for seed in range(60)])
    assert 0.35 < float(sizes.std()) < 0.65


def test_it_is_slow_and_does_not_step():
    motion = sway_at(made(), 10 + torch.arange(5000) * 0.04).double()
    power = torch.fft.rfft(motion, dim=0).abs().square().sum(1)
    hz = torch.fft.rfftfreq(5000, 0.04)
    assert float(power[hz > BANDS_HZ[-1] + 0.05].sum() / power.sum()) < 0.01
    assert float(motion.diff(dim=0).abs().max()) < 0.2 * float(motion.abs().max())  # 2 pi 0.8 Hz 0.04 s


def test_streams_and_channels_go_their_own_ways():
    times_s = 10 + torch.arange(3000) * 0.2
    one, other = sway_at(made(1), times_s), sway_at(made(2), times_s)
    together = torch.corrcoef(torch.cat([one, other], dim=1).T)
    assert float((together - torch.eye(12)).abs().max()) < 0.4
