"""What a run measures of itself: counted in blocks as from the whole, and in memory that does not grow."""

import gc
import logging
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM, Plan, SpeakerFrame
from sfms_robot.runtime.clock import TickTime
from sfms_robot.runtime.log import EventCounter, RunLog
from sfms_robot.runtime.states import RunState
from sfms_robot.signals.events import find_blinks, find_nods, find_smiles

RATE_HZ = 100.0


def talkative(seconds, seed):
    """Head pitch, lids and smile with events at random, sampled at the rate of the loop."""
    rng, time_s = np.random.default_rng(seed), np.arange(0, seconds, 1 / RATE_HZ)
    pitch, blink, smile = (np.zeros(len(time_s)) for _ in range(3))
    for start in np.arange(2.0, seconds - 3, 7.3) + rng.uniform(0, 3, len(np.arange(2.0, seconds - 3, 7.3))):
        inside = (time_s >= start) & (time_s < start + 1.2)
        pitch[inside] += 0.08 * np.sin(2 * np.pi * 1.7 * (time_s[inside] - start)) ** 2
    for start in np.arange(1.0, seconds - 1, 3.1):
        blink += np.exp(-(((time_s - start) / 0.07) ** 2))
    for start in np.arange(5.0, seconds - 4, 17.0):
        smile[(time_s >= start) & (time_s < start + 2.0)] = 0.6
    return pitch, blink, smile


@pytest.fixture
def worker():
    with ThreadPoolExecutor(1) as pool:
        yield pool


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("seconds", [5.0, 27.9, 28.0, 200.0])
def test_events_counted_in_blocks_are_those_of_the_whole(seconds, seed, worker):
    for signal, find in zip(talkative(seconds, seed), (find_nods, find_blinks, find_smiles), strict=True):
        counter = EventCounter(find, RATE_HZ, worker)
        for value in signal:
            counter.add(float(value))
        whole = len(find(signal, RATE_HZ))
        assert counter.total() == whole and (whole > 0 or seconds < 10)


def test_events_so_far_are_those_of_the_part_that_was_looked_at(worker):
    pitch, _, _ = talkative(60.0, 0)
    counter, looks = EventCounter(find_nods, RATE_HZ, worker), []
    for n, value in enumerate(pitch):
        counter.add(float(value))
        if n % 500 == 499:
            assert counter.so_far >= (looks[-1][1] if looks else 0)  # asks; the next value brings the look
            counter.add(float(pitch[n]))
            worker.submit(int).result()  # it does one thing after the other
            looks.append((n, counter.so_far))
    assert looks[-1][1] >= 5 and abs(looks[-1][1] - counter.total()) <= 1


class NoAudit:
    """The audit's part is not what grows."""

    def start(self, angles_rad):
        return None

    def step(self, angles_rad, wanted_rad, state):
        return None


@pytest.mark.slow
def test_a_log_of_hours_is_as_large_as_one_of_minutes():
    log = RunLog(joints=["a", "b"], period_s=1 / RATE_HZ, audit=NoAudit())
    log.start(np.zeros(2))
    goals, motion = np.zeros(2), np.zeros(MOTION_DIM, np.float32)

    def hear_and_move(first, last):
        for k in range(first, last):
            now_s = k / RATE_HZ
            if k % 4 == 0:
                log.heard(SpeakerFrame(now_s, np.full(640, 0.1, np.float32)))
                log.planned(Plan(now_s, np.array([now_s + 0.04]), np.zeros((1, MOTION_DIM), np.float32)))
            motion[CHANNEL_INDEX["pitch"]] = 0.05 * np.sin(now_s)
            log.commanded(TickTime(now_s, 0.0, 0), goals, goals, motion)
            log.wrote(now_s + 0.01, now_s + 0.1)

    hear_and_move(0, 20_000)
    tracemalloc.start()
    hear_and_move(20_000, 24_000)
    gc.collect()  # what waits to be collected is not kept, and how much of it waits depends on the tests before
    before = tracemalloc.get_traced_memory()[0]
    hear_and_move(24_000, 60_000)
    gc.collect()
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 400_000  # a number kept for every tick would be 1.1 MB; a block may still be being counted
    assert log.frame_to_wire_ms.report(p50=50)["p50"] == pytest.approx(10.0, rel=0.02)


def test_the_share_of_attention_is_of_the_frames_that_tell_it():
    log = RunLog(joints=["a"], period_s=1 / RATE_HZ, audit=NoAudit())
    assert log.attention_report() == {"share": None, "frames": 0}
    for attention in (None, 0.9, 0.6, 0.2, None):
        log.heard(SpeakerFrame(0.04, np.zeros(0, np.float32), attention=attention))
    assert log.attention_report() == {"share": 0.6667, "frames": 3}


def test_a_worker_that_has_ended_loses_no_event():
    pitch, _, _ = talkative(60.0, 0)
    with ThreadPoolExecutor(1) as ended:
        counter = EventCounter(find_nods, RATE_HZ, ended)
        for value in pitch[:3000]:
            counter.add(float(value))
    for value in pitch[3000:]:
        counter.add(float(value))
    assert counter.total() == len(find_nods(pitch, RATE_HZ))


def test_a_state_is_a_warning_only_for_what_no_other_line_reports(caplog):
    caplog.set_level(logging.INFO)
    log = RunLog(joints=["a", "b"], period_s=1 / RATE_HZ, audit=NoAudit())
    for name, why in (("degraded", ("a", "listener")), ("degraded", ("a", "voice")), ("degraded", ("voice",)),
                      ("halted", ("button",)), ("starting", ())):  # fmt: skip
        log.entered(RunState(name, 0.0, why), 0.0)
    assert [(each.levelname, each.getMessage()) for each in caplog.records] == [
        ("INFO", "degraded: a, listener"),
        ("WARNING", "degraded: a, voice"),
        ("INFO", "degraded: voice"),
        ("WARNING", "halted: button"),
        ("INFO", "halt released"),
        ("INFO", "starting"),
    ]
