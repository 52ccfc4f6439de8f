import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.evaluation.keyframe_bits import bits_per_window, keyframe_bits


@given(st.integers(1, 60), st.data())
def test_bits_are_the_logarithm_of_how_many_codes_there_are(frames, data):
    k = data.draw(st.integers(0, frames))
    codes = data.draw(st.integers(1, 1024))
    assert 2 ** keyframe_bits(frames, k, codes) == pytest.approx(math.comb(frames, k) * codes**k, rel=1e-6)


def test_channel_wise_bits_of_the_papers_setting():
    assert bits_per_window(48, [7] * 58, [256] * 58) == pytest.approx(58 * (math.log2(73_629_072) + 56))


def test_more_keyframes_than_frames_are_refused():
    with pytest.raises(ValueError, match="9 keyframes in 8"):
        keyframe_bits(8, 9, 2)
