"""What a run hears and does, for the programs that it works with."""

from __future__ import annotations

from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.ports import Outlet, Tick
from sfms_robot.runtime.planned_events import EventWatch, MotionEvent
from sfms_robot.signals.events import MOTION_EVENTS


class RunTeller:
    """`ports.Observer`: sound as it is heard, nods, blinks and smiles as they are planned, states as they change."""

    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet
        self._state: tuple[str, tuple[str, ...]] | None = None
        self._events = EventWatch()
        for kind in MOTION_EVENTS:
            self._events.on(kind, self._event)

    def tick(self, seen: Tick) -> None:
        state = (seen.state, seen.why)
        if state != self._state:
            self._state = state
            self._outlet.tells("state", seen.time_s, state=seen.state, why=list(seen.why))

    def heard(self, frame: SpeakerFrame) -> None:
        if len(frame.audio):
            self._outlet.hears(frame.audio, frame.time_s)

    def planned(self, plan: Plan) -> None:
        self._events.planned(plan)

    def close(self) -> None:
        self._events.close()

    def _event(self, event: MotionEvent) -> None:
        lasts_s = round(event.end_s - event.start_s, 3)
        self._outlet.tells("event", event.start_s, event=event.kind, lasts_s=lasts_s, size=round(event.size, 4))
