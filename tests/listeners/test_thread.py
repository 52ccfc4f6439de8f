"""Frames that wait for a slow listener, and plans that come too late to be shown."""

import numpy as np
import pytest
from remote_rig import frames

from sfms_robot.frames import FRAME_S, Plan, SpeakerFrame
from sfms_robot.listeners.thread import CATCH_UP, LATE_S, MOST_WAITING, Inbox, Lateness


def filled(items):
    inbox = Inbox()
    for item in items:
        inbox.put(item)
    return inbox


@pytest.mark.parametrize("count", [1, 2, MOST_WAITING])
def test_frames_come_in_their_order_and_none_is_left_out_while_few_are_waiting(count):
    sent, heard = frames(count), []
    inbox = filled(sent)
    for _ in sent:
        heard.append(inbox.next())
        assert inbox.skipped == 0
    assert heard == sent


def test_when_too_many_are_waiting_the_newest_is_next_and_the_others_are_counted():
    sent, inbox = frames(MOST_WAITING + 1), filled(frames(1))
    inbox.next()
    for frame in sent:
        inbox.put(frame)
    assert inbox.next() is sent[-1] and inbox.skipped == MOST_WAITING
    inbox.put(after := frames(1)[0])
    assert inbox.next() is after and inbox.skipped == 0


def test_what_was_said_before_the_listener_was_ready_is_heard_unless_it_never_catches_up():
    sent = frames(5 * MOST_WAITING)
    inbox = filled(sent)
    assert [inbox.next() for _ in sent] == sent and inbox.skipped == 0
    sent = frames(5 * MOST_WAITING)
    inbox, left_out = filled(sent), 0
    for count in range(3 * MOST_WAITING):
        inbox.next()
        left_out += inbox.skipped
        assert (left_out > 0) == (count * CATCH_UP > MOST_WAITING)
        inbox.put(sent[0])
    assert len(inbox._waiting) <= MOST_WAITING


def test_the_end_waits_for_nothing():
    assert filled([*frames(3), None]).next() is None


def plan(made_at_s, horizon=8):
    return Plan(made_at_s, made_at_s + FRAME_S * (1 + np.arange(horizon)), np.zeros((horizon, 58), np.float32))


def told(lateness, begin_s, end_s, late_s):
    """A plan every 0.2 s that comes `late_s` after its frame; the times at which it was lasting."""
    found = []
    for came_s in np.arange(begin_s, end_s, 0.2):
        lateness.came(plan(came_s - late_s), came_s)
        found += [came_s] if lateness.lasting else []
    return found


def test_plans_in_time_or_late_between_others_are_no_matter():
    assert told(Lateness(), 0.0, 10.0, 0.31) == []
    lateness = Lateness()
    for _ in range(10):
        assert told(lateness, 0.0, 0.8, 0.4) == [] and told(lateness, 0.8, 1.0, 0.0) == []


def test_plans_that_all_come_too_late_are_named_after_a_second_until_one_is_in_time(caplog):
    caplog.set_level("INFO")
    lateness = Lateness()
    assert told(lateness, 0.0, LATE_S, 0.4) == [] and told(lateness, LATE_S, 5.0, 0.4)
    assert told(lateness, 5.0, 6.0, 0.1) == []
    assert [record.getMessage() for record in caplog.records] == [
        "the listener's plans come too late to be shown: the run continues without them",
        "the listener's plans are in time again",
    ]


def test_plans_that_are_late_by_their_source_are_not_the_listeners_fault(caplog):
    lateness = Lateness()
    for number in range(100):
        frame = SpeakerFrame(number * FRAME_S, np.zeros(0, np.float32), None)
        lateness.gave(frame, frame.time_s + 0.25)
        lateness.came(plan(frame.time_s), frame.time_s + 0.25 + 0.2)
        assert not lateness.lasting
    assert [record.getMessage() for record in caplog.records] == [
        "plans come too late: sound reaches the listener 250 ms late, by its source (said once)"
    ]
