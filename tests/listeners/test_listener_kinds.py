"""Kinds of listeners that a folder may hold."""

import pytest

from sfms_robot.config.listener import LISTENER_KINDS, parse_listener
from sfms_robot.errors import ConfigError


def test_a_kind_that_is_none_is_one_line_with_the_choices():
    with pytest.raises(ConfigError, match=r"^config.yaml: kind = 'nobody' is not a kind of listener \(sfms, arig\)"):
        parse_listener({"kind": "nobody"}, "config.yaml")


@pytest.mark.parametrize("name", LISTENER_KINDS)
def test_our_settings_say_their_own_kind(name):
    assert LISTENER_KINDS[name].model_fields["kind"].annotation.__args__ == (name,)
