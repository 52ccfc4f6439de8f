"""Options that may stand alone: `run --status`, `run --status 8000`."""

import pytest

from sfms_robot.cli.main import _completed


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (["run", "--status"], ["run", "--status", "auto"]),
        (["run", "--status", "8000"], ["run", "--status", "8000"]),
        (["run", "--status=8000", "--play", "--json"], ["run", "--status=8000", "--play", "default", "--json"]),
        (["run", "--play", "--status"], ["run", "--play", "default", "--status", "auto"]),
        (["run", "--play", "USB", "--fast"], ["run", "--play", "USB", "--fast"]),
        ([], []),
    ],
)
def test_one_that_stands_alone_has_the_value_that_it_is_short_for(words, completed):
    assert _completed(words) == completed
