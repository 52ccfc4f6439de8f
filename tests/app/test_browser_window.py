"""A browser is opened where somebody sits in front of it."""

import pytest

from sfms_robot.app.options import can_open


@pytest.mark.parametrize(
    ("environment", "platform", "opens"),
    [
        ({}, "linux", False),
        ({"DISPLAY": ":0"}, "linux", True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True),
        ({"DISPLAY": "localhost:10.0", "SSH_CONNECTION": "a b c d"}, "linux", False),
        ({}, "darwin", True),
        ({"SSH_CONNECTION": "a b c d"}, "darwin", False),
    ],
)
def test_a_browser_is_opened_where_there_is_a_screen(environment, platform, opens):
    assert can_open(environment, platform) is opens
