"""Dense and grouped tokenizers: what their codes are, what they cost, that they learn."""

import math

import pytest
import torch

from sfms_robot import config
from sfms_robot.config import parse
from sfms_robot.errors import ConfigError
from sfms_robot.lab.evaluation.table_tokenizers import DenseTokenizer, GroupedTokenizer, baseline_loss
from sfms_robot.listeners.sfms.quantizer import Codebook

WINDOW, CHANNELS = 16, 5
SMALL = {"window_frames": WINDOW, "width": 16, "layers": 1, "heads": 2}


def dense(**more: object) -> DenseTokenizer:
    raw = {"kind": "dense", "quantizer": "fsq", "levels": [8, 5, 5, 5], **SMALL, **more}
    return DenseTokenizer(parse(config.Dense, raw, "dense"), CHANNELS)


def grouped(**more: object) -> GroupedTokenizer:
    raw = {"kind": "grouped", "quantizer": "vq", "levels": [32], **SMALL, **more}
    return GroupedTokenizer(parse(config.Grouped, raw, "grouped"), CHANNELS)


def motion(windows: int = 6) -> torch.Tensor:
    return torch.randn(windows, WINDOW, CHANNELS, generator=torch.Generator().manual_seed(3))


def test_a_dense_window_has_a_code_for_every_frame_and_pays_for_each() -> None:
    tokenizer = dense()
    indices = tokenizer.encode(motion())
    assert indices.shape == (6, WINDOW, 1)
    assert 0 <= int(indices.min()) and int(indices.max()) < 1000
    assert tokenizer.bits_per_window == pytest.approx(WINDOW * math.log2(1000))


def test_a_grouped_window_has_a_code_for_every_eight_frames() -> None:
    tokenizer = grouped()
    assert tokenizer.encode(motion()).shape == (6, WINDOW // 8, 1)
    assert tokenizer.bits_per_window == pytest.approx(WINDOW / 8 * 5)


@pytest.mark.parametrize("make", [dense, grouped])
def test_training_restores_a_few_windows_better_than_their_mean(make) -> None:  # type: ignore[no-untyped-def]
    torch.manual_seed(1)
    tokenizer, seen = make(), motion(4)
    generator = torch.Generator().manual_seed(2)
    optimizer = torch.optim.AdamW(tokenizer.parameters(), lr=5e-3)
    for _ in range(60):
        optimizer.zero_grad()
        baseline_loss(tokenizer, seen, 0.25, generator).backward()
        optimizer.step()
    error = (tokenizer.decode(tokenizer.encode(seen)) - seen).square().mean()
    assert error < 0.8 * seen.var()


def test_learned_vectors_stay_where_they_are_unless_training_moves_them() -> None:
    tokenizer = grouped()
    codebook = tokenizer.bottleneck.codebook
    assert isinstance(codebook, Codebook)
    before = codebook.vectors.clone()
    baseline_loss(tokenizer, motion(), 0.25)
    assert torch.equal(codebook.vectors, before)
    baseline_loss(tokenizer, motion(), 0.25, torch.Generator().manual_seed(1))
    assert not torch.equal(codebook.vectors, before)


def test_a_window_that_does_not_halve_three_times_is_refused() -> None:
    with pytest.raises(ConfigError, match="window_frames 20 is not a multiple of 8"):
        grouped(window_frames=20)
