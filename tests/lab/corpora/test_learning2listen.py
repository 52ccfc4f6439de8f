"""The mel rows of Learning2Listen."""

import numpy as np
import pytest

from sfms_robot.lab.corpora import learning2listen

RNG = np.random.default_rng(0)
NOISE = RNG.normal(0, 0.1, 6400).astype(np.float32)


@pytest.mark.parametrize(("rows", "wanted"), [(50, 120), (120, 50), (101, 101), (7, 3)])
def test_lanczos_is_pillows(rows: int, wanted: int):
    image = pytest.importorskip("PIL.Image")
    values = RNG.uniform(0, 1, (rows, 6)).astype(np.float32)
    resized = image.fromarray(values).resize((6, wanted), image.Resampling.LANCZOS)
    np.testing.assert_allclose(learning2listen.lanczos(values.astype(float), wanted), np.array(resized), atol=1e-5)


def test_l2l_rows_are_four_a_frame_of_power():
    frames = 12
    rows = learning2listen.l2l_mel(NOISE, frames)
    assert rows.shape == (48, 128)
    np.testing.assert_allclose(learning2listen.l2l_mel(3 * NOISE, frames), 9 * rows, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("hz", [300.0, 1000.0, 4000.0])
def test_l2l_tone_is_loudest_in_the_bin_of_its_pitch(hz: float):
    tone = np.sin(2 * np.pi * hz * np.arange(16_000) / 16_000).astype(np.float32)
    edges = learning2listen._hz(np.linspace(0, float(learning2listen._mel(8000.0)), 130))
    loudest = int(learning2listen.l2l_mel(tone, 30)[60].argmax())
    assert edges[loudest] - 32 <= hz <= edges[loudest + 2] + 32  # an FFT bin is 31 Hz wide
