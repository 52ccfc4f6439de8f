import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot import config
from sfms_robot.evaluation.rate import adaptive_bits, bits_per_window, codebook_use, keyframe_bits, rate_distortion
from sfms_robot.listeners.sfms.model import Tokenizer


@given(st.integers(1, 60), st.data())
def test_bits_are_the_logarithm_of_how_many_codes_there_are(frames, data):
    k = data.draw(st.integers(0, frames))
    codes = data.draw(st.integers(1, 1024))
    assert 2 ** keyframe_bits(frames, k, codes) == pytest.approx(math.comb(frames, k) * codes**k, rel=1e-6)


def test_channel_wise_bits_of_the_papers_setting():
    assert bits_per_window(48, [7] * 58, [256] * 58) == pytest.approx(58 * (math.log2(73_629_072) + 56))


def test_a_window_pays_for_telling_its_own_k():
    k = torch.tensor([[1, 3], [2, 2]])
    bits = adaptive_bits(48, k, [256, 16], 4)
    assert bits[0].item() == pytest.approx(keyframe_bits(48, 1, 256) + keyframe_bits(48, 3, 16) + 2 * 2)
    assert bits[1].item() == pytest.approx(bits_per_window(48, [2, 2], [256, 16]) + 4)


def test_more_keyframes_than_frames_are_refused():
    with pytest.raises(ValueError, match="9 keyframes in 8"):
        keyframe_bits(8, 9, 2)


def test_use_of_equally_frequent_codes_is_their_number():
    tokens = torch.stack([torch.arange(10) % 5, torch.zeros(10, dtype=torch.long)], dim=-1)
    evenly, never = codebook_use(tokens, [8, 3])
    assert evenly.used == 0.5 and evenly.perplexity == pytest.approx(4) and evenly.keyframes == 8
    assert never.used == never.perplexity == never.keyframes == 0


def test_the_curve_is_read_off_the_masks_that_are_encoded():
    torch.manual_seed(0)
    raw = {
        "kind": "sfms",
        "placement": "nested",
        "groups": {"preset": "four", "levels": [4, 4], "keyframes": 3},
        "scores": {"width": 8, "layers": 1, "heads": 2},
        "tokenizer_width": 16,
        "heads": 2,
    }
    tokenizer = Tokenizer(config.parse(config.Sfms, raw, "tiny")).eval()
    motion = torch.randn(4, 48, 58)
    rows = rate_distortion(tokenizer, motion, [16] * 4, [0.0, 1e9], most=5)
    fixed, (tight, loose) = rows[:5], rows[5:]
    assert [row["mean_k"] for row in fixed] == [1, 2, 3, 4, 5]
    assert all(a["bits"] < b["bits"] for a, b in zip(fixed[:-1], fixed[1:], strict=True))
    assert tight["mean_k"] == 5 and tight["mse"] == pytest.approx(fixed[4]["mse"], rel=1e-4)
    assert loose["mean_k"] == 1 and loose["mse"] == pytest.approx(fixed[0]["mse"], rel=1e-4)
    assert loose["bits"] == pytest.approx(fixed[0]["bits"] + 4 * math.log2(5))
