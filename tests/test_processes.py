"""Child processes: what arrives, what is dropped, how they end, when they are started again; pools; priority."""

import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sfms_robot
from sfms_robot import processes
from sfms_robot.emulator.launch import PROMPT_DEADLINE_S, READ_DEADLINE_S, EmulatedServo, launch

CLOSE_S = 0.2
LARGE = 1_000_000  # bytes: more than any pipe takes
LOOSE = {name: "7" for name in processes.ONE_THREAD}  # BLAS and OpenMP read them when they are loaded


def writer_and_reader(kept=1):
    reading, writing = os.pipe()
    return processes.PipeWriter(os.fdopen(writing, "wb"), kept, "test"), os.fdopen(reading, "rb")


def test_sent_messages_come_whole_and_in_order_before_those_that_were_offered():
    writer, pipe = writer_and_reader()
    with pipe:
        writer.send(b"a" * LARGE)
        assert writer.offer(b"b" * 10) == 0
        writer.send(b"c" * 10)
        writer.close()
        assert pipe.read() == b"a" * LARGE + b"c" * 10 + b"b" * 10


@pytest.mark.parametrize("kept", [1, 3])
def test_of_offered_messages_that_a_full_pipe_cannot_take_the_newest_are_written(kept):
    writer, pipe = writer_and_reader(kept)
    with pipe:
        offered = [bytes([65 + index]) * 40_000 for index in range(20)]
        dropped = sum(map(writer.offer, offered))
        writer.close()
        came = pipe.read()
    shown = [came[at : at + 40_000] for at in range(0, len(came), 40_000)]
    assert shown[0] == offered[0] and shown[-kept:] == offered[-kept:] and len(shown) == len(offered) - dropped
    assert dropped and shown == [each for each in offered if each in shown]


def test_messages_of_several_threads_are_never_mixed():
    writer, pipe = writer_and_reader()
    sends = [lambda byte=byte: [writer.send(byte * 3000) for _ in range(50)] for byte in (b"a", b"b", b"c")]
    threads = [threading.Thread(target=each) for each in sends]
    for thread in threads:
        thread.start()
    with pipe:
        came = [pipe.read(3000) for _ in range(150)]
        writer.close()
    assert all(len(set(each)) == 1 for each in came)
    assert all(came.count(byte * 3000) == 50 for byte in (b"a", b"b", b"c"))


def test_a_reader_that_has_ended_costs_nothing():
    writer, pipe = writer_and_reader()
    pipe.close()
    for _ in range(3):
        writer.offer(b"picture")
        writer.send(b"message")
    writer.close()


def threads(task=0):
    """Return the thread settings of this process, and the threads that torch uses."""
    import torch

    return {name: os.environ.get(name) for name in processes.ONE_THREAD}, torch.get_num_threads()


def tells_of_itself():
    parent = processes.ParentPipe()
    os.write(1, b"a library prints")
    processes.give_way(3)
    parent.send((threads(), signal.getsignal(signal.SIGINT) is signal.SIG_IGN, os.nice(0)))


def echoes():
    parent = processes.ParentPipe()
    while True:
        parent.send(parent.receive())


def waits():
    parent = processes.ParentPipe()
    parent.forward(lambda _: None)
    parent.send("ready")
    threading.Event().wait()


def counts():
    parent = processes.ParentPipe()
    for number in range(50):
        parent.send(None)
        parent.send(number)


@pytest.fixture
def start(monkeypatch):
    """Start a child by the name of its function in this file; all of them are closed afterwards."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    children = []

    def started(function, *first, **how):
        children.append(processes.Child(f"{__name__}:{function.__name__}", *first, name="test", **how))
        return children[-1]

    yield started
    for child in children:
        child.close(CLOSE_S)
        assert child.process.poll() is not None


def test_a_child_computes_with_one_thread_ignores_ctrl_c_and_its_prints_stay_out_of_the_pipe(start, monkeypatch):
    for name, value in LOOSE.items():
        monkeypatch.setenv(name, value)
    child = start(tells_of_itself, quiet=True)
    assert child.receive(60.0) == ((processes.ONE_THREAD, 1), True, os.nice(0) + 3)
    assert child.receive(60.0) == processes.Ended(0)


def test_messages_are_answered_and_the_last_one_is_the_exit_code(start):
    child = start(echoes, "first")
    child.send({"second": 2})
    assert [child.receive(60.0) for _ in range(2)] == ["first", {"second": 2}]
    assert child.gave_sign() and not child.gave_sign() and child.receive() is None
    child.process.kill()
    assert child.receive(60.0) == processes.Ended(-signal.SIGKILL)


def test_messages_that_are_not_fetched_are_dropped_oldest_first_and_signs_of_life_are_no_messages(start):
    came = []
    start(counts, take=came.append).reader.join()
    assert came == [*range(50), processes.Ended(0)]
    child = start(counts, most=10)
    child.reader.join()
    assert [child.receive() for _ in range(10)] == [*range(41, 50), processes.Ended(0)]
    assert child.dropped == 50 + 1 - 10 and child.receive() is None


@pytest.mark.parametrize("end", [lambda child: child.close(CLOSE_S), processes.Child.kill])
def test_a_child_that_is_stopped_holds_nothing_up_and_leaves_no_file_open(start, end):
    child = start(waits)
    assert child.receive(60.0) == "ready"
    os.kill(child.process.pid, signal.SIGSTOP)
    for _ in range(5):
        child.offer(bytes(LARGE))
    end(child)
    child.reader.join()
    assert child.process.stdout.closed and child.process.returncode == -signal.SIGKILL
    while not child.process.stdin.closed:  # by the thread that waits for room
        pass


def ends(pid):
    """Return whether a process that is not our child ends: it is gone, or a zombie."""
    for _ in range(10_000_000):
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except FileNotFoundError:
            return True
    return False


def test_a_child_ends_when_its_parent_is_killed():
    code = (
        f"import os, signal; from sfms_robot.processes import Child; child = Child('{__name__}:waits', name='test')\n"
        "child.receive(60); print(child.process.pid, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])}
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=env)
    assert ends(int(told.stdout))


@pytest.mark.parametrize(
    "module", ["sfms_robot.listeners.process", "sfms_robot.sources.worker", "sfms_robot.app.serve.batch_process",
               "sfms_robot.viewer.page_child", "sfms_robot.emulator.chain_process"],
)  # fmt: skip
def test_a_child_whose_parent_ends_before_its_first_message_ends_without_a_word(module):
    command = [sys.executable, "-c", f"from {module} import main; main()"]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


class Fake:
    """A child that only knows whether it was killed."""

    killed = False

    def kill(self):
        self.killed = True


class Watched:
    """A supervised fake child, and a clock."""

    def __init__(self, limits, phase="starting"):
        self.children, self.now_s, self.refusals = [], 0.0, 0
        self.supervised = processes.Supervised("test", limits, self._start)
        if phase != "starting":
            self.supervised.enter(phase)
        self.supervised.check(0.0, True)

    def _start(self):
        if self.refusals:
            self.refusals -= 1
            raise OSError("no more processes")
        self.children.append(Fake())
        return self.children[-1]

    def until(self, happened, alive=False, step_s=0.125, limit_s=200.0):
        """Return the time until `happened`, None if it does not within `limit_s`."""
        began_s = self.now_s
        while not happened(self.supervised):
            if self.now_s - began_s > limit_s:
                return None
            self.now_s += step_s
            self.supervised.check(self.now_s, alive)
        return self.now_s - began_s


PHASES = [(name, phase) for name, limits in processes.LIMITS.items() for phase in limits.silent_s]


@pytest.mark.parametrize(("name", "phase"), PHASES)
def test_a_child_without_a_sign_of_life_is_killed_and_started_again_after_the_limit_of_its_phase(name, phase):
    limits = processes.LIMITS[name]
    watched = Watched(limits, phase)
    restarted_s = watched.until(lambda child: child.restarts)
    assert restarted_s == pytest.approx(limits.silent_s[phase] + limits.pause_s, abs=0.25)
    assert [child.killed for child in watched.children] == [True, False]
    assert watched.supervised.phase == "starting" and watched.supervised.away
    watched.supervised.enter("running")
    assert not watched.supervised.away


@pytest.mark.parametrize(("name", "phase"), [("listener", "starting"), ("listener", "loading"), ("page", "running")])
def test_a_child_that_hangs_is_named_once_and_once_when_it_answers_again(name, phase, caplog):
    caplog.set_level(logging.INFO)
    watched = Watched(processes.LIMITS[name], phase)
    hung_s = watched.until(lambda child: child.hung)
    assert hung_s == pytest.approx(processes.LIMITS[name].hung_s, abs=0.126) and watched.supervised.away
    watched.supervised.check(watched.now_s + 0.125, False)
    watched.supervised.check(watched.now_s + 0.25, True)
    assert not watched.supervised.hung and watched.supervised.hangs == 1
    assert [each.getMessage() for each in caplog.records] == [
        f"test ({phase}): no sign of life for {hung_s:.1f} s; the run continues",
        "test: answers again",
    ]


def test_a_child_that_works_for_ever_and_gets_nowhere_is_started_again():
    limits = processes.LIMITS["listener"]
    assert Watched(limits, "loading").until(lambda child: child.restarts, alive=True) == pytest.approx(60.0, abs=0.25)
    assert Watched(limits, "running").until(lambda child: child.restarts, alive=True) is None
    waiting = Watched(limits, "loading")
    for _ in range(1000):  # for its parent
        waiting.supervised.phase_s = 0.0
        waiting.supervised.check(waiting.now_s + 0.125, True)
        waiting.now_s += 0.125
    assert waiting.supervised.restarts == 0


def test_pauses_double_and_begin_again_after_steady_running_and_failures_in_a_row_are_logged_once(caplog):
    caplog.set_level(logging.INFO)
    limits = processes.LIMITS["source"]
    watched, paused_s = Watched(limits), []
    for _ in range(2000):  # days without a camera
        watched.supervised.fail("gone")
        paused_s.append(watched.until(lambda child: child.phase == "starting"))
    assert paused_s[:6] == [0.5, 1.0, 2.0, 4.0, 8.0, 8.0] and set(paused_s[6:]) == {limits.longest_pause_s}
    watched.supervised.enter("running")
    assert [each.getMessage() for each in caplog.records] == ["test: gone; restarting", "test: running again"]
    assert watched.until(lambda child: child.phase_s > limits.steady_s + 0.2, alive=True)
    watched.supervised.fail("gone")
    assert watched.until(lambda child: child.phase == "starting") == limits.pause_s


def test_a_process_that_cannot_be_started_counts_as_another_failure():
    watched = Watched(processes.LIMITS["source"])
    watched.refusals = 2
    watched.supervised.fail("gone")
    assert watched.until(lambda child: child.phase == "starting") == 0.5 + 1.0 + 2.0 and len(watched.children) == 2


@given(st.lists(st.integers(0, 30), max_size=60))
def test_at_most_five_restarts_happen_in_a_minute_and_the_next_failure_is_the_last(gaps_s):
    watched, failed_s = Watched(processes.LIMITS["listener"]), []
    for gap_s in gaps_s:
        watched.now_s += gap_s
        watched.supervised.phase_s = 0.0
        watched.supervised.check(watched.now_s, True, "died")
        too_many = len(failed_s) >= 5 and watched.now_s - failed_s[-5] < 60.0
        assert (watched.supervised.phase == "given up") == too_many
        if too_many:
            break
        failed_s.append(watched.now_s)
    assert watched.supervised.restarts == len(failed_s) == len(watched.children) - 1


def test_a_page_is_not_started_again_and_a_break_of_the_run_itself_is_no_silence(caplog):
    watched = Watched(processes.LIMITS["page"], "running")
    watched.supervised.check(3600.0, False)
    watched.supervised.check(0.0, False)  # another run begins
    assert not watched.supervised.hung and not caplog.records
    watched.supervised.fail("its process died")
    assert watched.until(lambda child: child.restarts) is None and watched.supervised.phase == "given up"
    assert [each.getMessage() for each in caplog.records] == ["test: its process died; the run continues without it"]


def test_a_process_of_a_pool_computes_with_one_thread(monkeypatch):
    for name, value in LOOSE.items():
        monkeypatch.setenv(name, value)
    with processes.process_pool(1) as pool:
        assert pool.submit(threads).result() == (processes.ONE_THREAD, 1)
    assert {name: os.environ[name] for name in LOOSE} == LOOSE
    monkeypatch.undo()
    assert threads() == (processes.ONE_THREAD, 1)  # nor do workers of pytest use more (conftest.py)


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="no real-time priority here")
def test_priority_is_granted_or_says_why_not_and_is_not_inherited():
    code = "import os; print(os.sched_getscheduler(0))"
    with processes.realtime_priority() as outcome:
        assert outcome == "fifo" or outcome.startswith("refused: ")
        told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(told.stdout) == os.SCHED_OTHER
    with processes.realtime_priority(wanted=False) as outcome:
        assert outcome == "not asked for"


@pytest.mark.parametrize("virtual", [False, True])
def test_an_emulated_chain_is_as_prompt_as_hardware_where_the_system_lets_it(virtual):
    """In virtual time it needs no priority; one that was refused is waited for longer."""
    with launch([EmulatedServo(1)], virtual=virtual) as chain, processes.realtime_priority(wanted=not virtual) as here:
        assert chain.priority == here
        assert chain.read_deadline_s == (PROMPT_DEADLINE_S if here == "fifo" else READ_DEADLINE_S)
        if here == "fifo":
            assert os.sched_getscheduler(chain.pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO


def test_every_pool_and_every_pickling_child_of_the_package_is_made_in_one_place():
    package = Path(sfms_robot.__file__).parent
    making = ("ProcessPoolExecutor(", "multiprocessing.Pool", "get_context(", "start_new_session=")
    users = [file.name for file in package.rglob("*.py") if any(word in file.read_text("utf-8") for word in making)]
    assert [*dict.fromkeys(users)] == ["processes.py"]
