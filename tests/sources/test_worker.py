"""A source in a process of its own: its values arrive, and a failure is reported and repaired."""

import logging
import threading

import pytest

from sfms_robot.errors import ConfigError, MissingExtra, PortError
from sfms_robot.processes import LIMITS
from sfms_robot.sources.worker import SourceWorker

SILENT_S = LIMITS["source"].silent_s["running"]
PAUSE_S = LIMITS["source"].pause_s


def counts(count):
    for number in range(count):
        yield None
        yield number


def says_and_hangs(value):
    yield value
    threading.Event().wait()


def refuses(text):
    raise ConfigError(text)
    yield


def needs_an_extra(_):
    raise MissingExtra("pip install 'sfms-robot[parts]'")
    yield


def breaks(value):
    yield value
    raise ZeroDivisionError("of a library")


def breaks_at_once(_):
    raise ZeroDivisionError("of a library")
    yield


def answers(told=None):
    while told is None:
        told = yield
    yield told + 1
    threading.Event().wait()


@pytest.fixture
def start():
    """Start a worker; all of them are closed afterwards."""
    workers = []

    def started(work, argument=None, **how):
        workers.append(SourceWorker("test", work, argument, **how))
        return workers[-1]

    yield started
    for worker in workers:
        worker.close()
        assert worker._supervised.child.process.poll() is not None


def until(worker, state, now_s=0.0):
    """Return all that comes until the worker is in this state, at one moment of time."""
    values = []
    while worker.statistics()["state"] != state:
        values += worker.messages(now_s)
    return values


def first_of(worker, now_s):
    while not (values := worker.messages(now_s)):
        pass
    return values[0]


def test_values_come_in_their_order_and_a_worker_that_returns_is_not_started_again(start):
    worker = start(counts, 5)
    assert until(worker, "finished") == [0, 1, 2, 3, 4] and worker.messages(1e9) == [] and not worker.lost
    assert worker.statistics() == {"state": "finished", "restarts": 0, "dropped": 0}


@pytest.mark.parametrize(("work", "error", "text"), [
    (refuses, ConfigError, "^no such thing$"),
    (needs_an_extra, MissingExtra, r"pip install 'sfms-robot\[parts\]'"),
    (breaks_at_once, PortError, "^test: ZeroDivisionError: of a library$"),
])  # fmt: skip
def test_an_error_at_the_start_is_raised_by_wait(start, work, error, text):
    with pytest.raises(error, match=text):
        start(work, "no such thing").wait()


def test_waiting_ends_after_its_limit_and_takes_nothing_away(start):
    with pytest.raises(PortError, match="test: nothing came for 0 s"):
        start(says_and_hangs).wait(0.0)
    worker = start(says_and_hangs, "first")
    worker.wait()
    assert worker.messages(0.0) == ["first"]


def test_a_silent_worker_is_named_once_and_started_again_with_the_newest_message(start, caplog):
    caplog.set_level(logging.INFO, "sfms_robot")
    worker = start(answers)
    worker.tell(41)
    assert first_of(worker, 0.0) == 42
    worker.messages(now_s := 0.9 * SILENT_S)
    assert worker.statistics()["state"] == "running" and not caplog.records
    now_s += 0.2 * SILENT_S
    for _ in range(3):
        worker.messages(now_s)
    assert worker.statistics()["state"] == "lost" and worker.lost and len(caplog.records) == 1
    worker.messages(now_s := now_s + PAUSE_S)
    assert worker.statistics()["restarts"] == 1 and worker.lost
    assert first_of(worker, now_s) == 42 and not worker.lost
    assert [record.getMessage() for record in caplog.records] == [
        f"test: no sign of life for {1.1 * SILENT_S:.1f} s; restarting",
        "test: running again",
    ]


def test_a_worker_that_breaks_is_reported(start, caplog):
    assert until(start(breaks, "born"), "lost") == ["born"]
    assert "test: ZeroDivisionError: of a library; restarting" in caplog.text
