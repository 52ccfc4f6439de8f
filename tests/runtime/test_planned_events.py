"""Events in plans: each is told once, before it is over on the servos, and in bounded memory."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from sfms_robot.errors import InputError
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM, ListenerEvent, Plan
from sfms_robot.ports import Tick
from sfms_robot.runtime.planned_events import WINDOW, EventWatch, PlannedEvents
from sfms_robot.signals.events import find_blinks, find_nods, find_smiles

PITCH = CHANNEL_INDEX["pitch"]
BLINK = [CHANNEL_INDEX["eyeBlinkLeft"], CHANNEL_INDEX["eyeBlinkRight"]]
SMILE = [CHANNEL_INDEX["mouthSmileLeft"], CHANNEL_INDEX["mouthSmileRight"]]


def face_of(seconds, seed):
    """(T, 58) at 25 Hz with nods, blinks and smiles here and there."""
    rng = np.random.default_rng(seed)
    motion = np.zeros((round(seconds * 25), MOTION_DIM), np.float32)
    for start in np.arange(2.0, seconds - 3, 2.5):
        at = round((start + rng.uniform(0, 0.8)) * 25)
        motion[at : at + 13, PITCH] += 0.12 * np.sin(np.pi * np.arange(13) / 13) ** 2
    for start in np.arange(1.0, seconds - 3, 1.9):
        at = round((start + rng.uniform(0, 0.8)) * 25)
        motion[at : at + 4, BLINK] = np.array([0.5, 1.0, 0.8, 0.3])[:, None]
    for start in np.arange(3.0, seconds - 3, 7.0):
        at = round(start * 25)
        motion[at : at + 60, SMILE] = np.sin(np.pi * np.arange(60) / 60)[:, None] * 0.7
    return motion


def plans_of(motion, hop, horizon):
    """Plans as a listener makes them: every `hop` frames, the next `horizon`."""
    for begins in range(1, len(motion) - horizon, hop):
        times = (begins + np.arange(horizon)) / 25
        yield Plan(float(times[0] - 0.04), times, motion[begins : begins + horizon])


@pytest.mark.parametrize(("hop", "horizon"), [(4, 8), (1, 1), (2, 8)])
@pytest.mark.parametrize("seed", range(2))
def test_every_event_is_told_once_whatever_the_horizon(hop, horizon, seed):
    motion = face_of(60, seed)
    found, heard = PlannedEvents(), []
    for plan in plans_of(motion, hop, horizon):
        for event in found.add(plan):
            heard.append(event)
            # A nod or a blink is told with the plan that completes it, not later than one hop and one frame after.
            if event.kind != "smile":
                assert event.end_s >= plan.times_s[-1] - (hop + 2) / 25 - (0.5 if event.kind == "nod" else 0.1)
    signals = {"nod": motion[:, PITCH], "blink": motion[:, BLINK].max(1), "smile": motion[:, SMILE].mean(1)}
    detectors = {"nod": find_nods, "blink": find_blinks, "smile": find_smiles}
    for kind, signal in signals.items():
        offline = [start for start, _, _ in detectors[kind](signal.astype(float), 25)]
        told = [event.start_s for event in heard if event.kind == kind]
        assert len(told) == len(offline) and np.allclose(told, offline, atol=0.25)


def test_a_gap_or_another_time_is_no_event_and_a_day_of_plans_takes_the_room_of_eight_seconds():
    found, still = PlannedEvents(), np.zeros((8, MOTION_DIM), np.float32)
    told = []
    for begins in (0.04, 1.0, 400.0, 400.16, 0.04, 0.2):
        told += found.add(Plan(begins - 0.04, begins + np.arange(8) / 25, still))
    assert told == []
    found = PlannedEvents()
    for plan in plans_of(face_of(40, 0), 4, 8):
        found.add(plan)
    assert found._signals.shape[1] == WINDOW


def test_callbacks_are_told_and_one_that_raises_is_detached_and_named():
    watch, told, threads = EventWatch(), [], set()

    def breaks(event):
        raise RuntimeError("no")

    def keeps(event):
        told.append(event.kind)
        threads.add(threading.current_thread().name)

    watch.on("nod", breaks)
    watch.on("nod", keeps)
    watch.on("blink", keeps)
    for plan in plans_of(face_of(20, 1), 4, 8):
        watch.planned(plan)
    watch.close()
    watch.join(30.0)
    assert told.count("nod") > 3 and told.count("blink") > 3
    assert list(watch.detached.values()) == ["RuntimeError: no"] and "breaks" in next(iter(watch.detached))
    assert threads == {"events"}


def test_an_unknown_event_is_refused_with_those_there_are():
    with pytest.raises(InputError, match=r"on\('wink'\): no such event \(nod, shake, tilt, laugh"):
        EventWatch().on("wink", print)


def test_an_event_says_when_it_starts_by_the_clock_of_programs():
    nod = ListenerEvent("nod", 0.2, 0.6, 0.1)
    watch, seen = EventWatch(), []
    watch.tick(Tick(0.0, np.zeros(MOTION_DIM, np.float32), np.zeros(1), {}, origin_s=1000.0))
    watch.on("nod", seen.append)
    plan = Plan(0.04, 0.04 * np.arange(2, 10), np.zeros((8, MOTION_DIM), np.float32), events=(nod,))
    watch.planned(plan)
    watch.close()
    watch.join(10)
    assert (seen[0].start_s, seen[0].starts_monotonic_s, nod.starts_monotonic_s) == (0.2, 1000.2, None)


def test_what_a_listener_decides_is_told_as_it_is_and_motion_is_not_looked_at():
    nod = ListenerEvent("nod", 0.2, 0.6, 0.1, swings=2, probability=0.1, draw=0.05, evidence={"silence": 0.4})
    found, motion = PlannedEvents(), np.zeros((8, MOTION_DIM), np.float32)
    motion[2:5, CHANNEL_INDEX["eyeBlinkLeft"]] = 1.0
    plan = Plan(0.04, 0.04 * np.arange(2, 10), motion, events=(nod,), hazards_hz={"nod": 0.1})
    assert found.add(plan) == [nod] and found.add(replace(plan, made_at_s=0.12, events=())) == []
