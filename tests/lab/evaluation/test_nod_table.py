"""Rates are those of the counts, and cells cover every phase once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.lab.evaluation.nod_table import CELLS, Counts, cells

MINUTE = 60 * 25


def counts(nods, minutes):
    """The given numbers in the first cells, nothing in the others."""
    return Counts(*(np.pad(np.array(v, float), (0, CELLS - len(v))) for v in (nods, minutes)))


@given(st.floats(0, 100), st.floats(0, 100), st.floats(0, 100))
def test_every_phase_has_one_cell(speech_s, silence_s, last_s):
    cell = cells(np.array([[speech_s, silence_s, last_s]]))
    assert cell.shape == (1,) and 0 <= cell[0] < CELLS


def test_every_cell_has_a_phase():
    speech = [(s, 0.0) for s in (0.5, 1.5, 3, 6, 20)]
    silence = [(0.0, s) for s in (0.3, 0.6, 1.0, 5.0)]
    phases = np.array([(*now, last) for now in speech + silence for last in (0.0, 2.0, 9.0)])
    assert sorted(cells(phases)) == list(range(CELLS))


def test_counts_are_onsets_and_minutes_within_listening():
    cell = np.r_[np.zeros(MINUTE, int), np.ones(2 * MINUTE, int)]
    listening = np.r_[np.ones(2 * MINUTE, bool), np.zeros(MINUTE, bool)]
    found = Counts.of(cell, np.array([5, 10, MINUTE, 3 * MINUTE - 1, 10 * MINUTE]), listening)
    assert found.nods[:3].tolist() == [2, 1, 0]
    assert found.minutes[:3].tolist() == [1, 1, 0]


def test_a_busy_cell_has_the_higher_rate_and_an_unknown_one_the_mean():
    rates = counts([40, 10], [10, 10]).rates()
    assert rates[0] > rates[2] > rates[1]
    assert rates[2] == pytest.approx(2.5)


def test_rates_with_much_data_are_the_plain_ones():
    assert counts([4000, 1000], [1000, 1000]).rates()[:2] == pytest.approx([4, 1], rel=0.02)


def test_without_nods_all_rates_are_nought():
    assert not counts([0], [10]).rates().any()
