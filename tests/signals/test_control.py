"""Laws of the rows that a model of motion is told of events."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.frames import EVENT_KINDS, FRAME_S, ListenerEvent
from sfms_robot.signals.control import BOUND, COLUMNS, KINDS, SWINGING, control_track

EVENT = st.builds(
    ListenerEvent, kind=st.sampled_from(EVENT_KINDS), start_s=st.floats(-2, 6), duration_s=st.floats(1e-3, 5),
    size=st.floats(-50, 50), swings=st.integers(1, 9),
)  # fmt: skip
EVENTS = st.lists(EVENT, max_size=6)


def column(name: str) -> int:
    return COLUMNS.index(name)


@given(EVENTS, st.integers(-60, 60), st.integers(0, 50), st.integers(0, 50))
def test_rows_of_two_halves_are_the_rows_of_the_whole(events, first: int, one: int, other: int):
    halves = [control_track(events, first, one), control_track(events, first + one, other)]
    np.testing.assert_array_equal(np.concatenate(halves), control_track(events, first, one + other))


@given(EVENTS, EVENT)
def test_an_event_outside_its_time_changes_nothing(events, extra: ListenerEvent):
    frames = 150
    before, after = control_track(events, 0, frames), control_track([*events, extra], 0, frames)
    times_s = (1 + np.arange(frames)) * FRAME_S
    outside = (times_s < extra.start_s - 1e-6) | (times_s > extra.end_s + 1e-6)
    np.testing.assert_array_equal(before[outside], after[outside])


@given(EVENTS)
def test_rows_are_finite_and_bounded_whatever_the_events(events):
    rows = control_track(events, -50, 200)
    assert rows.shape == (200, len(COLUMNS)) and rows.dtype == np.float32
    assert np.isfinite(rows).all() and np.abs(rows).max() <= BOUND


def test_kinds_do_not_meet_and_a_gaze_shift_is_not_told():
    nod, smile = ListenerEvent("nod", 0.2, 1.0, 0.1, swings=2), ListenerEvent("smile", 0.5, 2.0, 0.6)
    both = control_track([nod, smile], 0, 80)
    np.testing.assert_array_equal(both, control_track([nod], 0, 80) + control_track([smile], 0, 80))
    assert not control_track([ListenerEvent("gaze_shift", 0.0, 1.0, 0.3, target_rad=(0.2, 0.0))], 0, 40).any()


def test_a_swing_is_where_the_head_is_in_it_and_of_two_events_of_a_kind_the_later_is_told():
    rows = control_track([ListenerEvent("nod", 0.0, 1.0, 0.1, swings=2)], -1, 26)  # at 0, 0.04, ... s
    angle = 2 * np.pi * 2 * np.arange(25) / 25
    np.testing.assert_allclose(rows[:25, column("nod.sine")], np.sin(angle), atol=1e-6)
    np.testing.assert_allclose(rows[:25, column("nod.cosine")], np.cos(angle), atol=1e-6)
    np.testing.assert_allclose(rows[:25, column("nod.over")], np.arange(25) / 25, atol=1e-6)
    assert not rows[25].any()  # over
    first = ListenerEvent("nod", 0.0, 2.0, 0.05, swings=4)
    second = ListenerEvent("nod", 0.4, 0.6, 0.1, swings=1)
    together, alone = control_track([second, first], 0, 50), control_track([second], 0, 50)
    during = slice(10, 24)  # 0.44 to 0.96 s
    np.testing.assert_array_equal(together[during], alone[during])
    np.testing.assert_array_equal(together[30:], control_track([first], 0, 50)[30:])  # the first goes on behind it


def test_every_kind_has_its_columns_and_swinging_ones_two_more():
    assert len(COLUMNS) == len(set(COLUMNS)) == 4 * len(KINDS) + 2 * len(SWINGING)
    for kind in KINDS:
        row = control_track([ListenerEvent(kind, 0.0, 1.0, 1.0)], 5, 1)[0]
        told = {name.split(".")[0] for name, value in zip(COLUMNS, row, strict=True) if value}
        assert told == {kind} and row[column(f"{kind}.active")] == 1
