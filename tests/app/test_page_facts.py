"""What a page is told of how often people do what."""

import pytest

from sfms_robot.app.listen.page_facts import people_per_minute
from sfms_robot.errors import ConfigError
from sfms_robot.frames import EVENT_KINDS
from sfms_robot.listeners.events.model import load_tables


@pytest.mark.parametrize("listener", ["sfms-small", "arig-small", "zenoh/somewhere"])
def test_of_a_listener_that_may_decide_events_it_is_what_was_learned(listener):
    told = people_per_minute(listener)
    assert set(told) == set(EVENT_KINDS)
    assert all(rate == load_tables().hazards[kind].per_minute for kind, rate in told.items())


def test_of_a_listener_that_decides_none_it_is_nothing():
    assert people_per_minute("arig-paper") == {}


def test_a_listener_that_is_not_there_is_refused():
    with pytest.raises(ConfigError, match="nobody"):
        people_per_minute("nobody")
