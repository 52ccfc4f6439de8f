"""The status document, and notifications to systemd."""

import json
import os
import socket

import numpy as np
import pytest

from sfms_robot.frames import FaceFrame, Reading, SpeakerFrame
from sfms_robot.ports import Tick
from sfms_robot.runtime.observers import NotifyingObserver, RunStatus, ServiceManager
from sfms_robot.runtime.states import RunState

JOINTS = ("neck_yaw", "jaw")


def tick(state: str = "listening", why: tuple[str, ...] = ()) -> Tick:
    readings = {
        "jaw": Reading(None, float("inf"), "silent"),
        "neck_yaw": Reading(0.25, 0.01, extra={"temperature_C": 41.0, "current_mA": float("nan")}),
    }
    return Tick(2.0, np.zeros(58, np.float32), np.array([0.5, -0.5]), readings, state, why)


def test_before_the_first_tick_it_is_starting_and_counters_are_asked_for_every_time() -> None:
    document = RunStatus(JOINTS, {"head": "face28"}).document()
    assert (document["head"], document["state"], document["person"]["seen"]) == ("face28", "starting", False)
    json.dumps(document, allow_nan=False)
    counts = iter(range(9))
    status = RunStatus(JOINTS, {}, lambda: {"ticks": next(counts)})
    assert [status.document()["ticks"] for _ in range(3)] == [0, 1, 2]


def test_joints_are_told_by_name_with_null_for_what_nobody_knows() -> None:
    status = RunStatus(JOINTS, {})
    status.tick(tick())
    document = json.loads(json.dumps(status.document(), allow_nan=False))
    assert document["joints"]["neck_yaw"] == {
        "goal_rad": 0.5, "present_rad": 0.25, "age_s": 0.01, "temperature_C": 41.0, "current_mA": None,
    }  # fmt: skip
    assert document["joints"]["jaw"] == {"goal_rad": -0.5, "present_rad": None, "age_s": None}
    assert document["faults"] == {"jaw": "silent"}
    assert document["hottest"] == {"joint": "neck_yaw", "temperature_C": 41.0}


def test_the_person_is_what_the_newest_frame_holds() -> None:
    status = RunStatus(JOINTS, {})
    face = FaceFrame(0.0, np.zeros(6, np.float32), np.zeros(52, np.float32))
    loud = np.full(640, 0.1, np.float32)
    status.heard(SpeakerFrame(0.04, loud, face, np.zeros(640, np.float32), attention=0.75))
    assert status.document()["person"] == {
        "voice_db": -20.0, "seen": True, "attention": 0.75, "own_voice_db": -100.0,
    }  # fmt: skip
    status.heard(SpeakerFrame(0.08, loud[:0]))
    assert status.document()["person"] == {"voice_db": None, "seen": False, "attention": None, "own_voice_db": None}


@pytest.mark.parametrize("error", [None, "torque of jaw could not be confirmed off"])
def test_after_the_end_it_shows_the_last_state_and_joints_whose_torque_is_not_confirmed_off(error) -> None:
    status = RunStatus(JOINTS, {}, lambda: {"torque_unconfirmed": ["jaw"] if error else []})
    assert RunStatus(JOINTS, {}).document()["torque_unconfirmed"] == []
    status.tick(tick("stopping"))
    status.ended(RunState("stopping").ended(3.0, error))
    document = json.loads(json.dumps(status.document(), allow_nan=False))
    shown = [document[key] for key in ("state", "why", "note", "torque_unconfirmed")]
    assert shown == (["fault", [error], error, ["jaw"]] if error else ["stopped", [], None, []])


@pytest.fixture(params=["path", "abstract"])
def systemd(request, tmp_path):
    """The socket that NOTIFY_SOCKET names, and what to put there."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@sfms-robot-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind("\0" + name[1:] if name.startswith("@") else name)
        receiver.setblocking(False)
        yield receiver, name


def said(receiver):
    lines = []
    while True:
        try:
            lines.append(receiver.recv(4096).decode())
        except BlockingIOError:
            return lines


def ticked(time_s, state="listening", why=()):
    return Tick(time_s, np.zeros(58, np.float32), np.zeros(1), {}, state, why)


def test_a_run_is_ready_when_it_listens_alive_while_it_ticks_and_says_what_it_is(systemd):
    receiver, name = systemd
    observer = NotifyingObserver(ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"}))
    observer.tick(ticked(0.0, "starting"))
    assert said(receiver) == ["STATUS=starting", "WATCHDOG=1"]
    observer.tick(ticked(0.5, "degraded", ("listener", "jaw")))
    assert said(receiver) == ["READY=1\nSTATUS=degraded: listener, jaw"]
    for index in range(100):
        observer.tick(ticked(0.51 + index / 100))
    assert said(receiver) == ["STATUS=listening", "WATCHDOG=1"]
    observer.tick(ticked(2.0, "stopping"))
    assert said(receiver) == ["STOPPING=1", "WATCHDOG=1"]


def test_nothing_is_said_before_a_tick_without_a_watchdog_or_for_that_of_another_process(systemd):
    receiver, name = systemd
    NotifyingObserver(ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"}))
    assert said(receiver) == []
    manager = ServiceManager({"NOTIFY_SOCKET": name})
    manager.alive()
    manager.ready("up")
    assert said(receiver) == ["READY=1\nSTATUS=up"]
    ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}).alive()
    assert said(receiver) == []


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": "/nowhere/at/all"}, {"WATCHDOG_USEC": "soon"}])
def test_nobody_who_listens_is_no_trouble(environment):
    manager = ServiceManager(environment)
    manager.ready("up")
    manager.alive()
    manager.stopping()
    assert manager.every_s == 1.0
