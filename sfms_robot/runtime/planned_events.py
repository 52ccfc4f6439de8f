"""Events that a listener is about to show: events that it decided, or nods, blinks and smiles found in its plans.

A listener with events puts each event into a plan before it begins, with its evidence (`frames.Plan.events`). For other
listeners the planned frames are joined to one motion at 25 Hz, in which newer frames replace older ones. The detectors
of `signals.events` search its last seconds. A nod or a blink is reported when a plan contains it completely, a smile
when it has lasted 0.4 s. Each is reported once.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from sfms_robot.errors import InputError
from sfms_robot.frames import EVENT_KINDS, FRAME_HZ, Doubles, ListenerEvent, Plan
from sfms_robot.ports import Observer, Tick
from sfms_robot.processes import start_thread
from sfms_robot.signals.events import MOTION_EVENTS

log = logging.getLogger(__name__)

WINDOW: Final = 8 * FRAME_HZ  # frames that are searched; no nod is longer
NEWS: Final = 2 * FRAME_HZ  # an event that ended more frames ago is not new, but an artefact of the window's edge
MOST_WAITING: Final = 10 * FRAME_HZ  # plans that wait for callbacks, at most

TakeEvent = Callable[[ListenerEvent], object]


class PlannedEvents:
    """Detector of events in plans, with a memory of `WINDOW` frames."""

    def __init__(self) -> None:
        self._signals = np.zeros((len(MOTION_EVENTS), 0))
        self._first = 0  # index, in frames of 40 ms, of the first column
        self._reported_s: dict[str, float] = {}
        self._decided: list[ListenerEvent] | None = None  # None: a listener without events

    def add(self, plan: Plan) -> list[ListenerEvent]:
        """Return the events that this plan completes, in the order of their beginnings."""
        self.join(plan)
        return self.news()

    def news(self) -> list[ListenerEvent]:
        """Return new events of the plans so far; call at least every `NEWS` frames."""
        if self._decided is not None:
            decided, self._decided = self._decided, []
            return decided
        found = [event for row, kind in enumerate(MOTION_EVENTS) for event in self._new(kind, self._signals[row])]
        return sorted(found, key=lambda event: event.start_s)

    def join(self, plan: Plan) -> None:
        """Add a plan without searching it."""
        if plan.hazards_hz or plan.events:
            self._decided = [*(self._decided or ()), *plan.events]
            return
        columns = np.array([kind.signal(plan.frames) for kind in MOTION_EVENTS.values()], np.float64)
        begins = round(float(plan.times_s[0]) * FRAME_HZ)
        known = self._signals.shape[1]
        if not known or not 0 <= begins - self._first <= known + WINDOW:  # the first plan, or a jump in time
            self._signals, self._first, known = columns[:, :0], begins, 0
            self._reported_s = dict.fromkeys(MOTION_EVENTS, float("-inf"))
        at = begins - self._first
        if at > known:  # a gap without plans: the face is held
            self._signals = np.pad(self._signals, ((0, 0), (0, at - known)), mode="edge")
        joined = np.concatenate([self._signals[:, :at], columns], axis=1)
        self._first += max(0, joined.shape[1] - WINDOW)
        self._signals = joined[:, -WINDOW:]

    def _new(self, name: str, signal: Doubles) -> list[ListenerEvent]:
        kind, begins_s, last_s = MOTION_EVENTS[name], self._first / FRAME_HZ, (len(signal) - 1) / FRAME_HZ
        news = []
        for start, end, size in kind.find(signal, FRAME_HZ):
            if end < last_s - NEWS / FRAME_HZ or (kind.whole and end > last_s - 0.5 / FRAME_HZ):
                continue
            if begins_s + start > self._reported_s[name]:
                news.append(ListenerEvent(name, float(begins_s + start), float(end - start), float(size)))
            self._reported_s[name] = max(self._reported_s[name], begins_s + end)
        return news


class EventWatch(Observer):
    """Observer that calls callbacks with events, in a separate thread: the loop only passes the plans on.

    Callbacks run one after the other. A callback that raises is detached and logged. While a slow one runs, only the
    newest `MOST_WAITING` plans are kept; older ones are left out.

    Args:
        callback: called with events of every kind; None: only the callbacks of `on` are called.

    Attributes:
        detached: callbacks that raised, and their errors.
    """

    def __init__(self, callback: TakeEvent | None = None) -> None:
        self._callbacks: list[tuple[str, TakeEvent]] = []
        self._plans = deque[Plan](maxlen=MOST_WAITING)
        self._changed = threading.Condition()
        self._closing = False
        self._origin_s: float | None = None
        self._thread: threading.Thread | None = None
        self.detached: dict[str, str] = {}
        if callback is not None:
            for kind in EVENT_KINDS:
                self.on(kind, callback)

    def on(self, kind: str, callback: TakeEvent) -> None:
        """Call `callback` with every event of one of `EVENT_KINDS`. Raises InputError for an unknown kind."""
        if kind not in EVENT_KINDS:
            raise InputError(f"on({kind!r}): no such event ({', '.join(EVENT_KINDS)})")
        with self._changed:
            self._callbacks.append((kind, callback))
            if self._thread is None and not self._closing:
                self._thread = start_thread(self._work, "events")

    def tick(self, seen: Tick) -> None:
        if seen.origin_s is not None:
            self._origin_s = seen.origin_s

    def planned(self, plan: Plan) -> None:
        with self._changed:
            if self._thread is not None:
                self._plans.append(plan)
                self._changed.notify()

    def close(self) -> None:
        """End after the events of the plans so far. Does not wait for them, because a callback may call this."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    def join(self, limit_s: float) -> None:
        """Wait until all events have been reported, after `close`."""
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(limit_s)

    def _work(self) -> None:
        events = PlannedEvents()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._plans or self._closing)
                if not self._plans:
                    return
                plan = self._plans.popleft()
            for event in events.add(plan):
                self._call(replace(event, origin_s=self._origin_s))

    def _call(self, event: ListenerEvent) -> None:
        for entry in tuple(self._callbacks):
            kind, callback = entry
            if kind != event.kind:
                continue
            try:
                callback(event)
            except Exception as error:
                self._callbacks.remove(entry)
                name = getattr(callback, "__qualname__", repr(callback))
                self.detached[name] = f"{type(error).__name__}: {error}"
                log.warning("on(%r) %s raised and is detached: %s", kind, name, self.detached[name], exc_info=True)
