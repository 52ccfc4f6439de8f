"""The part of a listener that decides when something happens, played alone: no motion, so whole meetings in minutes.

Two ways. Left to itself it decides, and goes by what it decided. Given a person's own history it decides nothing: only
its hazards are asked, at every instant, as if it had done so far what he did. These are what is ranked against what he
did next: nods drawn from good hazards by a few seeds rank his hardly better than chance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfms_robot.config import Calmness
from sfms_robot.frames import EVENT_KINDS, FRAME_S, Doubles, ListenerEvent, SpeakerFrame
from sfms_robot.listeners.events.evidence import remembered
from sfms_robot.listeners.events.model import EventModel
from sfms_robot.listeners.events.sensing import Sensed, sense


def sensed(model: EventModel, speaker: Sequence[SpeakerFrame], calmness: Calmness | None = None) -> list[Sensed]:
    """What the frames say of the person: of all streams alike."""
    memory, found = model.start(0, calmness).sensed, []
    for frame in speaker:
        one, memory = sense(frame, memory)
        found.append(one)
    return found


def forced_hazards(
    model: EventModel, heard: Sequence[Sensed], history: Sequence[ListenerEvent], calmness: Calmness | None = None
) -> dict[str, Doubles]:
    """By kind (N,) events a second after each frame, given what of `history` (in order) has begun by its end."""
    memory = model.start(0, calmness).decided
    hazards_hz = {kind: np.zeros(len(heard)) for kind in EVENT_KINDS}
    begun, own = 0, tuple[ListenerEvent, ...]()
    for index, one in enumerate(heard):
        now_s = (index + 1) * FRAME_S
        while begun < len(history) and history[begun].start_s <= now_s:
            own = remembered((*own, history[begun]), now_s)
            begun += 1
        decision, memory = model.decide(one, memory, own)
        for kind, hazard_hz in decision.hazards_hz.items():
            hazards_hz[kind][index] = hazard_hz
    return hazards_hz


def decisions(
    model: EventModel, heard: Sequence[Sensed], seeds: Sequence[int], calmness: Calmness | None = None
) -> list[tuple[ListenerEvent, ...]]:
    """What is decided for each seed, left to itself."""
    streams = []
    for seed in seeds:
        memory, found = model.start(seed, calmness).decided, list[ListenerEvent]()
        for one in heard:
            decision, memory = model.decide(one, memory)
            found += decision.events
        streams.append(tuple(found))
    return streams


def spans_of(events: Sequence[ListenerEvent], kind: str) -> Doubles:
    """(K, 2) start, end of the events of a kind."""
    return np.array([(one.start_s, one.end_s) for one in events if one.kind == kind], np.float64).reshape(-1, 2)
