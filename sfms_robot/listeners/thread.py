"""A listener object in a thread of this process (ports.PlanFeed), and parts shared with one in a child process.

The thread is for a listener that cannot be loaded by name. It shares the interpreter with the servo loop: a step that
computes for long without releasing Python's lock makes ticks late. Listeners loaded by name run in `process` instead.
"""

from __future__ import annotations

import logging
import queue
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from sfms_robot.config.listener import Calmness
from sfms_robot.frames import FRAME_HZ, Plan, SpeakerFrame
from sfms_robot.ports import Facts, Listener
from sfms_robot.processes import LIMITS, start_thread
from sfms_robot.signals.quantiles import Quantiles

CLOSE_LIMIT_S: Final = 0.2
HUNG_S: Final = LIMITS["listener"].hung_s
LATE_S: Final = 1.0
USUAL_S: Final = 0.1  # usual delay of a microphone's sound after the end of a frame
MOST_WAITING: Final = FRAME_HZ // 2  # frames
CATCH_UP: Final = 0.5  # least decrease of waiting frames per step while catching up: twice the person's pace

Say = Callable[[tuple[str, Any]], object]

log = logging.getLogger(__name__)


class Inbox:
    """A queue of frames in order of arrival; None ends it.

    A machine that cannot keep up must not answer words from seconds ago: when more than `MOST_WAITING` frames wait,
    the listener continues with the newest, and the others are counted. Frames that came before the first call of `next`
    do not count as too many, as long as their number falls at the pace of `CATCH_UP`.

    Attributes:
        skipped: number of frames left out before the last one returned.
        calmness: rates requested since the last frame; None if there are none.
        hop: requested hop; None: the listener's own.
    """

    def __init__(self) -> None:
        self._queue = queue.SimpleQueue[SpeakerFrame | None]()
        self._allowed: float | None = None  # frames that may wait while it catches up with earlier ones
        self._waiting = deque[SpeakerFrame | None]()
        self.skipped = 0
        self.calmness: Calmness | None = None
        self.hop: int | None = None

    def put(self, frame: SpeakerFrame | None) -> None:
        """Add a frame, or None for the end. Never blocks."""
        self._queue.put(frame)

    def next(self) -> SpeakerFrame | None:
        """Return the next frame; blocks until there is one. None, the end, is returned before all waiting frames."""
        while not self._waiting or not self._queue.empty():
            self._waiting.append(self._queue.get())
        if None in self._waiting:
            return None
        waiting = len(self._waiting)
        self._allowed = waiting + MOST_WAITING if self._allowed is None else self._allowed - CATCH_UP
        self.skipped = waiting - 1 if waiting > max(MOST_WAITING, self._allowed) else 0
        for _ in range(self.skipped):
            self._waiting.popleft()
        return self._waiting.popleft()


def calmed(listener: Listener, memory: Any, calmness: Calmness | None) -> Any:
    """Return the memory with the rates that were requested since the last frame, if the listener has rates."""
    change = getattr(listener, "calmed", None)
    return memory if calmness is None or change is None else change(memory, calmness)


class Stepped(NamedTuple):
    """The answer to a frame: a plan if one is due, the duration of the step, and the number of frames left out."""

    plan: Plan | None
    taken_ms: float
    left_out: int


def listen(listener: Listener, seed: int, inbox: Inbox, say: Say) -> None:
    """Step once per frame until None comes; pass "ready" and each `Stepped` to `say`."""
    from sfms_robot.listeners.registry import at_hop

    memory = listener.start(seed)
    say(("ready", None))
    while (frame := inbox.next()) is not None:
        calmness, inbox.calmness = inbox.calmness, None
        memory = calmed(listener, memory, calmness)
        if inbox.hop is not None:
            listener = at_hop(listener, inbox.hop)
        began_s = time.perf_counter()
        plan, memory = listener.step(frame, memory)
        say(("step", Stepped(plan, (time.perf_counter() - began_s) * 1e3, inbox.skipped)))


class Lateness:
    """A check whether plans come in time to be shown. A listener on a slow computer answers, but always too late.

    If a plan would be in time with a frame that came as soon as a microphone's, its source is late, not the listener.

    Attributes:
        lasting: for `LATE_S` every plan has come after the time of its last frame. The next plan in time ends it.
    """

    def __init__(self) -> None:
        self.lasting = False
        self._since_s: float | None = None  # time of the first late plan in a row
        self._given = deque[tuple[float, float]](maxlen=2 * FRAME_HZ)  # time of a frame, and its delay
        self._source_said = False

    def named(self, state: str) -> str:
        """Return "late" for a listening state whose plans are never in time, else `state`."""
        return "late" if self.lasting and state == "listening" else state

    def gave(self, frame: SpeakerFrame, now_s: float) -> None:
        """Record the time at which the listener received a frame."""
        self._given.append((frame.time_s, now_s - frame.time_s))

    def came(self, plan: Plan, now_s: float) -> None:
        """Check a plan that arrived at `now_s`, a time of the same clock as its frames."""
        given_s = next((late_s for time_s, late_s in reversed(self._given) if time_s <= plan.made_at_s + 1e-6), 0.0)
        by_source_s = max(0.0, given_s - USUAL_S)
        if now_s <= plan.times_s[-1] + by_source_s:
            if now_s > plan.times_s[-1] and not self._source_said:
                text = "plans come too late: sound reaches the listener %.0f ms late, by its source (said once)"
                log.warning(text, given_s * 1e3)
                self._source_said = True
            if self.lasting:
                log.info("the listener's plans are in time again")
            self.lasting, self._since_s = False, None
            return
        self._since_s = now_s if self._since_s is None else self._since_s
        if not self.lasting and now_s - self._since_s >= LATE_S:
            log.warning("the listener's plans come too late to be shown: the run continues without them")
            self.lasting = True


class ListenerThread:
    """A listener in a thread, used as a `ListenerProcess`; an exception ends the listening, not the run."""

    def __init__(self, listener: Listener, seed: int) -> None:
        self._listener, self._seed = listener, seed
        self._inbox = Inbox()
        self._said = queue.SimpleQueue[tuple[str, Any]]()
        self._step_ms = Quantiles()
        self._lateness = Lateness()
        self._unanswered = self._skipped = 0  # frames
        self._since_s = 0.0  # last time at which no frame was waiting or an answer came
        self._state = "listening"
        self._thread = start_thread(self._work, "listener")

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        """Hand over a frame. Never blocks; while the listener hangs, frames are dropped and counted."""
        if self._state not in ("listening", "hung") or self._unanswered > 2 * MOST_WAITING:
            self._skipped += 1
            return
        if not self._unanswered:
            self._since_s = now_s
        self._unanswered += 1
        self._lateness.gave(frame, now_s)
        self._inbox.put(frame)

    def calm(self, calmness: Calmness) -> None:
        """Use other rates from the next frame on, as `ListenerProcess` does."""
        self._inbox.calmness = calmness

    def poll(self, now_s: float) -> Sequence[Plan]:
        """Return plans that have arrived. Never blocks."""
        plans = []
        while not self._said.empty():
            kind, value = self._said.get_nowait()
            self._since_s = now_s
            if kind == "error":
                self._state = value
            elif kind == "step":
                plan, taken_ms, left_out = value
                self._skipped += left_out
                self._unanswered -= 1 + left_out
                if plan is not None:
                    self._step_ms.add(taken_ms)
                    self._lateness.came(plan, now_s)
                    plans.append(plan)
        if not self._unanswered:
            self._since_s = now_s
        silent_s = now_s - self._since_s
        hung = silent_s > HUNG_S
        if hung and self._state == "listening":
            log.warning("the listener has not answered for %.1f s; the run continues", silent_s)
            self._state = "hung"
        elif not hung and self._state == "hung":
            log.info("the listener answers again")
            self._state = "listening"
        return plans

    @property
    def lost(self) -> bool:
        """Return whether the listener hangs, has failed, or is always too late."""
        return self._state != "listening" or self._lateness.lasting

    def statistics(self) -> Facts:
        """Return `state` (listening, late, hung, "failed: " and reason), `restarts` 0, `skipped_frames`, `step_ms`."""
        return {
            "state": self._lateness.named(self._state),
            "restarts": 0,
            "skipped_frames": self._skipped,
            "step_ms": self._step_ms.report(p50=50, p99=99),
        }

    def close(self) -> None:
        """End after the current step; blocks for `CLOSE_LIMIT_S` at most and abandons a step that hangs."""
        self._inbox.put(None)
        self._thread.join(CLOSE_LIMIT_S)

    def _work(self) -> None:
        try:
            listen(self._listener, self._seed, self._inbox, self._said.put)
        except Exception as error:
            self._said.put(("error", f"failed: {type(error).__name__}: {error}"))
            log.exception("the listener failed; the run continues without it")
