"""Slow sway: a function of time, of the amplitudes asked for, slow, and from rest."""

import numpy as np
import pytest
from people_rad import PEOPLE_RAD

from sfms_robot.data import data_dir
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.idle import BANDS, BANDS_HZ, EASE_S, LINES, UNEVEN, WIDEST, HeadSway, draw_sway, sway_at
from sfms_robot.listeners.space import MotionSpace


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


def powers(sway: np.ndarray) -> np.ndarray:
    """(BANDS, S, S) what the channels of a stream (3, 1 + L, S) do together in each band, in the long run."""
    _, size, phase = sway[:, 1:].reshape(3, BANDS, LINES, -1)
    line = size * np.exp(1j * phase)
    return np.einsum("bls,blt->bst", line, line.conj()).real / 2


def test_every_stream_has_the_powers_that_were_learned_and_a_manner_within_what_peoples_is():
    mixture = np.random.default_rng(0).normal(0, 0.01, (BANDS, 6, 6)).astype(np.float32)
    learned = mixture.astype(np.float64) @ mixture.transpose(0, 2, 1)
    for seed in range(20):
        np.testing.assert_allclose(powers(draw_sway(mixture, 0.0, seed)), learned, rtol=1e-6, atol=1e-9)
    manners = []
    for seed in range(300):
        ratio = powers(draw_sway(mixture, 0.3, seed)) / learned
        assert np.ptp(ratio) < 1e-3 * ratio.mean()  # the same in every band and channel
        manners.append(np.log(ratio.mean()) / 2)
    assert float(np.std(manners)) == pytest.approx(0.3, rel=0.15)
    assert np.abs(manners).max() == pytest.approx(0.3 * WIDEST, rel=1e-3)  # some of 300 would be beyond


def test_it_is_slow_and_does_not_step():
    motion = sway_at(made(), 10 + np.arange(5000) * 0.04).astype(np.float64)
    power = np.square(np.abs(np.fft.rfft(motion, axis=0))).sum(1)
    hz = np.fft.rfftfreq(5000, 0.04)
    assert float(power[hz > (1 + UNEVEN) * BANDS_HZ[-1]].sum() / power.sum()) < 0.01
    assert np.abs(np.diff(motion, axis=0)).max() < 0.2 * (1 + UNEVEN) * np.abs(motion).max()  # 2 pi 0.8 Hz 0.04 s


def test_a_head_stands_and_shifts_and_its_turns_and_its_shifts_at_other_times():
    """Of two seconds: how far it goes in a tenth of them is far less than in most; no clock ever goes back."""
    slow = np.linspace(0.01, 0, BANDS, dtype=np.float32) ** 2
    sways = [
        draw_sway(slow[:, None, None] * np.eye(2, dtype=np.float32), 0.0, seed, shifting=[1]) for seed in range(30)
    ]
    moved = [sway_at(one, 10 + np.arange(2000) * 0.04).reshape(40, 50, 2).std(1) for one in sways]
    low, median = np.percentile(np.concatenate(moved), [10, 50], axis=0)
    assert (low < 0.4 * median).all()
    assert abs(np.corrcoef(np.log(np.concatenate(moved)).T)[0, 1]) < 0.15
    for one in sways:
        pace, off_s, _ = one[:, 0]
        assert (pace * off_s < 1).all() and pace[0] != pace[1]


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


@pytest.mark.parametrize("name", ["sfms-small", "arig-small"])
def test_the_heads_of_shipped_listeners_sway_as_far_as_people_do(name: str):
    """Ten minutes of 150 streams: some sway further than most people, all together they do not."""
    folder = data_dir("configs") / "listeners" / name
    settings = checkpoint.load_config(folder)
    space = MotionSpace.of(settings)
    sway = HeadSway(settings, checkpoint.read_weights(folder / checkpoint.WEIGHTS))
    low, high = np.array(PEOPLE_RAD).T
    outside, alive = [], []
    for seed in range(150):
        still = np.tile(space.neutral.astype(np.float32), (15_000, 1))
        pose = space.decode(sway.added(still, sway.start(seed), 0)[100::10])[0][:, :3]
        outside.append(((pose < low) | (pose > high)).mean(0))
        alive.append(pose.std(0))
    assert np.mean(outside, axis=0).max() < 0.05
    assert np.max(outside) < 0.2  # of the one in 150 who sways most
    assert (np.array(alive) > 0.2 * (high - low) / 4.65).all()
