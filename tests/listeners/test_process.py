"""The listener's own process: what it hears when it cannot keep up, and what its parent does when it hangs or dies."""

import logging
import os
import signal
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from remote_rig import frames
from virtual_time import Time

from sfms_robot.errors import ModelError
from sfms_robot.frames import FRAME_S, Plan
from sfms_robot.listeners.process import REVIEW_S, SETTLED_FRAMES, ListenerProcess, plan_times_s
from sfms_robot.listeners.thread import HUNG_S, Inbox, listen
from sfms_robot.processes import LIMITS

RESTART_S = LIMITS["listener"].silent_s


class Slow:
    """Hears one frame while all others arrive."""

    hop = horizon = 1

    def __init__(self, inbox):
        self.inbox, self.late = inbox, [frames(60), [None]]

    def start(self, seed):
        return 0

    def step(self, speaker, memory):
        for frame in self.late.pop(0):
            self.inbox.put(frame)
        return Plan(speaker.time_s, np.array([speaker.time_s + FRAME_S]), np.zeros((1, 58), np.float32)), memory


def test_a_slow_listener_answers_the_newest_frame_and_tells_how_many_it_left_out():
    inbox, messages = Inbox(), []
    inbox.put(frames(1)[0])
    listen(Slow(inbox), 0, inbox, messages.append)
    (ready, _), (_, first), (_, last) = messages
    assert (ready, first.left_out, last.left_out, round(last.plan.made_at_s / FRAME_S)) == ("ready", 0, 59, 60)


class Planner:
    """Plans on every third frame."""

    horizon, hop = 8, 3

    def start(self, seed):
        return 0

    def step(self, speaker, memory):
        plan = Plan(speaker.time_s, np.array([speaker.time_s + FRAME_S]), np.zeros((1, 58), np.float32))
        return None if memory % self.hop else plan, memory + 1


def test_a_probe_measures_plans_and_ends_even_without_time():
    waits_s = []
    p50_s, p99_s = plan_times_s(Planner(), limit_s=0.0, wait=waits_s.append)
    assert 0 < p50_s == p99_s
    p50_s, p99_s = plan_times_s(Planner(), wait=waits_s.append)
    assert 0 < p50_s <= p99_s
    assert max(waits_s) <= FRAME_S  # at the pace of a run


def take(listener, now_s=0.0):
    """Take the next message; waits for the child itself, however long that takes on this computer."""
    return listener._take(listener._supervised.child.receive(60.0), now_s)


@pytest.fixture
def listener():
    child = ListenerProcess("sfms-small", 3)
    child.wait_loaded()
    while child.statistics()["state"] != "listening":
        take(child)
    yield child
    child.close()


def probed(child):
    """Take the probe, as of a computer on which a plan takes 5 ms."""
    kind, probe = child._supervised.child.receive(60.0)
    child._take((kind, replace(probe, step_p50_s=0.005, step_p99_s=0.006)), 0.0)


def pid_of(listener):
    return listener._supervised.child.process.pid


def answered(listener, now_s):
    """What comes of one hop of frames; waits for the child itself, however long that takes on this computer."""
    for frame in frames(8):
        listener.push(frame, now_s)
    while (plan := take(listener, now_s)) is None:
        pass
    return plan


def test_plans_come_back_and_torch_stays_in_the_child(listener):
    assert answered(listener, 0.0).frames.shape == (8, 58) and listener.statistics()["state"] == "listening"
    code = "import sys, sfms_robot.app.session, sfms_robot.listeners.process; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_hop_is_chosen_when_the_source_has_settled_and_a_new_child_is_told_one_too():
    with closing(ListenerProcess("sfms-small", 3)) as child:
        child.choose_hop_by(lambda: 0.06, 0.047, 0.01)
        child.wait_loaded()
        probed(child)
        for frame in frames(SETTLED_FRAMES):
            assert child.statistics()["hop"] is None
            child.push(frame, 0.0)
        assert child.statistics()["hop"] == 1 and child.statistics()["budget_ms"]["source"] == 60
        plans = []
        while len(plans) < SETTLED_FRAMES:
            plan = take(child)
            plans += [plan] if plan is not None else []
        assert [round(plan.made_at_s / FRAME_S) for plan in plans] == list(range(1, SETTLED_FRAMES + 1))


def test_a_hop_gives_way_when_the_source_turns_out_later_than_it_was_and_never_goes_back():
    late_s = [0.0]
    with closing(ListenerProcess("sfms-small", 3)) as child:
        child.choose_hop_by(lambda: late_s[0], 0.047, 0.01)
        child.wait_loaded()
        probed(child)
        for frame in frames(SETTLED_FRAMES):
            child.push(frame, 0.0)
        assert child.statistics()["hop"] == 3
        while child.statistics()["state"] != "listening":
            take(child)
        for _ in range(SETTLED_FRAMES):
            kind, step = child._supervised.child.receive(60.0)
            child._take((kind, step._replace(taken_ms=5.0)), 0.0)  # whatever a plan takes on this machine
        for now_s, source_s, hop in ((REVIEW_S - 0.1, 0.06, 3), (REVIEW_S, 0.06, 1), (3 * REVIEW_S, 0.0, 1)):
            late_s[0] = source_s
            child._review(now_s)
            assert child.statistics()["hop"] == hop
        for frame in frames(3):
            child.push(frame, 0.0)
        assert all(child._supervised.child.receive(60.0)[1].plan is not None for _ in range(3))


def test_an_unknown_listener_is_told_by_name():
    child = ListenerProcess("nobody", 0)
    with pytest.raises(ModelError, match="nobody"):
        child.wait_loaded()


def test_a_child_that_dies_is_started_anew_and_listens_again(listener):
    answered(listener, 0.0)
    os.kill(pid_of(listener), signal.SIGKILL)
    while listener.statistics()["restarts"] == 0:  # until the reading thread has seen the end of the pipe
        listener.poll(1.0)
    for state in ("building", "building", "listening"):  # loaded, probed, ready
        take(listener, 1.0)
        assert listener.statistics()["state"] == state
    assert answered(listener, 1.0) and listener.statistics()["state"] == "listening"


def until_named(listener, caplog, now_s=0.0, step_s=0.125, frame=True):
    """Virtual time at which a child that has stopped is named; what is still on its way counts as a sign of life."""
    while listener.statistics()["state"] != "hung":
        now_s += step_s
        if frame:
            listener.push(frames(1)[0], now_s)
        listener.poll(now_s)
    assert f"no sign of life for {HUNG_S + step_s:.1f} s" in caplog.text
    return now_s


def until_restarted(listener, now_s, step_s=0.125):
    before = listener.statistics()["restarts"]
    while listener.statistics()["restarts"] == before:
        now_s += step_s
        listener.poll(now_s)
    return now_s


PHASES = {"starting": "", "waiting for its hop": "probed", "listening": "ready"}


@pytest.mark.parametrize("phase", PHASES)
def test_a_child_that_is_stopped_in_any_phase_is_named_within_a_second_and_restarted(phase, caplog):
    with closing(ListenerProcess("sfms-small", 3)) as child:
        if phase == "waiting for its hop":
            child.choose_hop_by(lambda: 0.06, 0.047, 0.01)  # chosen after half a second of frames
        kind = ""
        while kind != PHASES[phase]:
            kind, *_ = message = child._supervised.child.receive(60.0)
            child._take(message, 0.0)
        os.kill(before := pid_of(child), signal.SIGSTOP)
        os.waitid(os.P_PID, before, os.WSTOPPED)
        named_s = until_named(child, caplog, frame=phase == "listening")
        assert child.lost
        limit_s = RESTART_S["starting" if phase == "starting" else "running"]
        assert until_restarted(child, named_s) - named_s == pytest.approx(limit_s - HUNG_S, abs=0.13)
        assert pid_of(child) != before and child.statistics()["state"] == "starting" and child.lost


def test_a_child_that_is_stopped_while_the_run_waits_for_it_is_named_and_restarted(caplog):
    def now_s():
        time.t += 0.25 if child.statistics()["restarts"] == 0 else 0.0
        return time.t

    time = Time()
    with closing(ListenerProcess("sfms-small", 3, clock=now_s)) as child:
        os.kill(pid_of(child), signal.SIGSTOP)
        child.wait_loaded()
        assert child.statistics()["state"] == "building" and child.statistics()["restarts"] == 1
    assert "listener (starting): no sign of life for 1." in caplog.text and "restarting" in caplog.text


STUCK = """
import threading
from pathlib import Path

class Stuck:
    hop = horizon = 1

    def __init__(self, where):
        pass

    def start(self, seed):
        return 0

    def step(self, speaker, memory):
        Path(__file__).with_name("reached").touch()
        threading.Event().wait()
"""


@pytest.fixture
def stuck(tmp_path, monkeypatch):
    """A listener of another package that hangs at its first step; what is there once it does."""
    (tmp_path / "stuck_listener.py").write_text(STUCK)
    info = tmp_path / "stuck_listener-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stuck-listener\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[sfms_robot.listeners]\nstuck = stuck_listener:Stuck\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path / "reached"


def test_a_child_that_waits_for_ever_while_it_measures_is_restarted(stuck, caplog):
    with closing(ListenerProcess("stuck:step", 0)) as child:
        while child.statistics()["state"] == "starting":
            take(child)
        while not stuck.exists():
            pass
        named_s = until_named(child, caplog)
        assert until_restarted(child, named_s) - named_s == pytest.approx(RESTART_S["loading"] - HUNG_S, abs=0.13)
    assert "restarting" in caplog.text


def test_frames_of_a_child_that_hangs_do_not_pile_up_and_it_goes_on_where_it_was(listener, caplog):
    caplog.set_level(logging.INFO)
    answered(listener, 0.0)
    while listener._unanswered:  # the rest of the hop
        take(listener)
    os.kill(pid_of(listener), signal.SIGSTOP)
    os.waitid(os.P_PID, pid_of(listener), os.WSTOPPED)
    for frame in frames(2000):
        listener.push(frame, 10.0)
    listener.poll(10.0)
    assert listener._skipped >= 1900
    listener.poll(10.0 + HUNG_S + 0.1)
    assert listener.statistics()["state"] == "hung" and listener.lost
    os.kill(pid_of(listener), signal.SIGCONT)
    while listener.statistics()["state"] == "hung":
        listener.poll(10.0 + HUNG_S + 0.1)
    assert not listener.lost and listener.statistics()["restarts"] == 0 and "answers again" in caplog.text
