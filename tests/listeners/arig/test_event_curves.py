"""What events that are told do to a face on average: fitted, shown, and come back to."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_arig import arig_model

from sfms_robot.frames import CHANNEL_INDEX, CHANNELS, ListenerEvent
from sfms_robot.listeners.arig import event_curves as curves
from sfms_robot.signals.control import COLUMNS, KINDS, control_track

PITCH = CHANNEL_INDEX["pitch"]


def rows_of(*events: ListenerEvent, frames: int = 100) -> torch.Tensor:
    return torch.from_numpy(control_track(events, 0, frames))


def test_nothing_told_is_the_one_of_rest_and_events_one_upon_the_other_take_back_what_either_moves():
    found = curves.features(torch.zeros(3, len(COLUMNS)))
    assert found.shape == (3, curves.FEATURES) and bool((found[:, 0] == 1).all()) and not found[:, 1:].any()
    smile, brow = ListenerEvent("smile", 0.2, 3.0, 0.5), ListenerEvent("brow_raise", 1.0, 1.0, 0.5)
    moved = curves.moves(CHANNELS)
    told = [rows_of(*some) for some in ((smile, brow), (smile,), (brow,))]
    both, one, other = (curves.remains(rows[:-1], rows[1:], moved) for rows in told)
    torch.testing.assert_close(both, one * other)
    model = arig_model(events=True, draws="innovation")
    model.rest_range.fill_(0.1)
    rows = rows_of(ListenerEvent("smile", 0.0, 2.0, 0.5), frames=2).reshape(-1)
    made = model.drawn(torch.full((58,), 3.0), torch.zeros(58), rows, torch.tensor(False)).abs()
    smiles = curves.moves(CHANNELS)[KINDS.index("smile")]
    assert bool((made[smiles] > 0.1).all()) and bool((made[~smiles] <= 0.1).all())


@pytest.mark.parametrize("kind", KINDS)
@given(start_s=st.floats(0, 1), duration_s=st.floats(0.1, 8), size=st.floats(0.01, 0.15))
@settings(max_examples=10)
def test_twice_the_size_is_twice_as_far_from_rest(kind: str, start_s: float, duration_s: float, size: float):
    one, two = (curves.features(rows_of(ListenerEvent(kind, start_s, duration_s, n * size, 2)))[:, 1:] for n in (1, 2))
    assert one.isfinite().all() and one.any()
    torch.testing.assert_close(two, 2 * one, rtol=1e-4, atol=1e-5)


def test_curves_of_the_data_are_found_again():
    """Of nods and smiles that lie over one another, in motion with noise."""
    rng = np.random.default_rng(0)
    starts = np.cumsum(rng.uniform(1.0, 4.0, 300))
    lengths = rng.uniform(0.5, 2.0, len(starts))
    events = [
        ListenerEvent(("nod", "smile")[at % 2], float(start), float(length), 0.1 + 0.3 * (at % 2), 1)
        for at, (start, length) in enumerate(zip(starts, lengths, strict=True))
    ]
    rows = rows_of(*events, frames=int(starts[-1] * 25))
    truth = torch.zeros(curves.FEATURES, 58)
    truth[0], truth[1:, PITCH] = 0.2, torch.randn(curves.FEATURES - 1, generator=torch.Generator().manual_seed(0))
    made = curves.features(rows) @ truth
    found = curves.fit(rows, made + 0.01 * torch.randn(made.shape, generator=torch.Generator().manual_seed(1)))
    assert float((curves.features(rows) @ found - made).square().mean().sqrt()) < 0.1 * float(made[:, PITCH].std())


@given(rho=st.floats(0.0, 0.99), off=st.floats(-2, 2))
def test_what_leaves_the_told_course_comes_back_to_it(rho: float, off: float):
    """Where nothing is drawn: a face that no event moves at the rate of the data, a head by the end of its nod."""
    model = arig_model(events=True, draws="innovation")
    model.rho.fill_(rho)
    model.motion_low.fill_(-100)
    model.motion_high.fill_(100)
    model.told.normal_(generator=torch.Generator().manual_seed(0))
    rows = rows_of(ListenerEvent("nod", 0.2, 0.8, 0.1, 2), frames=30)
    course = (curves.features(rows) @ model.told).where(model.is_drawn, 0.0)
    over = rows[:, COLUMNS.index("nod.over")] * rows[:, COLUMNS.index("nod.active")]
    place = course[0] + off * model.is_drawn
    for frame in range(1, 30):
        pair = torch.cat([rows[frame - 1], rows[frame]])
        before, place = place, model.drawn(torch.zeros(58), place, pair)
        learned = model.moved(place, before, pair)[model.is_drawn]
        torch.testing.assert_close(learned, torch.zeros_like(learned), atol=1e-3, rtol=0)
        left = torch.full((58,), rho**frame * off)
        left[:6] *= 1 - over[frame] if frame * 0.04 + 0.04 < 1.0 else 0.0
        torch.testing.assert_close(place - course[frame], left * model.is_drawn, atol=2e-3, rtol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
@given(start_s=st.floats(0, 1), duration_s=st.floats(0.1, 6))
@settings(max_examples=10)
def test_nothing_is_left_of_what_was_drawn_beside_an_event_once_it_is_over(
    kind: str, start_s: float, duration_s: float
):
    """Less and less of it while it lasts, of what the kind moves alone."""
    rows, moved = rows_of(ListenerEvent(kind, start_s, duration_s, 0.1), frames=200), curves.moves(CHANNELS)
    share = curves.remains(rows[:-1], rows[1:], moved)
    assert bool((share >= 0).all()) and bool((share <= 1).all())
    own = moved[KINDS.index(kind)]
    assert bool((share[:, ~own] == 1).all()) and not bool((share.prod(0)[own] > 0).any())
    after = int((start_s + duration_s) / 0.04) + 1
    assert bool((share[after:] == 1).all())


@settings(max_examples=10)
@given(rho=st.floats(0.0, 0.98), off=st.floats(-9, 9), drawn=st.floats(-5, 5))
def test_a_face_that_nothing_moves_comes_to_rest_whatever_is_drawn(rho: float, off: float, drawn: float):
    """It is held to where faces rest, and comes back to there at the rate of the data; while it speaks it is free."""
    model = arig_model(events=True, draws="innovation")
    model.rho.fill_(rho)
    model.rest_range.fill_(0.5)
    model.motion_low.fill_(-1e6)
    model.motion_high.fill_(1e6)
    rows, sample = torch.zeros(2 * len(COLUMNS)), torch.full((58,), drawn)
    place, free = torch.full((58,), off), model.drawn(sample, torch.full((58,), off), rows, torch.tensor(True))
    torch.testing.assert_close(free, model.drawn(sample, place, rows))
    for frame in range(1, 120):
        place = model.drawn(sample, place, rows, torch.tensor(False))
        assert float(place.abs().max()) <= max(0.5, rho**frame * abs(off)) + 1e-4
    if rho < 0.9:
        assert float(place.abs().max()) <= 0.5 + 1e-4
