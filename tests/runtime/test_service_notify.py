"""What a service manager is told, over a real socket."""

import os
import socket

import numpy as np
import pytest

from sfms_robot.ports import Tick
from sfms_robot.runtime.observers import NotifyingObserver, ServiceManager


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


def tick(time_s, state="listening", why=()):
    return Tick(time_s, np.zeros(58, np.float32), np.zeros(1), {}, state, why)


def test_a_run_is_ready_when_it_listens_alive_while_it_ticks_and_says_what_it_is(systemd):
    receiver, name = systemd
    observer = NotifyingObserver(ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"}))
    observer.tick(tick(0.0, "starting"))
    assert said(receiver) == ["STATUS=starting", "WATCHDOG=1"]
    observer.tick(tick(0.5, "degraded", ("listener", "jaw")))
    assert said(receiver) == ["READY=1\nSTATUS=degraded: listener, jaw"]
    for index in range(100):
        observer.tick(tick(0.51 + index / 100))
    assert said(receiver) == ["STATUS=listening", "WATCHDOG=1"]
    observer.tick(tick(2.0, "stopping"))
    assert said(receiver) == ["STOPPING=1", "WATCHDOG=1"]


def test_who_does_not_tick_says_nothing(systemd):
    receiver, name = systemd
    NotifyingObserver(ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"}))
    assert said(receiver) == []


def test_without_a_watchdog_nothing_is_said_of_being_alive(systemd):
    receiver, name = systemd
    manager = ServiceManager({"NOTIFY_SOCKET": name})
    manager.alive()
    manager.ready("up")
    assert said(receiver) == ["READY=1\nSTATUS=up"]


def test_the_watchdog_of_another_process_is_not_ours(systemd):
    receiver, name = systemd
    ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}).alive()
    assert said(receiver) == []


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": "/nowhere/at/all"}, {"WATCHDOG_USEC": "soon"}])
def test_nobody_who_listens_is_no_trouble(environment):
    manager = ServiceManager(environment)
    manager.ready("up")
    manager.alive()
    manager.stopping()
    assert manager.every_s == 1.0
