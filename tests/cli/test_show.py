"""Any result is JSON that a strict reader accepts; no table cuts a row."""

import io
from contextlib import redirect_stdout

import pytest
from ended import Ended
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.cli import show

FIGURES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.lists(inner).map(tuple) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


def finite(value):
    """Return a value as JSON holds it: tuples are lists, NaN and infinity are null."""
    if isinstance(value, dict):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each) for each in value]
    return None if value in (float("inf"), float("-inf")) or value != value else value


@given(told=st.dictionaries(st.text(), FIGURES))
def test_any_result_is_one_line_of_json(told):
    with redirect_stdout(io.StringIO()) as out:
        show.print_json(told)
    assert out.getvalue().count("\n") == 1 and Ended(0, out.getvalue(), "").told == finite(told)


@pytest.mark.parametrize("nothing", [float("nan"), None])
def test_a_cell_without_a_figure_is_a_dash(nothing):
    assert show.cell(nothing) == "-"


ROWS = [
    {"id": 11, "joint": "a_joint_with_quite_a_long_name", "model": "xl330-m288", "faults": "input voltage, overload"},
    {"id": 12, "joint": "a_second_joint", "model": "xl330-m288", "faults": "overheating, " * 8},
]


def test_a_pipe_holds_whole_rows_and_a_narrow_terminal_folds_texts_but_not_numbers(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    show.print_rows(ROWS)
    lines = capsys.readouterr().out.splitlines()
    for row in ROWS:
        assert any(all(str(value).strip() in line for value in row.values()) for line in lines)
    monkeypatch.setenv("COLUMNS", "50")
    show.print_rows(ROWS)
    narrow = capsys.readouterr().out
    assert "…" not in narrow and max(map(len, narrow.splitlines())) <= 50
    assert "11" in narrow and "12" in narrow and narrow.count("overheating") >= 8
