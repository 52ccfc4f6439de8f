"""A run as it is told to its page: 25 pictures a second, events as they are decided."""

import json
import math

import numpy as np
import pytest

from sfms_robot.app.listen.page_observer import PageObserver, people_per_minute
from sfms_robot.errors import ConfigError
from sfms_robot.frames import EVENT_KINDS, FRAME_S, ListenerEvent, Plan, Reading, SpeakerFrame
from sfms_robot.listeners.events.model import load_tables
from sfms_robot.ports import Tick
from sfms_robot.viewer.page_messages import frame_json

JOINTS = ("yaw", "jaw")


class Sent:
    """A page that keeps what it is told."""

    def __init__(self):
        self.visitors = 0
        self.pictures = []
        self.said = []

    def watch(self, now_s):
        self.looked_s = now_s

    def show(self, record):
        self.pictures.append(json.loads(frame_json(record)))

    def later(self, task):
        task()

    def say(self, do, **values):
        self.said.append((do, values))


def tick(time_s, readings=None, state="listening", why=()):
    return Tick(time_s, np.zeros(58, np.float32), np.array([0.1, 0.2]), readings or {}, state, why)


def plan(*events, hazards=None):
    return Plan(1.0, np.array([1.04]), np.zeros((1, 58), np.float32), None, events, hazards or {})


def watching():
    page = Sent()
    return page, PageObserver(page, JOINTS)


def test_of_a_hundred_ticks_a_second_it_shows_twenty_five():
    page, watcher = watching()
    for index in range(200):
        watcher.tick(tick(index / 100))
    assert len(page.pictures) == 50 and page.looked_s == 1.96  # whether the page still answers


def test_joints_are_shown_as_they_are_asked_and_read_and_their_faults_by_name():
    page, watcher = watching()
    readings = {"yaw": Reading(0.11, 0.01), "jaw": Reading(None, math.inf, "silent")}
    watcher.tick(tick(0.0, readings, "degraded", ("jaw",)))
    (shown,) = page.pictures
    assert shown["j"] == [0.1, 0.2] and shown["r"] == [0.11, None] and shown["f"] == {"jaw": "silent"}
    assert (shown["s"], shown["w"], shown["db"], shown["talk"]) == ("degraded", ["jaw"], None, False)
    watcher.tick(tick(0.04, {"yaw": Reading(0.11, 0.9), "jaw": Reading(0.12, 1.1)}))  # a position that is old
    assert page.pictures[1]["r"] == [0.11, None] and page.pictures[1]["u"] == [0.11, 0.2]


def test_the_person_is_shown_by_level_and_by_whether_they_talk():
    page, watcher = watching()
    loud = np.tile(np.array([0.3, -0.3], np.float32), 320)
    for index in range(40):
        heard = loud if index > 20 else np.zeros(640, np.float32)
        watcher.heard(SpeakerFrame((index + 1) * FRAME_S, heard, agent_audio=loud, attention=0.5))
        watcher.tick(tick(index * FRAME_S))
    assert page.pictures[5]["talk"] is False and page.pictures[-1]["talk"] is True
    assert page.pictures[-1]["db"] == page.pictures[-1]["own"] == -10.5 and page.pictures[-1]["at"] == 0.5


def test_what_a_listener_decides_is_told_once_with_what_spoke_for_it():
    page, watcher = watching()
    nod = ListenerEvent("nod", 1.2, 0.6, 0.12, 2, None, 0.03, 0.01, {"phrase_end": 1.5})
    watcher.planned(plan(nod, hazards={"nod": 0.2}))
    watcher.tick(tick(1.0))
    watcher.tick(tick(1.04))
    assert page.said == [
        ("event", {
            "event": "nod", "at_s": 1.2, "lasts_s": 0.6, "size": 0.12, "swings": 2, "probability": 0.03,
            "evidence": {"phrase_end": 1.5},
        })
    ]  # fmt: skip
    assert page.pictures[-1]["h"] == {"nod": 0.2}


def test_the_status_is_told_once_a_second_while_somebody_looks():
    page, watcher = watching()
    watcher.document = lambda: {"state": "listening"}
    for index in range(100):
        watcher.tick(tick(index / 25))
        page.visitors = int(index >= 49)
    assert page.said == [("status", {"status": {"state": "listening"}})] * 2


@pytest.mark.parametrize("listener", ["sfms-small", "arig-small", "zenoh/somewhere"])
def test_the_usual_rates_are_what_a_listener_that_may_decide_events_has_learned(listener):
    told = people_per_minute(listener)
    assert set(told) == set(EVENT_KINDS)
    assert all(rate == load_tables().hazards[kind].per_minute for kind, rate in told.items())
    assert people_per_minute("arig-paper") == {}  # decides none
    with pytest.raises(ConfigError, match="nobody"):
        people_per_minute("nobody")
