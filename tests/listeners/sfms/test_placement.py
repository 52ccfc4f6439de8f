import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sfms_robot.listeners.sfms.inpainter import Neighbours
from sfms_robot.listeners.sfms.placement import place, place_exact, place_learned, place_static

MEMBER = torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def interpolation_error(motion: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """(B, G) squared error of linear interpolation, by the inpainter's own interpolation."""
    values = motion[:, :, None] * MEMBER
    return ((Neighbours(mask).interpolate(values) - values) ** 2).sum((1, 3))


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 10_000))
def test_exact_placement_beats_every_other_mask(first: int, second: int, seed: int):
    motion = torch.randn(2, 9, 3, generator=torch.Generator().manual_seed(seed)).cumsum(1)
    error = interpolation_error(motion, place_exact(motion, [first, second], MEMBER))
    for group, count in enumerate((first, second)):
        others = []
        for frames in itertools.combinations(range(9), count):
            mask = torch.zeros(2, 9, 2)
            mask[:, list(frames)] = 1.0
            others.append(interpolation_error(motion, mask)[:, group])
        torch.testing.assert_close(error[:, group], torch.stack(others).min(0).values, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("strategy", ["exact", "static", "static_paper", "learned"])
@pytest.mark.parametrize("k", [(1, 1), (3, 7), (48, 10)])
def test_every_strategy_places_exactly_k(strategy, k):
    motion = torch.randn(3, 48, 3)
    score = torch.nn.Linear(3, 2)
    mask = place(motion, k, strategy, member=MEMBER, score=score)
    assert torch.equal(mask.sum(1), torch.tensor(k).float().expand(3, 2))
    assert set(mask.unique().tolist()) <= {0.0, 1.0}


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 12), st.floats(0.05, 5.0))
def test_sampled_placement_has_exactly_k_and_reaches_every_score(count: int, temperature: float):
    scores = torch.randn(2, 12, 1, requires_grad=True)
    mask, relaxed = place_learned(scores, [count], temperature)
    torch.testing.assert_close(mask.detach().round().sum(1), torch.full((2, 1), float(count)))
    assert ((mask.detach() - mask.detach().round()).abs() < 1e-5).all()
    assert relaxed.sum(1).allclose(torch.full((2, 1), float(count)), atol=1e-3)


def test_gradient_reaches_every_score():
    scores = torch.randn(4, 12, 2, requires_grad=True)
    mask, _ = place_learned(scores, [3, 5], 1.0, torch.Generator().manual_seed(1))
    (mask * torch.randn(4, 12, 2)).sum().backward()
    assert scores.grad is not None and (scores.grad != 0).all()


def test_at_low_temperature_the_relaxation_is_top_k():
    # Scores so far apart that the noise (0.001 % beyond 12 up, 3 down) does not reorder them.
    scores = (torch.tensor([3, 8, 1, 0, 9, 4, 7, 2, 5, 6]) * 15.0)[None, :, None]
    mask, relaxed = place_learned(scores, [2], 0.01, torch.Generator().manual_seed(0))
    torch.testing.assert_close(relaxed, mask)
    assert mask[0, :, 0].round().nonzero()[:, 0].tolist() == [1, 4]


def test_sampling_frequencies_follow_the_categorical_law():
    logits = torch.log(torch.tensor([0.1, 0.2, 0.3, 0.4]))
    draws = 4000
    mask, _ = place_learned(logits[None, :, None].expand(draws, 4, 1), [1], 0.1, torch.Generator().manual_seed(0))
    counted = mask.round().sum(0)[:, 0]
    expected = draws * torch.softmax(logits, 0)
    chi_square = ((counted - expected) ** 2 / expected).sum()
    assert chi_square < 16.27  # 3 degrees of freedom, p = 0.001


def test_the_papers_static_placement_starts_at_zero_and_ours_is_centred():
    motion = torch.zeros(1, 48, 3)
    paper = place_static(motion, [7, 7], centred=False)[0, :, 0].nonzero()[:, 0].tolist()
    ours = place_static(motion, [7, 7])[0, :, 0].nonzero()[:, 0].tolist()
    assert paper == [0, 6, 12, 18, 24, 30, 36]
    assert ours[0] == 47 - ours[-1]


def test_gaps_stay_below_the_bound():
    motion = torch.zeros(1, 60, 3)
    motion[:, :5] = torch.randn(1, 5, 3)  # all that happens is at the start
    frames = place_exact(motion, [6, 6], MEMBER, max_gap=12)[0, :, 0].nonzero()[:, 0]
    assert frames.diff().max() <= 12 and frames[0] <= 12 and 59 - frames[-1] <= 12


@pytest.mark.parametrize(
    "k, gap, text", [(0, None, "0 keyframes in 9"), (10, None, "10 keyframes in 9"), (1, 2, "span")]
)
def test_impossible_counts_are_refused(k, gap, text):
    with pytest.raises(ValueError, match=text):
        place_exact(torch.zeros(1, 9, 3), [k, k], MEMBER, gap)
