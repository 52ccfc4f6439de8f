"""The hop is the largest that leaves room for leads and answers sounds in time; else the one that gives up least."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config.hop import P50_S, P95_S, Latencies, choose_hop
from sfms_robot.frames import FRAME_S

HOPS = range(1, 9)
seconds = st.floats(0.0, 0.3)
measured = st.builds(
    lambda horizon, source, p50, more, lead, tick: Latencies(horizon=horizon, source_s=source, step_p50_s=p50,
    step_p99_s=p50 + more, lead_s=lead, tick_s=tick),
    st.integers(1, 16), seconds, seconds, seconds, seconds, st.sampled_from([0.005, 0.01, 0.02, 0.04]),
)  # fmt: skip


@given(measured)
def test_the_largest_hop_that_fits_is_chosen_keeps_both_figures_and_where_none_fits_none_is_better(latencies):
    choice = choose_hop(HOPS, latencies)
    fitting = [hop for hop in HOPS if latencies.fits(hop)]
    assert (choice.given_up is None) == bool(fitting)
    if fitting:
        assert choice.hop == max(fitting)
    if choice.given_up is None:
        spent_s = choice.hop * FRAME_S + latencies.source_s + latencies.step_p99_s + latencies.lead_s
        assert spent_s <= max(latencies.horizon - 1, 1) * FRAME_S + 1e-6
        assert latencies.p50_s(choice.hop) <= P50_S + 1e-6 and latencies.p95_s(choice.hop) <= P95_S + 1e-6
        assert choice.budget_ms["lead_cut"] == 0
    if choice.given_up is not None:
        for hop in filter(latencies.keeps_up, HOPS):
            assert latencies.left_s(choice.hop) >= latencies.left_s(hop) - 1e-9
            assert latencies.p95_s(choice.hop) <= latencies.p95_s(hop) + 1e-9


@given(measured, st.integers(1, 7))
def test_a_smaller_hop_never_fits_worse_while_the_listener_keeps_up(latencies, hop):
    if latencies.fits(hop + 1) and latencies.keeps_up(hop):
        assert latencies.fits(hop)


@given(measured, st.integers(1, 8))
def test_a_hop_that_is_given_stays(latencies, hop):
    assert choose_hop([hop], latencies).hop == hop


@pytest.mark.parametrize("source_s, step_s, hop", [(0.0, 0.006, 3), (0.02, 0.006, 2), (0.06, 0.006, 1)])
def test_a_later_source_asks_for_a_shorter_hop(source_s, step_s, hop):
    choice = choose_hop(
        HOPS, Latencies(horizon=8, source_s=source_s, step_p50_s=step_s, step_p99_s=step_s, lead_s=0.047, tick_s=0.01)
    )
    assert (choice.hop, choice.given_up) == (hop, None)


def test_a_sound_waits_half_a_hop_then_for_two_ticks():
    latencies = Latencies(horizon=8, source_s=0.012, step_p50_s=0.006, step_p99_s=0.018, lead_s=0.0, tick_s=0.01)
    assert latencies.p50_s(2) == pytest.approx(0.04 + 0.02 + 0.01)
    assert latencies.p95_s(2) == pytest.approx(0.076 + 0.02 + 0.02)
