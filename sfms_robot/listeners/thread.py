"""A listener object of somebody's own, stepped in a thread of this process (ports.PlanFeed).

For what cannot be loaded by name in a process of its own. It shares the interpreter with the servo loop: a step that
computes for long without letting go of Python's lock makes ticks late. Listeners by name do not: `process`.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from sfms_robot.config.listener import Calmness
from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.listeners.inbox import MOST_WAITING, Inbox, calmed
from sfms_robot.listeners.process import CLOSE_LIMIT_S, HUNG_S, Lateness
from sfms_robot.ports import Listener
from sfms_robot.signals.quantiles import Quantiles

log = logging.getLogger(__name__)


class ListenerThread:
    """Frames in, plans out, as `ListenerProcess`; what raises ends the listening, not the run."""

    def __init__(self, listener: Listener, seed: int) -> None:
        self._listener, self._seed = listener, seed
        self._inbox = Inbox()
        self._plans: queue.SimpleQueue[Plan] = queue.SimpleQueue()
        self._step_ms = Quantiles()
        self._lateness = Lateness()
        self._pushed = self._taken = 0  # frames; each is counted by one thread alone
        self._dropped = self._skipped = 0
        self._since_s = 0.0  # nothing was waiting, or a frame was taken
        self._seen_taken = 0
        self._state = "listening"
        self._thread = threading.Thread(target=self._work, name="listener", daemon=True)
        self._thread.start()

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        """Never blocks. While the listener hangs, frames are dropped and counted."""
        waiting = self._pushed - self._taken
        if self._state not in ("listening", "hung") or waiting > 2 * MOST_WAITING:
            self._dropped += 1
            return
        if not waiting:
            self._since_s = now_s
        self._pushed += 1
        self._inbox.put(frame)

    def calm(self, calmness: Calmness) -> None:
        """As of `ListenerProcess`."""
        self._inbox.calmness = calmness

    def poll(self, now_s: float) -> Sequence[Plan]:
        """Plans that came. Never blocks."""
        plans = []
        while not self._plans.empty():
            plans.append(self._plans.get_nowait())
            self._lateness.came(plans[-1], now_s)
        taken = self._taken
        if taken == self._pushed or taken != self._seen_taken:
            self._seen_taken, self._since_s = taken, now_s
        silent_s = now_s - self._since_s
        hung = silent_s > HUNG_S
        if hung and self._state == "listening":
            log.warning("the listener has not answered for %.1f s", silent_s)
            self._state = "hung"
        elif not hung and self._state == "hung":
            log.warning("the listener goes on")
            self._state = "listening"
        return plans

    @property
    def lost(self) -> bool:
        """Hung, failed, or always too late."""
        return self._state != "listening" or self._lateness.lasting

    def statistics(self) -> Mapping[str, Any]:
        """`state` (listening, late, hung, or failed and how), `restarts` 0, `skipped_frames`, `step_ms` p50, p99."""
        return {
            "state": self._lateness.named(self._state),
            "restarts": 0,
            "skipped_frames": self._dropped + self._skipped,
            "step_ms": self._step_ms.report(p50=50, p99=99),
        }

    def close(self) -> None:
        """End after the step at hand; blocks for `CLOSE_LIMIT_S` at most, a step that hangs is left behind."""
        self._inbox.put(None)
        self._thread.join(CLOSE_LIMIT_S)

    def _work(self) -> None:
        try:
            memory = self._listener.start(self._seed)
            while (frame := self._inbox.next()) is not None:
                self._skipped += self._inbox.skipped
                memory = calmed(self._listener, memory, self._inbox)
                began_s = time.perf_counter()
                plan, memory = self._listener.step(frame, memory)
                if plan is not None:
                    self._step_ms.add((time.perf_counter() - began_s) * 1e3)
                    self._plans.put(plan)
                self._taken += 1 + self._inbox.skipped
        except Exception as error:
            self._state = f"failed: {type(error).__name__}: {error}"
            log.exception("the listener cannot go on; the head goes on without it")
