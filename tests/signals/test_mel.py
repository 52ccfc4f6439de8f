import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.signals import mel

NOISE = np.random.default_rng(0).normal(0, 0.1, 16_000).astype(np.float32)


@given(st.lists(st.integers(0, 2000), max_size=12))
def test_stream_equals_offline_for_any_chunking(cuts: list[int]):
    whole, _ = mel.log_mel(NOISE, mel.start())
    past, rows, at = mel.start(), [], 0
    for size in [*cuts, len(NOISE)]:
        new, past = mel.log_mel(NOISE[at : at + size], past)
        rows.append(new)
        at += size
    np.testing.assert_array_equal(np.concatenate(rows), whole)


def test_a_frame_gives_four_rows_and_leaves_240_samples_and_the_past_as_it_was():
    past = mel.start()
    rows, after = mel.log_mel(NOISE[:640], past)
    assert rows.shape == (4, 128) and after.shape == (240,) and not past.any()


@pytest.mark.parametrize("hz", [200.0, 1000.0, 4000.0])
def test_a_tone_is_loudest_in_the_bin_of_its_pitch(hz: float):
    rows, _ = mel.log_mel(np.sin(2 * np.pi * hz * np.arange(16_000) / 16_000).astype(np.float32), mel.start())
    centres = 700 * (10 ** (np.linspace(mel._mel(20.0), mel._mel(8000.0), 130) / 2595) - 1)[1:-1]
    assert centres[rows[50].argmax()] == pytest.approx(hz, rel=0.12)
