"""What a run hears and does, for the programs that it works with."""

from __future__ import annotations

from sfms_robot.frames import EVENT_KINDS, ListenerEvent, Plan, SpeakerFrame
from sfms_robot.ports import Outlet, Tick
from sfms_robot.runtime.planned_events import EventWatch


class RunTeller:
    """`ports.Observer`: sound as it is heard, events as they are decided or planned, states as they change."""

    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet
        self._state: tuple[str, tuple[str, ...]] | None = None
        self._events = EventWatch()
        for kind in EVENT_KINDS:
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

    def _event(self, event: ListenerEvent) -> None:
        told = {"lasts_s": round(event.duration_s, 3), "size": round(event.size, 4), "swings": event.swings}
        if event.probability is not None:
            told["probability"] = round(event.probability, 5)
        self._outlet.tells("event", event.start_s, event=event.kind, **told)
