"""Options of a run that depend on others, and where a browser is opened."""

import pytest

from sfms_robot.app.options import RunOptions, can_open


@pytest.mark.parametrize(
    ("options", "hears"),
    [
        ({}, "default"),
        ({"port": "/dev/ttyUSB0"}, "mic"),
        ({"port": "/dev/ttyUSB0", "audio": "katie"}, "katie"),
        ({"port": "/dev/ttyUSB0", "audio": "none"}, "none"),
        ({"port": "/dev/ttyUSB0", "dry_run": True}, "default"),
    ],
)
def test_a_head_on_a_real_port_hears_the_microphone_unless_told_otherwise(options, hears):
    assert RunOptions(**options).hears == hears


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
