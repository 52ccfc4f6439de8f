"""Placements: as many keyframes as asked, the best of all masks, and keyframes that pay for themselves."""

import itertools
from functools import cache
from typing import get_args

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sfms_robot.config.listener import Scores
from sfms_robot.listeners.sfms.piecewise_linear import Neighbours, completion_errors, mask_cost, segments
from sfms_robot.listeners.sfms.placement import (
    ConditionalScore,
    ScoreNetwork,
    Strategy,
    choose,
    place,
    place_adaptive,
    place_exact,
    place_learned,
    place_penalised,
    place_static,
    stretch_errors,
    sweep,
    tracks,
)

MEMBER = torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
SMALL = Scores(width=8, heads=2, layers=1)


def errors(motion: torch.Tensor, mask: torch.Tensor, ramp: int | None = None) -> torch.Tensor:
    """(B, G) squared error of interpolation, by the inpainter's own interpolation."""
    values = motion[:, :, None] * MEMBER
    return ((Neighbours.in_mask(mask, ramp).interpolate(values * mask[..., None]) - values) ** 2).sum((1, 3))


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 10_000))
def test_exact_placement_beats_every_other_mask(first: int, second: int, seed: int):
    motion = torch.randn(2, 9, 3, generator=torch.Generator().manual_seed(seed)).cumsum(1)
    error = errors(motion, place_exact(motion, [first, second], MEMBER))
    for group, count in enumerate((first, second)):
        masks = every_mask(9, count).float()[:, None, :, None].expand(-1, 2, 9, 2)
        others = [errors(motion, mask)[:, group] for mask in masks]
        torch.testing.assert_close(error[:, group], torch.stack(others).min(0).values, rtol=1e-4, atol=1e-4)


@cache
def scores(strategy: str) -> ScoreNetwork | ConditionalScore:
    torch.manual_seed(0)
    return (ScoreNetwork(3, 2, SMALL) if strategy == "learned_paper" else ConditionalScore(2, SMALL)).eval()


@pytest.mark.parametrize("strategy", sorted({*get_args(Strategy)} - {"penalised", "adaptive"}))
@pytest.mark.parametrize("k", [(1, 1), (3, 7), (48, 10)])
def test_every_strategy_places_exactly_k(strategy, k):
    mask = place(torch.randn(3, 48, 3), k, strategy, member=MEMBER, score=scores(strategy), sweeps=2)
    assert torch.equal(mask.sum(1), torch.tensor(k).float().expand(3, 2))
    assert set(mask.unique().tolist()) <= {0.0, 1.0}


@given(st.integers(1, 12), st.floats(0.05, 5.0))
def test_sampled_placement_has_exactly_k_and_reaches_every_score(count: int, temperature: float):
    mask, relaxed = place_learned(torch.randn(2, 12, 1, requires_grad=True), [count], temperature)
    torch.testing.assert_close(mask.detach().round().sum(1), torch.full((2, 1), float(count)))
    assert ((mask.detach() - mask.detach().round()).abs() < 1e-5).all()
    assert relaxed.sum(1).allclose(torch.full((2, 1), float(count)), atol=1e-3)


def shared(scores: torch.Tensor, temperature: float, tempered: bool) -> float:
    """Share of the keyframes that two masks of the same scores have in common."""
    generator = torch.Generator().manual_seed(0)
    first, second = (place_learned(scores, [7], temperature, generator, tempered=tempered)[0] > 0.5 for _ in range(2))
    return float((first & second).sum() / first.sum())


def test_the_temperature_acts_on_the_draw_in_one_reading_of_equation_6_alone():
    scores = 5 * torch.randn(200, 48, 1, generator=torch.Generator().manual_seed(1))
    letter = [shared(scores, temperature, tempered=False) for temperature in (0.1, 20.0)]
    read = [shared(scores, temperature, tempered=True) for temperature in (0.1, 20.0)]
    assert letter[0] == pytest.approx(letter[1], abs=0.05), "line 11 divides scores and noise alike"
    assert read[0] > 0.95 and read[1] < 0.3


def test_adaptive_placement_takes_every_likely_frame_and_sampling_follows_the_categorical_law():
    scores = torch.tensor([[-1.0, 2.0, 3.0, -4.0], [-2.0, -1.0, -3.0, -4.0]])[..., None].requires_grad_()
    assert place_adaptive(scores)[0][..., 0].tolist() == [[0, 1, 1, 0], [0, 1, 0, 0]]
    mask, relaxed = place_adaptive(scores, 0.5, torch.Generator().manual_seed(0))
    (mask.sum() + relaxed.sum()).backward()
    assert {*mask.detach().round().unique().tolist()} <= {0.0, 1.0} and bool((scores.grad != 0).all())
    logits, draws = torch.log(torch.tensor([0.1, 0.2, 0.3, 0.4])), 4000
    mask, _ = place_learned(logits[None, :, None].expand(draws, 4, 1), [1], 0.1, torch.Generator().manual_seed(0))
    counted, expected = mask.round().sum(0)[:, 0], draws * torch.softmax(logits, 0)
    chi_square = ((counted - expected) ** 2 / expected).sum()
    assert chi_square < 16.27  # 3 degrees of freedom, p = 0.001


def test_the_papers_static_placement_starts_at_zero_ours_is_centred_and_gaps_stay_below_the_bound():
    motion = torch.zeros(1, 48, 3)
    paper = place_static(motion, [7, 7], centred=False)[0, :, 0].nonzero()[:, 0].tolist()
    ours = place_static(motion, [7, 7])[0, :, 0].nonzero()[:, 0].tolist()
    assert paper == [0, 6, 12, 18, 24, 30, 36]
    assert ours[0] == 47 - ours[-1]
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


def walk(seed: int, tracks_: int = 4, frames: int = 9) -> torch.Tensor:
    """Random walks (N, T, 1)."""
    return torch.randn(tracks_, frames, 1, generator=torch.Generator().manual_seed(seed)).cumsum(1).double()


def every_mask(frames: int, count: int) -> torch.Tensor:
    rows = torch.tensor(list(itertools.combinations(range(frames), count)))
    return torch.zeros(len(rows), frames, dtype=torch.float64).scatter(1, rows, 1.0)


@given(st.integers(1, 9), st.integers(0, 10_000))
def test_the_cost_of_a_mask_is_its_interpolation_error(count: int, seed: int):
    motion, masks = walk(seed, 1), every_mask(9, count)
    same = motion.expand(len(masks), -1, -1)
    drawn = Neighbours.in_mask(masks[..., None]).interpolate((same * masks[..., None])[:, :, None])[:, :, 0]
    assert torch.allclose(mask_cost(segments(same), masks), ((drawn - same) ** 2).sum((1, 2)), rtol=1e-6, atol=1e-8)


@given(st.sets(st.integers(0, 7), max_size=3), st.integers(1, 5), st.integers(0, 10_000))
def test_completion_errors_are_those_of_the_best_mask_through_the_chosen_frames(chosen, most: int, seed: int):
    frames, motion = 8, walk(seed, 1, 8)
    state = torch.zeros(1, frames, dtype=torch.float64)
    state[0, sorted(chosen)] = 1.0
    found = completion_errors(segments(motion), state, most)[0]
    for k in range(1, most + 1):
        masks = every_mask(frames, k)
        costs = mask_cost(segments(motion.expand(len(masks), -1, -1)), masks)
        for frame in range(frames):
            holds = (masks * state).sum(1).eq(len(chosen)) & (masks[:, frame] > 0)
            best = costs[holds].min() if holds.any() else torch.tensor(torch.inf, dtype=torch.float64)
            torch.testing.assert_close(found[k - 1, frame], best, rtol=1e-6, atol=1e-8)


@given(st.sets(st.integers(0, 8), min_size=1, max_size=6), st.integers(0, 10_000))
def test_stretch_errors_tell_what_one_more_keyframe_changes(chosen, seed: int):
    motion, mask = walk(seed, 1), torch.zeros(1, 9, dtype=torch.float64)
    mask[0, sorted(chosen)] = 1.0
    now, then = stretch_errors(segments(motion), mask)
    before = mask_cost(segments(motion), mask)
    for frame in set(range(9)) - set(chosen):
        more = mask.clone()
        more[0, frame] = 1.0
        assert torch.allclose(before - mask_cost(segments(motion), more), (now - then)[:, frame], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("together", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_sweep_keeps_k_and_never_makes_a_mask_worse(together: int, count: int):
    score = scores("learned")
    track = tracks(torch.randn(6, 16, 3).cumsum(1), MEMBER, score.curves)
    start = choose(score, track, torch.full((12,), count))
    swept = sweep(score, track, start, together)
    assert torch.equal(swept.sum(1), start.sum(1))
    assert (mask_cost(track.cost, swept) <= mask_cost(track.cost, start) + 1e-6).all()


def test_conditional_scores_never_choose_a_frame_twice_and_see_no_other_track():
    score, motion = scores("learned"), torch.randn(4, 16, 3).cumsum(1)
    mask = place(motion, [16, 3], "learned", member=MEMBER, score=score)
    assert (mask[..., 0] == 1).all()
    assert torch.equal(place(motion[2:3], [16, 3], "learned", member=MEMBER, score=score)[0], mask[2])


@settings(max_examples=10)
@given(st.floats(0.1, 10), st.integers(0, 1000))
def test_scores_do_not_depend_on_size_or_offset_of_the_motion(scale: float, seed: int):
    score = scores("learned")
    motion = torch.randn(2, 16, 3, generator=torch.Generator().manual_seed(seed)).cumsum(1)
    state, remaining = torch.zeros(4, 16), torch.full((4,), 3)
    state[:, 5] = 1.0
    plain = score(tracks(motion, MEMBER, score.curves), state, remaining)
    moved = score(tracks(motion * scale + 3, MEMBER, score.curves), state, remaining)
    torch.testing.assert_close(plain, moved, rtol=1e-2, atol=1e-2)


COST = st.floats(0.02, 20)


def walk3(seed: int, frames: int, batch: int = 1) -> torch.Tensor:
    return torch.randn(batch, frames, 3, generator=torch.Generator().manual_seed(seed)).cumsum(1)


@given(COST, COST, st.sampled_from([None, 1, 2, 4]), st.integers(0, 10_000))
def test_no_other_mask_costs_less(one: float, other: float, ramp, seed: int):
    motion, cost = walk3(seed, 8), torch.tensor([one, other])
    mask = place_penalised(motion, [one, other], MEMBER, ramp=ramp)
    found = errors(motion, mask, ramp)[0] + cost * mask.sum(1)[0]
    masks = torch.tensor(list(itertools.product([0.0, 1.0], repeat=8)))[1:][..., None].expand(-1, -1, 2)
    totals = errors(motion.expand(len(masks), -1, -1), masks, ramp) + cost * masks.sum(1)
    torch.testing.assert_close(found, totals.min(0).values, rtol=1e-4, atol=1e-4)


@given(COST, st.integers(0, 10_000))
def test_with_straight_lines_it_is_the_exact_mask_of_as_many_keyframes(cost: float, seed: int):
    motion = walk3(seed, 40)
    mask = place_penalised(motion, [cost, cost], MEMBER)
    exact = place_exact(motion, mask[0].sum(0).int().tolist(), MEMBER)
    torch.testing.assert_close(errors(motion, mask, None), errors(motion, exact, None), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("ramp", [None, 5])
def test_stillness_has_one_keyframe_or_what_the_largest_gap_asks_for_and_a_movement_takes_none_out_of_it(ramp):
    still = torch.full((1, 200, 3), 0.7)
    assert place_penalised(still, [0.1, 0.1], MEMBER, ramp=ramp).sum(1).tolist() == [[1, 1]]
    assert place_penalised(still, [0.1, 0.1], MEMBER, 50, ramp).sum(1).tolist() == [[3, 3]]
    motion = torch.zeros(1, 300, 3)
    motion[0, 100:125] = torch.sin(torch.linspace(0, 4 * torch.pi, 25))[:, None] * 3
    at = place_penalised(motion, [0.5, 0.5], MEMBER, ramp=ramp)[0, :, 0].nonzero()[:, 0]
    assert len(at) >= 6 and at.min() >= 90 and at.max() <= 130


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(0, 10_000))
@example(8022, 286)
def test_before_a_keyframe_that_two_motions_share_only_what_is_there_decides(seed: int, other_seed: int):
    """So what is far ahead reaches no further back than to the first keyframe that stands either way."""
    motion, changed = walk3(seed, 160), walk3(seed, 160)
    changed[:, 80:] = walk3(other_seed, 80) * 3
    masks = [place_penalised(one, [0.5, 0.5], MEMBER, 30, 5)[0] for one in (motion, changed)]
    for group in range(2):
        a, b = (mask[:, group] for mask in masks)
        shared = ((a * b)[:80]).nonzero()[:, 0]
        assert len(shared) and shared.max() >= 40  # 53 was the least of 6,000
        assert torch.equal(a[: shared.max()], b[: shared.max()])


def test_a_dyads_keyframes_do_not_depend_on_the_batch_and_one_that_costs_nothing_is_refused():
    motion = walk3(3, 50, 3)
    together = place_penalised(motion, [0.5, 0.5], MEMBER, 30, 5)
    for row in range(3):
        assert torch.equal(place_penalised(motion[row : row + 1], [0.5, 0.5], MEMBER, 30, 5)[0], together[row])
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
