import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.signals import mfcc

RNG = np.random.default_rng(0)
NOISE = RNG.normal(0, 0.1, 6400).astype(np.float32)
TIME = np.arange(640) / 16_000
TONES = (0.3 * np.sin(2 * np.pi * 440 * TIME) + 0.1 * np.sin(2 * np.pi * 1900 * TIME)).astype(np.float32)
# kaldi.mfcc(TONES[None], sample_frequency=16000, use_energy=True) of torchaudio 2.11, a port of Kaldi's.
KALDI = [
    [2.9957, 52.5790, -32.8162, 7.5539, 42.1616, -107.1823, -162.4332, -14.9887, 43.5725, -34.2258, -28.5497, 59.3065,
     57.7354],
    [3.0005, 52.9226, -31.4894, 9.4360, 43.8629, -106.5214, -162.3474, -13.4141, 46.3876, -32.0276, -27.2184, 59.8589,
     58.1110],
]  # fmt: skip


def test_two_windows_of_a_frame_are_kaldis():
    np.testing.assert_allclose(mfcc.mfcc78(TONES).reshape(3, 13, 2)[0].T, KALDI, atol=1e-3)


def test_delta_of_two_windows_is_three_tenths_of_their_difference():
    """Regression over five points of a, b with repeated ends: (a, a, a, b, b) and (a, a, b, b, b)."""
    row = mfcc.mfcc78(NOISE)[0].reshape(3, 13, 2).astype(float)
    step = row[0, :, 1] - row[0, :, 0]
    np.testing.assert_allclose(row[1], np.stack([0.3 * step, 0.3 * step], axis=1), atol=1e-4)
    np.testing.assert_allclose(row[2], 0, atol=1e-4)


@given(st.integers(0, 9), st.integers(1, 5))
def test_frames_share_nothing(first: int, count: int):
    part = mfcc.mfcc78(NOISE[640 * first : 640 * (first + count)])
    np.testing.assert_array_equal(part, mfcc.mfcc78(NOISE)[first : first + count])


def test_first_cepstrum_is_log_energy_with_a_floor_and_part_frames_are_left_out():
    assert (mfcc.mfcc78(0.001 * NOISE).reshape(-1, 3, 13, 2)[:, 0, 0] == 0).all()
    quiet, loud = (mfcc.mfcc78(gain * NOISE).reshape(-1, 3, 13, 2)[:, 0, 0] for gain in (1, 4))
    np.testing.assert_allclose(loud - quiet, 2 * np.log(4), atol=1e-4)
    assert mfcc.mfcc78(NOISE[:1000]).shape == (1, 78) and mfcc.mfcc78(NOISE[:100]).shape == (0, 78)
    assert np.isfinite(mfcc.mfcc78(np.zeros(640, np.float32))).all()
