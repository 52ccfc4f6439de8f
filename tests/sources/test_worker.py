"""A source in a process of its own: what it yields arrives, and whatever ends it is said once and made good."""

import logging
import os
import signal
import subprocess
import sys
import threading

import pytest
from stranger_process import ends

from sfms_robot.errors import ConfigError, MissingExtra, PortError
from sfms_robot.sources.worker import FIRST_PAUSE_S, LONGEST_PAUSE_S, SILENT_S, START_LIMIT_S, SourceWorker

NEVER_S = -1e9  # a time at which nothing has been silent for long
LATER_S = 1e9


def counts(count):
    for number in range(count):
        yield None
        yield number


def tells_its_niceness(_):
    yield os.nice(0)


def says_and_hangs(value):
    yield value
    threading.Event().wait()


def refuses(text):
    raise ConfigError(text)
    yield


def needs_an_extra(_):
    raise MissingExtra.of("this", "parts")
    yield


def breaks(value):
    yield value
    raise ZeroDivisionError("of a library")


def breaks_at_once(_):
    raise ZeroDivisionError("of a library")
    yield


def dies(_):
    yield "born"
    os.kill(os.getpid(), signal.SIGKILL)


def tells_what_ctrl_c_does(_):
    os.write(1, b"a library prints")
    yield signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def answers(told=None):
    while told is None:
        told = yield
    yield told + 1
    threading.Event().wait()


@pytest.fixture
def start():
    """How to start a worker; all of them are closed afterwards."""
    workers = []

    def started(work, argument=None, **how):
        workers.append(SourceWorker("test", work, argument, **how))
        return workers[-1]

    yield started
    for worker in workers:
        worker.close()
        assert worker._child.process.poll() is not None


def next_of(worker, now_s=NEVER_S):
    """What comes next; waits for the child itself, however long that takes on this computer."""
    assert worker._child.arrived.wait(60.0)
    worker._child.arrived.clear()
    return worker.messages(now_s)


def first_of(worker):
    while not (values := next_of(worker)):
        pass
    return values[0]


def until(worker, state, now_s=NEVER_S):
    """All that comes until the worker is in this state."""
    values = []
    while worker.statistics()["state"] != state:
        values += next_of(worker, now_s)
    return values


def test_values_come_in_their_order_and_a_worker_that_returns_is_not_started_again(start):
    worker = start(counts, 5)
    assert until(worker, "finished") == [0, 1, 2, 3, 4]
    assert worker.messages(LATER_S) == []
    assert worker.statistics() == {"state": "finished", "restarts": 0, "dropped": 0}


def test_what_is_not_fetched_is_dropped_oldest_first_and_counted(start):
    worker = start(counts, 50, most_waiting=10)
    worker._child._reader.join()
    assert worker.messages(NEVER_S) == list(range(41, 50))  # and the end
    assert worker.statistics()["dropped"] == 50 + 1 - 10


@pytest.mark.parametrize(("work", "error", "text"), [
    (refuses, ConfigError, "no such thing"),
    (needs_an_extra, MissingExtra, r"pip install 'sfms-robot\[parts\]'"),
])  # fmt: skip
def test_what_is_wrong_at_the_start_is_raised_to_who_waits(start, work, error, text):
    with pytest.raises(error, match=text):
        start(work, "no such thing").wait()


def test_what_breaks_at_the_start_is_said_with_whose_it_is(start):
    with pytest.raises(PortError, match="^test: ZeroDivisionError: of a library$"):
        start(breaks_at_once).wait()


def test_a_worker_that_never_says_anything_is_waited_for_no_longer_than_asked(start):
    with pytest.raises(PortError, match="test: nothing came for 0 s"):
        start(says_and_hangs).wait(0.0)


def test_waiting_takes_nothing_away(start):
    worker = start(says_and_hangs, "first")
    worker.wait()
    assert worker.messages(NEVER_S) == ["first"]


def test_a_silent_worker_is_named_once_and_started_again(start, caplog):
    worker = start(says_and_hangs, "hello")
    assert next_of(worker) == ["hello"]
    heard_s = worker._child.heard_s
    worker.messages(heard_s + 0.9 * SILENT_S)
    assert worker.statistics()["state"] == "running" and not caplog.records
    now_s = heard_s + 1.1 * SILENT_S
    for _ in range(3):
        worker.messages(now_s)
    assert worker.statistics()["state"] == "lost" and len(caplog.records) == 1
    worker.messages(now_s + FIRST_PAUSE_S)
    assert until(worker, "running") == ["hello"]
    assert worker.statistics()["restarts"] == 1
    assert [record.getMessage() for record in caplog.records] == [
        f"test: nothing came for {1.1 * SILENT_S:.1f} s; it is tried again until it is back",
        "test is back",
    ]


def test_pauses_before_restarts_double_up_to_the_longest(start, caplog):
    worker = start(refuses, "gone")
    now_s, paused_s = NEVER_S, []
    for _ in range(6):
        until(worker, "lost", now_s)
        paused_s.append(worker._begins_s - now_s)
        now_s = worker._begins_s
        worker.messages(now_s)
    assert paused_s == [min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2**each) for each in range(6)]
    assert len(caplog.records) == 1 and "gone" in caplog.text


@pytest.mark.parametrize(("work", "why"), [(dies, "died (exit code -9)"), (breaks, "ZeroDivisionError: of a library")])
def test_a_worker_that_dies_or_breaks_is_said(start, caplog, work, why):
    worker = start(work, "born")
    assert until(worker, "lost") == ["born"]
    assert why in caplog.text


def test_one_that_does_not_start_counts_as_silent_after_a_minute(start):
    worker = start(says_and_hangs)
    worker.messages(worker._begins_s + 1.1 * START_LIMIT_S)
    assert worker.statistics()["state"] == "lost"


def test_what_a_worker_is_told_comes_to_it_and_to_the_one_started_in_its_place(start):
    worker = start(answers)
    worker.tell(41)
    assert first_of(worker) == 42
    worker.messages(worker._child.heard_s + 1.1 * SILENT_S)
    worker.messages(worker._begins_s)
    assert worker.statistics()["restarts"] == 1
    assert first_of(worker) == 42


def test_a_stopped_worker_is_ended_too(start):
    worker = start(says_and_hangs, "hello")
    worker.wait()
    os.kill(worker._child.process.pid, signal.SIGSTOP)
    worker.close()
    assert worker._child.process.poll() is not None


def test_one_that_hangs_is_told_without_waiting_for_it(start):
    worker = start(says_and_hangs, "hello")
    worker.wait()
    os.kill(worker._child.process.pid, signal.SIGSTOP)
    for _ in range(10):
        worker.tell(bytes(1_000_000))  # a pipe holds a fraction of it
    worker.close()
    assert worker._child.process.poll() is not None


def test_a_worker_gives_way_as_far_as_it_is_told(start):
    assert until(start(tells_its_niceness, nice=3), "finished") == [os.nice(0) + 3]


def test_ctrl_c_is_the_parents_and_prints_do_not_reach_the_pipe(start):
    assert until(start(tells_what_ctrl_c_does), "finished") == [True]


def test_the_child_ends_when_its_parent_is_killed(tmp_path):
    code = (
        "import os, signal\n"
        "from sfms_robot.sources.worker import SourceWorker; from test_worker import says_and_hangs\n"
        "worker = SourceWorker('test', says_and_hangs, 1); worker.wait()\n"
        "print(worker._child.process.pid, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=env)
    child = int(told.stdout)
    assert ends(child)


@pytest.fixture(autouse=True)
def _warnings_are_seen(caplog):
    caplog.set_level(logging.WARNING)
