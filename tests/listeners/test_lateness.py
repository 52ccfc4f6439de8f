"""A listener that answers and is always too late is named, and one plan in time is enough to be believed again."""

import numpy as np

from sfms_robot.frames import FRAME_S, Plan
from sfms_robot.listeners.thread import LATE_S, Lateness


def plan(made_at_s, horizon=8):
    return Plan(made_at_s, made_at_s + FRAME_S * (1 + np.arange(horizon)), np.zeros((horizon, 58), np.float32))


def told(lateness, begin_s, end_s, late_s):
    """A plan every 0.2 s that comes `late_s` after its frame; the times at which it was lasting."""
    found = []
    for came_s in np.arange(begin_s, end_s, 0.2):
        lateness.came(plan(came_s - late_s), came_s)
        found += [came_s] if lateness.lasting else []
    return found


def test_plans_in_time_are_no_matter_however_late_they_are():
    assert told(Lateness(), 0.0, 10.0, 0.31) == []


def test_plans_that_all_come_too_late_are_named_after_a_second_until_one_is_in_time(caplog):
    lateness = Lateness()
    assert told(lateness, 0.0, LATE_S, 0.4) == []
    assert told(lateness, LATE_S, 5.0, 0.4)
    assert told(lateness, 5.0, 6.0, 0.1) == []
    assert [record.getMessage() for record in caplog.records] == [
        "the listener's plans come too late to be shown: the run continues without them",
        "the listener's plans are in time again",
    ]


def test_late_ones_between_others_are_no_matter():
    lateness = Lateness()
    for _ in range(10):
        assert told(lateness, 0.0, 0.8, 0.4) == [] and told(lateness, 0.8, 1.0, 0.0) == []
