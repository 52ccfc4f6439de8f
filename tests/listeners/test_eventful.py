"""When and how together: streams side by side, each event told once, the eyes at the person, a memory that ends."""

from dataclasses import replace

import numpy as np
import pytest
from tiny_sfms import speech, told_listener

from sfms_robot.config import Calmness
from sfms_robot.frames import CHANNEL_INDEX, EVENT_KINDS, FRAME_S, FaceFrame
from sfms_robot.listeners.eventful import EventfulListener, target_at
from sfms_robot.listeners.events.model import LEAD_FRAMES, EventModel
from sfms_robot.signals.gaze_kinematics import directions

LIVELY = Calmness(nod=40, shake=10, tilt=10, smile=20, brow_raise=20, blink=40, gaze_shift=30, addressed="assume")
NOTHING = Calmness(**dict.fromkeys(EVENT_KINDS, 0.0))
EYES_RAD = np.radians([30.0, 20.0])


@pytest.fixture(scope="module")
def when():
    return EventModel.load()


@pytest.fixture(scope="module")
def lively(when):
    return EventfulListener(told_listener(hop=2), when, LIVELY)


def plans_of(listener, speaker, seed=1):
    memory, plans = listener.start(seed), []
    for frame in speaker:
        plan, memory = listener.step(frame, memory)
        plans += [] if plan is None else [plan]
    return plans, memory


def test_each_event_is_told_once_before_it_begins_and_with_why(lively):
    plans, _ = plans_of(lively, speech(500))
    events = [event for plan in plans for event in plan.events]
    assert len(events) > 10 and len({(event.kind, event.start_s) for event in events}) == len(events)
    for plan in plans:
        assert all(0 < event.start_s - plan.made_at_s <= (LEAD_FRAMES + 1) * FRAME_S for event in plan.events)
        assert set(plan.hazards_hz) == set(EVENT_KINDS) and np.isfinite(list(plan.hazards_hz.values())).all()
    drawn = [event for event in events if event.draw is not None]
    assert drawn and all(event.draw < event.probability and event.evidence for event in drawn)


@pytest.mark.parametrize("hop", [pytest.param(1, marks=pytest.mark.slow), 2, 4])
def test_a_plan_tells_of_an_event_before_the_first_frame_that_shows_it(when, hop):
    plans, _ = plans_of(EventfulListener(told_listener(hop=hop), when, LIVELY), speech(300))
    begun = [(plan.times_s[0] - FRAME_S, event.start_s) for plan in plans for event in plan.events]
    assert begun and all(start_s >= shown_s - 1e-6 for shown_s, start_s in begun)


def test_eyes_stay_at_the_person_when_nothing_is_decided_whatever_the_head_does(when):
    how = told_listener(hop=2)
    how.model.motion_std.mul_(0.02)  # untrained, it would turn the head farther than eyes go
    plans, memory = plans_of(EventfulListener(how, when, NOTHING), speech(200))
    assert not any(plan.events for plan in plans) and not memory.when.done
    shown = np.concatenate([plan.frames[:2] for plan in plans])
    gaze = shown[:, [2, 1]] + directions(shown, EYES_RAD).mean(axis=1)
    assert np.ptp(np.degrees(shown[:, 1:3]), axis=0).max() > 0.5 and np.degrees(np.abs(gaze)).max() < 3.0


@pytest.mark.slow
def test_eyes_go_where_a_gaze_shift_says(lively):
    plans, _ = plans_of(lively, speech(600))
    events = [event for plan in plans for event in plan.events]
    away = [event for event in events if event.kind == "gaze_shift" and np.hypot(*event.target_rad) > 0.1]
    assert away
    both = (row for plan in plans for row in zip(plan.times_s[:2], plan.frames, strict=False))
    shown = {round(time_s / FRAME_S): row for time_s, row in both}
    for shift in away:
        following = [event.start_s for event in events if event.kind == "gaze_shift" and event.start_s > shift.start_s]
        looks_s = min([*following, 24.0]) - shift.start_s
        row = shown.get(round((shift.start_s + min(looks_s, 0.4)) / FRAME_S))
        if looks_s > 0.3 and row is not None and np.abs(row[[2, 1]]).max() < 0.2:
            gaze = row[[2, 1]] + directions(row[None], EYES_RAD)[0].mean(axis=0)
            assert np.degrees(np.abs(gaze - shift.target_rad)).max() < 4.0


def test_memory_holds_what_is_under_way_and_no_more(lively):
    memory, longest = lively.start(0), 0
    for frame in speech(500):
        _, memory = lively.step(frame, memory)
        longest = max(longest, len(memory.when.done))
    assert longest < 300 and len(memory.gaze) <= lively.horizon + 1
    assert len(target_at([e for e in memory.when.done if e.target_rad], 21.0)) == 2


def test_a_stream_tells_times_of_the_run_and_at_hop_plans_as_often_and_decides_the_same(lively):
    later = [replace(frame, time_s=frame.time_s + 100.0) for frame in speech(200)]
    plans, _ = plans_of(lively, later)
    events = [event for plan in plans for event in plan.events]
    assert events and all(100.0 < event.start_s < 108.2 for event in events)
    assert later[0].number == 2500
    speaker = speech(240)
    two, four = plans_of(lively, speaker)[0], plans_of(lively.at_hop(4), speaker)[0]
    assert len(two) == 2 * len(four)
    events = [[(e.kind, e.start_s) for plan in plans for e in plan.events] for plans in (two, four)]
    assert events[0][: len(events[1])] == events[1] and events[1]


@pytest.mark.parametrize(("channel", "value"), [("roll", np.pi), ("yaw", -1.1), ("x", 2.0), ("pitch", np.nan)])
def test_a_face_as_no_camera_sees_one_moves_it_as_none_does(when, channel, value):
    """Upside down, turned away, in another room."""
    calm, near, motion = EventfulListener(told_listener(hop=2), when, NOTHING), speech(40), np.zeros(58, np.float32)
    motion[CHANNEL_INDEX[channel]] = value
    far = [replace(frame, face=FaceFrame.of(frame.time_s, motion)) for frame in near]
    nobody = [plan.frames for plan in plans_of(calm, [replace(frame, face=None) for frame in near])[0]]
    np.testing.assert_array_equal([plan.frames for plan in plans_of(calm, far)[0]], nobody)
    assert not np.array_equal([plan.frames for plan in plans_of(calm, near)[0]], nobody)


def test_rates_change_from_the_next_frame_on_between_plans_too(lively):
    slow, told = lively.at_hop(4), []
    memory = slow.start(5)
    for index, frame in enumerate(speech(600)):
        if index == 302:  # the next plan is made at 304
            memory = slow.calmed(memory, NOTHING)
        plan, memory = slow.step(frame, memory)
        told += [] if plan is None else [event for event in plan.events if event.draw is not None]
    begun_s = [event.start_s for event in told]
    assert min(begun_s) < 12.0 and max(begun_s) <= (302 + LEAD_FRAMES) * FRAME_S + 1e-6
