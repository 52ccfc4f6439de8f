"""What events that are told do to a face on average: fitted, shown, and come back to."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_arig import arig_model

from sfms_robot.frames import CHANNEL_INDEX, ListenerEvent
from sfms_robot.listeners.arig import told
from sfms_robot.signals.control import COLUMNS, KINDS, control_track

PITCH, SMILE = CHANNEL_INDEX["pitch"], CHANNEL_INDEX["mouthSmileLeft"]


def rows_of(*events: ListenerEvent, frames: int = 100) -> torch.Tensor:
    return torch.from_numpy(control_track(events, 0, frames))


def test_nothing_told_is_the_one_of_rest():
    found = told.features(torch.zeros(3, len(COLUMNS)))
    assert found.shape == (3, told.FEATURES) and bool((found[:, 0] == 1).all()) and not found[:, 1:].any()


@pytest.mark.parametrize("kind", KINDS)
@given(start_s=st.floats(0, 1), duration_s=st.floats(0.1, 8), size=st.floats(0.01, 0.15))
@settings(max_examples=10, deadline=None)
def test_twice_the_size_is_twice_as_far_from_rest(kind: str, start_s: float, duration_s: float, size: float):
    one, two = (
        told.features(rows_of(ListenerEvent(kind, start_s, duration_s, scale * size, 2)))[:, 1:] for scale in (1, 2)
    )
    assert one.isfinite().all() and one.any()
    torch.testing.assert_close(two, 2 * one, rtol=1e-4, atol=1e-5)


def test_hats_add_up_to_the_size_of_what_is_under_way():
    rows = rows_of(ListenerEvent("smile", 0.3, 2.0, 0.5))
    found = told.features(rows)[:, 1:]
    active = rows[:, COLUMNS.index("smile.active")] > 0
    torch.testing.assert_close(found.sum(1), torch.where(active, 2 * 0.5, 0.0))  # over its course, and since it began


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
    truth = torch.zeros(told.FEATURES, 58)
    truth[0], truth[1:, PITCH] = 0.2, torch.randn(told.FEATURES - 1, generator=torch.Generator().manual_seed(0))
    made = told.features(rows) @ truth
    found = told.fit(rows, made + 0.01 * torch.randn(made.shape, generator=torch.Generator().manual_seed(1)))
    assert float((told.features(rows) @ found - made).square().mean().sqrt()) < 0.1 * float(made[:, PITCH].std())


@given(rho=st.floats(0.0, 0.99), off=st.floats(-2, 2))
@settings(max_examples=30, deadline=None)
def test_what_leaves_the_told_course_comes_back_to_it_at_the_rate_of_the_data(rho: float, off: float):
    """Where nothing is drawn, a nod that is off is off by rho as much a frame later: its size is the one told."""
    model = arig_model(events=True, draws="innovation")
    model.rho.fill_(rho)
    model.motion_low.fill_(-100)
    model.motion_high.fill_(100)
    model.told.normal_(generator=torch.Generator().manual_seed(0))
    rows = rows_of(ListenerEvent("nod", 0.2, 0.8, 0.1, 2), frames=30)
    course = model._at_rest(told.features(rows) @ model.told)
    place = course[0] + off * model.is_drawn
    for frame in range(1, 30):
        pair = torch.cat([rows[frame - 1], rows[frame]])
        nothing = torch.zeros(58)
        before, place = place, model.drawn(nothing, place, pair)
        torch.testing.assert_close(
            model.target(place, before, pair)[model.is_drawn], nothing[model.is_drawn], atol=1e-3, rtol=0
        )
        torch.testing.assert_close(place - course[frame], rho**frame * off * model.is_drawn, atol=2e-3, rtol=1e-3)
