"""A run as its page shows it: 25 pictures a second, events as they are decided, once a second how it is.

The loop packs a picture's numbers and hands them over, 25 times a second; they are turned into text in the page's
process. What takes a millisecond, once a second, is done by a thread.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, TypeVar

import numpy as np

from sfms_robot.frames import FRAME_HZ, Floats, ListenerEvent, Plan, Reading, SpeakerFrame
from sfms_robot.ports import Observer, Tick
from sfms_robot.runtime.loop import AWAY_S
from sfms_robot.runtime.planned_events import PlannedEvents
from sfms_robot.signals import voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.viewer.frame_record import NOTHING, Picture, pack_picture, rare_json
from sfms_robot.viewer.page_process import PageProcess

TOLD_S: Final = 1.0  # between two documents, and two looks for events in the plans of a listener that decides none
_WAITING: Final = 50  # plans that nobody has looked at
_EPS_FRAMES: Final = 1e-6

T = TypeVar("T")


class PageObserver(Observer):
    """`ports.Observer`. The page is closed by the code that opened it.

    Args:
        joints: names, in the order of `Tick.goals_rad`.

    Attributes:
        document: how the run is, for who looks: see `runtime.observers`; None: not known yet.
    """

    def __init__(self, page: PageProcess, joints: Sequence[str]) -> None:
        self.document: Callable[[], Mapping[str, Any]] | None = None
        self._page, self._joints = page, tuple(joints)
        self._index = -1
        self._frame: SpeakerFrame | None = None
        self._voice_db = self._own_db = NOTHING
        self._ear = voice_activity.start()
        self._hazards_hz: Mapping[str, float] = {}
        self._told_s = -math.inf
        self._rare: tuple[Any, bytes] = (None, b"")
        self._plans: deque[Plan] = deque(maxlen=_WAITING)
        self._events = PlannedEvents()  # of the thread that sends

    def tick(self, seen: Tick) -> None:
        index = math.floor(seen.time_s * FRAME_HZ + _EPS_FRAMES)
        if index == self._index:
            return
        self._index = index
        self._page.watch(seen.time_s)
        self._page.show(self._packed(seen))
        if seen.time_s - self._told_s >= TOLD_S:
            self._told_s = seen.time_s
            self._page.later(self._tell)

    def heard(self, frame: SpeakerFrame) -> None:
        self._frame = frame
        self._voice_db = energy_db(frame.audio) if len(frame.audio) else NOTHING
        if len(frame.audio):
            self._ear = voice_activity.step(self._voice_db, self._ear)
        self._own_db = NOTHING if frame.agent_audio is None else energy_db(frame.agent_audio)

    def planned(self, plan: Plan) -> None:
        self._plans.append(plan)
        self._hazards_hz = plan.hazards_hz
        if plan.events:
            self._page.later(self._tell_events)

    def _packed(self, seen: Tick) -> bytes:
        frame = self._frame
        place_m = None if frame is None else frame.place_m
        attention = None if frame is None else frame.attention
        return pack_picture(
            Picture(
                seen.time_s, seen.motion, seen.goals_rad, self._read_rad(seen), self._rare_json(seen),
                self._voice_db, self._own_db, NOTHING if attention is None else attention,
                (NOTHING, NOTHING, NOTHING) if place_m is None else place_m, self._ear.active,
            )
        )  # fmt: skip

    def _tell(self) -> None:
        """Once a second; some milliseconds."""
        self._tell_events()
        if self.document is not None and self._page.visitors:
            self._page.say("status", status=self.document())

    def _tell_events(self) -> None:
        for plan in _drained(self._plans):
            self._events.join(plan)
        for event in self._events.news():
            self._page.say("event", **_event(event))

    def _read_rad(self, seen: Tick) -> Floats:
        """(J,) NaN where nothing was read of late: legs of a platform read at other times fit no pose of today's."""
        read = (_position_rad(seen.readings.get(joint)) for joint in self._joints)
        return np.fromiter(read, np.float32, len(self._joints))

    def _rare_json(self, seen: Tick) -> bytes:
        faults = {joint: reading.fault for joint, reading in seen.readings.items() if reading.fault}
        key = (seen.state, seen.why, faults, self._hazards_hz)
        if key != self._rare[0]:
            self._rare = (key, rare_json(*key))
        return self._rare[1]


def _position_rad(reading: Reading | None) -> float:
    if reading is None or reading.position_rad is None or reading.age_s > AWAY_S:
        return math.nan
    return reading.position_rad


def _drained(waiting: deque[T]) -> Iterator[T]:
    while waiting:
        yield waiting.popleft()


def _event(event: ListenerEvent) -> dict[str, Any]:
    return {
        "event": event.kind,
        "at_s": round(event.start_s, 3),
        "lasts_s": round(event.duration_s, 3),
        "size": round(event.size, 4),
        "swings": event.swings,
        "probability": None if event.probability is None else round(event.probability, 5),
        "evidence": {name: round(float(value), 3) for name, value in event.evidence.items()},
    }
