import math

import pytest
import torch
from tiny_sfms import tiny_settings

from sfms_robot import config
from sfms_robot.lab.learning.sfms.tokenizer_trainer import imitation, lively, regrets, states, tokenizer_loss
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.piecewise_linear import best_frames, mask_cost
from sfms_robot.listeners.sfms.placement import ConditionalScore, choose, place_static, tracks

ONE = torch.ones(1, 1)


def bumps(count: int, frames: int = 24, seed: int = 0) -> torch.Tensor:
    """Motion (count, frames, 1) that rests, rises and falls at its own times: what even keyframes miss."""
    drawn = torch.Generator().manual_seed(seed)
    at = torch.rand(count, 1, generator=drawn) * (frames - 8) + 4
    width = 1.5 + 2 * torch.rand(count, 1, generator=drawn)
    return (0.5 + 0.5 * torch.cos(math.pi * ((torch.arange(frames) - at) / width).clamp(-1, 1)))[..., None]


def score_network() -> ConditionalScore:
    torch.manual_seed(0)
    return ConditionalScore(1, config.listener.Scores(width=16, heads=2, layers=1))


def test_what_is_best_has_no_regret_and_following_the_teacher_ends_at_the_best_mask():
    track, chosen = tracks(bumps(4), ONE, 1), torch.zeros(4, 24)
    chosen[:, 3] = 1.0
    regret = regrets(track, chosen, torch.full((4,), 5), 5)
    assert regret[:, 3].isinf().all() and (regret >= 0).all() and (regret.amin(1) < 1e-5).all()
    track, mask = tracks(torch.randn(6, 24, 1).cumsum(1), ONE, 1), torch.zeros(6, 24)
    for _ in range(5):
        regret = regrets(track, mask, torch.full((6,), 5), 5)
        mask = mask.scatter(1, regret.argmin(1, keepdim=True), 1.0)
    best = torch.zeros(6, 24).scatter(1, best_frames(track.cost, 5), 1.0)
    torch.testing.assert_close(mask_cost(track.cost, mask), mask_cost(track.cost, best), rtol=1e-3, atol=1e-4)


def test_states_are_those_of_one_choice_each():
    score, drawn = score_network(), torch.Generator().manual_seed(1)
    track, k = tracks(bumps(3), ONE, 1), torch.tensor([1, 4, 2])
    rows, chosen, remaining = states(score, track, k, drawn)
    assert rows.bincount().tolist() == k.tolist()
    for row, count, coming in zip(rows.tolist(), chosen.sum(1).tolist(), remaining.tolist(), strict=True):
        assert coming == k[row] - count


def test_lively_tracks_are_drawn_before_still_ones():
    motion = torch.zeros(8, 24, 2)
    motion[..., 1] = torch.randn(8, 24) * 3
    found = lively(motion, torch.eye(2), 1, 4, torch.Generator().manual_seed(0))
    assert len(found.curves) == 4 and (found.curves.square().sum((1, 2)) > 1).sum() >= 3


@pytest.mark.slow
def test_scores_that_learned_from_the_teacher_beat_even_keyframes_on_unseen_motion():
    score, drawn = score_network(), torch.Generator().manual_seed(0)
    optimizer = torch.optim.AdamW(score.parameters(), 3e-3)
    for step in range(100):
        optimizer.zero_grad()
        imitation(score, tracks(bumps(16, seed=step + 1), ONE, 1), 5, drawn).backward()
        optimizer.step()
    unseen = bumps(100, seed=999)
    track, k = tracks(unseen, ONE, 1), torch.full((100,), 4)
    even = mask_cost(track.cost, place_static(unseen, [4])[..., 0]).sum()
    assert mask_cost(track.cost, choose(score, track, k)).sum() < 0.5 * even


@pytest.mark.parametrize("quantizer", ["fsq", "vq"])
def test_a_step_in_half_precision_is_finite_and_reaches_codes_inpainter_and_scores(quantizer):
    settings = tiny_settings(
        placement="learned",
        quantizer=quantizer,
        groups={"preset": "four", "levels": [4, 4], "keyframes": 3},
        scores={"width": 8, "layers": 1, "heads": 2},
    )
    torch.manual_seed(0)
    tokenizer, drawn = Tokenizer(settings), torch.Generator().manual_seed(0)
    phase = config.TokenizerTraining(steps=1, batch=4, learning_rate=1e-3)
    batch = torch.randn(4, 48, 58).cumsum(1) / 4
    torch.nn.init.normal_(tokenizer.inpainter.out.weight)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = tokenizer_loss(tokenizer, batch, tokenizer.place(batch, strategy="exact"), phase, drawn)[0]
        some = lively(batch, tokenizer.member, tokenizer.score.curves, 6, drawn)
        loss = loss + imitation(tokenizer.score, some, 3, drawn)
    loss.backward()
    assert loss.isfinite()
    for name, weights in tokenizer.named_parameters():
        assert weights.grad is not None and weights.grad.isfinite().all(), name
