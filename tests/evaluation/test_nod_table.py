"""Rates are those of the counts, cells cover every phase once, and nobody is judged by his own series."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.evaluation.nod_table import CELLS, Counts, NodTable, cells, load, save

MINUTE = 60 * 25
SHIPPED = data_dir("sim") / "listeners" / "nod_table.yaml"


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


def test_own_series_never_counts():
    table = NodTable({"A": counts([100], [1]), "B": counts([0, 50], [10, 10])})
    np.testing.assert_array_equal(table.rates_for("A"), table.series["B"].rates())
    np.testing.assert_array_equal(table.rates_for("C"), Counts.total(table.series.values()).rates())


def test_a_table_of_one_series_has_no_others_to_go_by():
    table = NodTable({"A": counts([100], [1])})
    np.testing.assert_array_equal(table.rates_for("A"), table.series["A"].rates())


def test_what_is_saved_is_loaded(tmp_path):
    table = NodTable({"A": counts([3, 4], [1.25, 2.5]), "B": counts([1], [1])})
    save(tmp_path / "table.yaml", table, "two\nlines")
    again = load(tmp_path / "table.yaml")
    assert (tmp_path / "table.yaml").read_text().startswith("# two\n# lines\n")
    for name, found in table.series.items():
        np.testing.assert_array_equal(again.series[name].nods, found.nods)
        np.testing.assert_array_equal(again.series[name].minutes, found.minutes)


def test_the_shipped_table_nods_most_behind_long_phrases():
    """In the meetings it was counted in: 1.9 a minute, 2.6 to 3 behind phrases of over 3 s, 1.3 as one begins."""
    table = load(SHIPPED)
    total = Counts.total(table.series.values())
    assert total.nods.sum() / total.minutes.sum() == pytest.approx(1.86, abs=0.05)
    behind, beginning, late = total.rates()[cells(np.array([[0, 0.3, 5], [0.5, 0, 5], [12.0, 0, 5]]))]
    assert behind > late > beginning


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("nothing", "not a table of nod rates"),
        ("a: [", "not a table of nod rates"),
        ("{edges: {speech_s: [1], silence_s: [], last_phrase_s: []}, series: {}}", "not those of this version"),
    ],
)
def test_a_broken_table_is_named(tmp_path, text, problem):
    (tmp_path / "table.yaml").write_text(text)
    with pytest.raises(ConfigError, match=f"table.yaml: .*{problem}"):
        load(tmp_path / "table.yaml")


@pytest.mark.parametrize("change", [("[3", "[-3"), ("[3", "[.nan"), ("[3, ", "[")])
def test_wrong_numbers_are_named(tmp_path, change):
    save(tmp_path / "table.yaml", NodTable({"A": counts([3], [1.25])}), "")
    text = (tmp_path / "table.yaml").read_text()
    (tmp_path / "table.yaml").write_text(text.replace(*change, 1))
    with pytest.raises(ConfigError, match=r"series\.A\.nods: needs 27 numbers"):
        load(tmp_path / "table.yaml")


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigError, match="cannot be written"):
        save(tmp_path / "gone" / "table.yaml", NodTable({"A": counts([3], [1.25])}), "")
