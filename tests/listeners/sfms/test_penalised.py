"""Keyframes that pay for themselves: as exact as exact placement, local, and none where nothing moves."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sfms_robot.listeners.sfms.piecewise_linear import Neighbours
from sfms_robot.listeners.sfms.placement import place_exact, place_penalised

MEMBER = torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
COST = st.floats(0.02, 20)


def walk(seed: int, frames: int, batch: int = 1) -> torch.Tensor:
    return torch.randn(batch, frames, 3, generator=torch.Generator().manual_seed(seed)).cumsum(1)


def errors(motion: torch.Tensor, mask: torch.Tensor, ramp: int | None) -> torch.Tensor:
    """(B, G) squared error of interpolation, by the inpainter's own interpolation."""
    values = motion[:, :, None] * MEMBER
    return ((Neighbours.in_mask(mask, ramp).interpolate(values * mask[..., None]) - values) ** 2).sum((1, 3))


@given(COST, COST, st.sampled_from([None, 1, 2, 4]), st.integers(0, 10_000))
def test_no_other_mask_costs_less(one: float, other: float, ramp, seed: int):
    motion, cost = walk(seed, 8), torch.tensor([one, other])
    mask = place_penalised(motion, [one, other], MEMBER, ramp=ramp)
    found = errors(motion, mask, ramp)[0] + cost * mask.sum(1)[0]
    every = torch.tensor(list(itertools.product([0.0, 1.0], repeat=8)))[1:]
    masks = every[..., None].expand(-1, -1, 2)
    totals = errors(motion.expand(len(masks), -1, -1), masks, ramp) + cost * masks.sum(1)
    torch.testing.assert_close(found, totals.min(0).values, rtol=1e-4, atol=1e-4)


@given(COST, st.integers(0, 10_000))
def test_with_straight_lines_it_is_the_exact_mask_of_as_many_keyframes(cost: float, seed: int):
    motion = walk(seed, 40)
    mask = place_penalised(motion, [cost, cost], MEMBER)
    exact = place_exact(motion, mask[0].sum(0).int().tolist(), MEMBER)
    torch.testing.assert_close(errors(motion, mask, None), errors(motion, exact, None), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("ramp", [None, 5])
def test_stillness_has_one_keyframe_or_what_the_largest_gap_asks_for(ramp):
    still = torch.full((1, 200, 3), 0.7)
    assert place_penalised(still, [0.1, 0.1], MEMBER, ramp=ramp).sum(1).tolist() == [[1, 1]]
    assert place_penalised(still, [0.1, 0.1], MEMBER, 50, ramp).sum(1).tolist() == [[3, 3]]


@pytest.mark.parametrize("ramp", [None, 5])
def test_a_movement_takes_no_keyframe_out_of_the_stillness_around_it(ramp):
    motion = torch.zeros(1, 300, 3)
    motion[0, 100:125] = torch.sin(torch.linspace(0, 4 * torch.pi, 25))[:, None] * 3
    at = place_penalised(motion, [0.5, 0.5], MEMBER, ramp=ramp)[0, :, 0].nonzero()[:, 0]
    assert len(at) >= 6 and at.min() >= 90 and at.max() <= 130


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(0, 10_000))
def test_before_a_keyframe_that_two_motions_share_only_what_is_there_decides(seed: int, other_seed: int):
    """So what is far ahead reaches no further back than to the first keyframe that stands either way."""
    motion, changed = walk(seed, 160), walk(seed, 160)
    changed[:, 80:] = walk(other_seed, 80) * 3
    masks = [place_penalised(one, [0.5, 0.5], MEMBER, 30, 5)[0] for one in (motion, changed)]
    for group in range(2):
        a, b = (mask[:, group] for mask in masks)
        shared = ((a * b)[:80]).nonzero()[:, 0]
        assert len(shared) and shared.max() >= 60  # well within a second
        assert torch.equal(a[: shared.max()], b[: shared.max()])


def test_a_dyads_keyframes_do_not_depend_on_the_rest_of_the_batch():
    motion = walk(3, 50, 3)
    together = place_penalised(motion, [0.5, 0.5], MEMBER, 30, 5)
    for row in range(3):
        assert torch.equal(place_penalised(motion[row : row + 1], [0.5, 0.5], MEMBER, 30, 5)[0], together[row])


def test_a_keyframe_that_costs_nothing_is_refused():
    with pytest.raises(ValueError, match="not all above 0"):
        place_penalised(torch.zeros(1, 9, 3), [1.0, 0.0], MEMBER)


def test_a_ramp_holds_the_keyframe_before_and_then_goes_straight():
    mask = torch.zeros(1, 12, 1)
    mask[0, [1, 9]] = 1.0
    values = torch.zeros(1, 12, 1, 1)
    values[0, 9] = 1.0
    drawn = Neighbours.in_mask(mask, 4).interpolate(values)[0, :, 0, 0]
    assert drawn.tolist() == [0, 0, 0, 0, 0, 0, 0.25, 0.5, 0.75, 1, 1, 1]
    near = Neighbours.in_mask(mask, 40).interpolate(values)
    torch.testing.assert_close(near, Neighbours.in_mask(mask).interpolate(values))
