"""Slow sway: a function of time, of the amplitudes asked for, slow, and from rest."""

import numpy as np
import pytest

from sfms_robot.listeners.sway import BANDS, BANDS_HZ, EASE_S, draw_sway, sway_at


def made(seed: int = 0, amplitude: float = 0.01, spread: float = 0.0) -> np.ndarray:
    return draw_sway(np.tile(amplitude * np.eye(6, dtype=np.float32), (BANDS, 1, 1)), spread, seed)


@pytest.mark.parametrize("chunk", [1, 7, 100])
def test_frame_by_frame_it_is_the_whole(chunk: int):
    times_s = np.arange(700) * 0.04
    whole = sway_at(made(), times_s)
    parts = [sway_at(made(), times_s[at : at + chunk]) for at in range(0, 700, chunk)]
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=0, atol=1e-9)


def test_it_begins_at_rest_and_has_set_in_soon():
    out = sway_at(made(), np.array([-1.0, 0.0, EASE_S / 100, EASE_S, 60.0]))
    assert not out[:2].any() and np.abs(out[2]).max() < 1e-4 < np.abs(out[3:]).max()


def test_its_size_is_what_was_asked_also_after_an_hour():
    some = np.stack([made(seed) for seed in range(200)])
    wanted = 0.01 * BANDS**0.5
    for since_s in (10.0, 3600.0):
        out = sway_at(some, since_s + np.arange(20) * 11.0)
        assert float(out.std()) == pytest.approx(wanted, rel=0.05)


def test_people_differ_in_size_by_the_spread():
    times_s = 10 + np.arange(400) * 1.7
    sizes = np.array([np.log(sway_at(made(seed, spread=0.5), times_s).std()) for seed in range(60)])
    assert 0.35 < float(sizes.std()) < 0.65


def test_it_is_slow_and_does_not_step():
    motion = sway_at(made(), 10 + np.arange(5000) * 0.04).astype(np.float64)
    power = np.square(np.abs(np.fft.rfft(motion, axis=0))).sum(1)
    hz = np.fft.rfftfreq(5000, 0.04)
    assert float(power[hz > BANDS_HZ[-1] + 0.05].sum() / power.sum()) < 0.01
    assert np.abs(np.diff(motion, axis=0)).max() < 0.2 * np.abs(motion).max()  # 2 pi 0.8 Hz 0.04 s


def test_channels_go_together_as_they_are_mixed_and_every_other_stream_is_mirrored():
    times_s = 10 + np.arange(3000) * 0.2
    mixture = np.tile(np.array([[0.01, 0.0], [-0.009, 0.004]], np.float32), (BANDS, 1, 1))
    r = [np.corrcoef(sway_at(draw_sway(mixture, 0.0, seed), times_s).T)[0, 1] for seed in range(30)]
    assert np.mean(r) == pytest.approx(-0.91, abs=0.05) and max(r) < -0.6
    r = [np.corrcoef(sway_at(draw_sway(mixture, 0.0, seed, [1]), times_s).T)[0, 1] for seed in range(30)]
    assert np.mean(np.abs(r)) == pytest.approx(0.91, abs=0.05) and min(r) < -0.6 and max(r) > 0.6


def test_streams_and_channels_go_their_own_ways():
    times_s = 10 + np.arange(3000) * 0.2
    one, other = sway_at(made(1), times_s), sway_at(made(2), times_s)
    together = np.corrcoef(np.concatenate([one, other], axis=1).T)
    assert np.abs(together - np.eye(12)).max() < 0.4
