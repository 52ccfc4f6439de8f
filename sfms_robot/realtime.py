"""Real-time priority: of the servo loop, and of what answers it as hardware would."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

SWITCH_S: Final = 0.0001  # a tick waits that long for another thread; Python's own 5 ms is half a tick


@contextmanager
def realtime_priority(wanted: bool = True) -> Iterator[str]:
    """SCHED_FIFO while inside, where the system grants it. Yields "fifo", "not asked for", or why it was refused.

    Inside, other threads of this process (a recorder, a progress bar) also hand the interpreter back ten times sooner.
    """
    if not wanted:
        yield "not asked for"
        return
    usual_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        with _fifo() as outcome:
            yield outcome
    finally:
        sys.setswitchinterval(usual_s)


@contextmanager
def _fifo() -> Iterator[str]:
    try:
        before = (os.sched_getscheduler(0) | os.SCHED_RESET_ON_FORK, os.sched_getparam(0))
        # What is started meanwhile, such as a listener that died, is not to compete with the loop.
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(os.sched_get_priority_min(os.SCHED_FIFO)))
    except (AttributeError, OSError) as error:
        yield f"refused: {error}"
        return
    try:
        yield "fifo"
    finally:
        os.sched_setscheduler(0, *before)
