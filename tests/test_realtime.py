"""Real-time priority: what became of it, and who does not inherit it."""

import os
import subprocess
import sys

import pytest

from sfms_robot.emulator.launch import PROMPT_DEADLINE_S, READ_DEADLINE_S, EmulatedServo, launch
from sfms_robot.realtime import realtime_priority


def test_priority_says_what_became_of_it() -> None:
    with realtime_priority() as outcome:
        assert outcome == "fifo" or outcome.startswith("refused: ")
    with realtime_priority(wanted=False) as outcome:
        assert outcome == "not asked for"


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="no real-time priority here")
def test_what_is_started_meanwhile_does_not_inherit_the_priority() -> None:
    code = "import os; print(os.sched_getscheduler(0))"
    with realtime_priority():
        told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(told.stdout) == os.SCHED_OTHER


@pytest.mark.parametrize("virtual", [False, True])
def test_an_emulated_chain_is_as_prompt_as_hardware_where_the_system_lets_it(virtual: bool) -> None:
    """Of virtual time it needs none; who was refused is waited for longer."""
    with launch([EmulatedServo(1)], virtual=virtual) as chain, realtime_priority(wanted=not virtual) as here:
        assert chain.priority == here
        assert chain.read_deadline_s == (PROMPT_DEADLINE_S if here == "fifo" else READ_DEADLINE_S)
        if here == "fifo":
            assert os.sched_getscheduler(chain.pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
