"""No row of a table is cut, wherever it goes."""

from sfms_robot.cli.show_servo import print_table

ROWS = [
    {"id": 11, "joint": "a_joint_with_quite_a_long_name", "model": "xl330-m288", "faults": "input voltage, overload"},
    {"id": 12, "joint": "a_second_joint", "model": "xl330-m288", "faults": "overheating, " * 8},
]


def test_what_reads_a_pipe_finds_whole_rows(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    print_table(ROWS)
    rows = capsys.readouterr().out.splitlines()
    for row in ROWS:
        assert any(all(str(value).strip() in line for value in row.values()) for line in rows)


def test_a_narrow_terminal_folds_texts_and_keeps_numbers(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "50")
    print_table(ROWS)
    told = capsys.readouterr().out
    assert "…" not in told and max(map(len, told.splitlines())) <= 50
    assert "11" in told and "12" in told and told.count("overheating") >= 8
