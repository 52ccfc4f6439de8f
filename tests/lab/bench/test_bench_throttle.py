"""What `bench throttle` holds against a run: states that are not those of the table, and a tree that is held."""

import os
import subprocess
import sys

import pytest

from sfms_robot.lab.bench.throttle_bench import OUT, held, processes_of, state_problems

WELL = [(0.0, "starting", ()), (1.0, "listening", ()), (10.0, "stopping", ()), (11.0, "stopped", ())]
PLANS = [(0.2 * count, 0.2 * count + 0.3) for count in range(1, 50)]
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="holding processes takes Linux")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([WELL[0], (1.0, "speaking", ()), (2.0, "starting", ()), *WELL[2:]], "speaking to starting at 2.00 s is not"),
        ([WELL[0], (1.0, "degraded", ()), *WELL[2:]], "degraded at 1.00 s has the reason none"),
        ([WELL[0], (1.0, "listening", ("voice",)), *WELL[2:]], "listening at 1.00 s has the reason ('voice',)"),
        ([*WELL[:3], (11.0, "fault", ("the bus",))], "it ends fault"),
        ([WELL[0], (5.0, "listening", ()), *WELL[2:]], "starting for 5.0 s"),
    ],
)
def test_a_state_that_the_table_has_not_is_told(changes, said):
    (problem,) = state_problems(changes, PLANS)
    assert said in problem


@pytest.mark.parametrize("late", [False, True], ids=["no plans", "plans too late"])
def test_a_listener_that_is_not_there_has_to_be_named(late):
    plans = [each for each in PLANS if each[0] < 4.0]
    plans += [(came_s, came_s - 0.1) for came_s, _ in PLANS if came_s >= 4.0] if late else []
    (problem,) = state_problems(WELL, plans)
    assert "no plan in time from 3.80 to 10.00 s" in problem
    named = [*WELL[:2], (5.5, "degraded", ("listener",)), *WELL[2:]]
    assert state_problems(named, plans) == []


@linux
def test_a_process_and_all_that_it_starts_are_found():
    inner = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'print(1, flush=True); input()'])"
    with subprocess.Popen([sys.executable, "-c", inner], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as outer:
        outer.stdout.readline()
        assert len(processes_of(outer.pid)) == 2 and processes_of(outer.pid)[0] == outer.pid
        outer.stdin.close()
    assert processes_of(outer.pid) == [outer.pid]


@linux
def test_what_is_held_to_a_share_of_a_core_comes_to_its_end_all_the_same(tmp_path):
    with held(["-c", "print(sum(range(10_000)))"], 0.5, tmp_path, os.environ) as process:
        assert process.wait() == 0 and (tmp_path / OUT).read_bytes() == b"49995000\n"
