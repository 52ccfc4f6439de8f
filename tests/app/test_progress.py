import logging
import sys

import pytest

from sfms_robot.app.progress import PLAIN_EVERY_S, PlainBar, bar, console, tracked


@pytest.fixture
def terminal(monkeypatch):
    """Make stderr a terminal for rich."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    console.cache_clear()
    yield
    console.cache_clear()


def test_without_a_terminal_a_line_every_ten_seconds_estimates_the_rest(capsys):
    now_s = [0.0]
    moved = PlainBar("people listening", lambda: now_s[0])
    for done in range(101):
        moved(done, 100, f"{done} of 100")
        now_s[0] += 1.0
    out, lines = capsys.readouterr()
    assert not out
    assert lines.splitlines()[1] == "people listening: 20%, 20 of 100, about 80 s left"
    assert len(lines.splitlines()) == 100 / PLAIN_EVERY_S - 1  # none when it has ended: the result follows


def test_short_work_is_silent_and_a_hidden_bar_shows_nothing(capsys):
    assert list(tracked([1, 2, 3], "counting")) == [1, 2, 3]
    assert capsys.readouterr() == ("", "")
    with bar("looking", hidden=True) as moved:
        moved(1, 2, "id 1")
    assert capsys.readouterr() == ("", "")


@pytest.mark.usefixtures("terminal")
def test_bars_may_be_nested_and_log_lines_stand_above_them(capsys):
    handler, root = logging.StreamHandler(sys.stderr), logging.getLogger()
    root.addHandler(handler)
    try:
        for name in tracked(["a"], "tables"):
            for _ in tracked(range(2), name):
                root.warning("2 clips cannot be read")
        assert handler.stream is sys.stderr
    finally:
        root.removeHandler(handler)
    text = capsys.readouterr().err
    assert "\x1b[2K2 clips cannot be read\n" in text  # in a line of its own, which is cleared before
