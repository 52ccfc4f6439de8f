"""A listener of four parts: an event model, a model of motion, kinematics of the eyes, and idle motion of the face.

For each frame, in this order:

    events      hazards depend on the person and on own earlier events, and decide new ones (`events.model`)
    control     decided events become rows of numbers, for past frames and for the frames to be planned
    motion      the model draws head and face from those rows, but not the direction of the eyes
    gaze        the eyes go to the target of the last gaze shift, the head follows, and while it nods the eyes stay
    idle        the small motion of a resting face, if the listener has learned one (`idle`)

Frame t ends at (t + 1) T. The table is for the time after frame t has come. P and A are the numbers of past and future
rows in `RunsOnEngine.control_frames`, H is the horizon:

    frame             t-P+1 .. t-1   t | t+1  t+2  t+3  t+4 .. t+H
    control rows          0 .. P-2 P-1 |   P  P+1  P+2  ..   P+A-1
    plan frames                        |   0    1    2    3 ..  H-1      times_s[0] = (t + 2) T
    memory.gaze                      0 |   1    2    3    4 ..   H       state of the eyes after that frame
    events decided                   d | begin after frame t+3 = t + LEAD_FRAMES, at (t + 4) T

Hazards are drawn for every second frame (`events.model.STEP_FRAMES`); only every `hop`-th frame brings a plan. A plan
contains the events decided since the previous plan. For any hop up to LEAD_FRAMES + 1 they begin no sooner than the
plan does, and they are never revoked. When h frames of the plan in force have passed, the eyes are at its h-th state:
`memory.gaze` loses its first entry per frame.

The model of motion was trained on people in front of a camera. A face that is turned or moved further than a camera
follows (upside down, far off) is not passed to it; events compare that face with its own last second
(`events.evidence`).

Laws: `step_each` of several streams equals `step` of each. Every event is in one plan only. Without decided events the
eyes look at the person. Memory holds only what is still in progress.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np

from sfms_robot.config import Calmness
from sfms_robot.frames import Events, Floats, ListenerEvent, Plan, SpeakerFrame, changed
from sfms_robot.listeners.engine import RunsOnEngine
from sfms_robot.listeners.events.model import AT_PERSON, EventMemory, EventModel
from sfms_robot.listeners.idle import IdleMotion, IdleStream
from sfms_robot.signals import gaze_kinematics
from sfms_robot.signals.control import control_track
from sfms_robot.signals.gaze_kinematics import GazeState

EYES: Final = list(gaze_kinematics.EYE_CHANNELS)
TURNED_RAD: Final = np.deg2rad(60.0)
MOVED_M: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class EventfulMemory:
    """The memory of one stream.

    Attributes:
        when, how: memories of the event model and of the motion model.
        news: events decided since the last plan.
        gaze: state of the eyes after the newest frame, then after every further frame of the plan in force.
        idle: idle motion of the stream; None if the listener has none.
    """

    when: EventMemory
    how: Any
    news: Events = ()
    gaze: tuple[GazeState, ...]
    idle: IdleStream | None = None


class EventfulListener(RunsOnEngine):
    """A listener of parts: `when` decides events, `how` draws motion, `idle` moves a face at rest. Ignores control."""

    def __init__(
        self, how: RunsOnEngine, when: EventModel, calmness: Calmness | None, idle: IdleMotion | None = None
    ) -> None:
        self.how, self.when, self.calmness, self.idle = how, when, calmness or Calmness(), idle
        self.engine, self.hop, self.hops, self.horizon = how.engine, how.hop, how.hops, how.horizon

    def at_hop(self, hop: int) -> Self:
        """Return the same listener with a plan every `hop` frames."""
        other = super().at_hop(hop)
        other.how = self.how.at_hop(hop)
        return other

    def start(self, seed: int) -> EventfulMemory:
        """Return the memory of a new stream, before any frame and any event."""
        return EventfulMemory(
            when=self.when.start(seed, self.calmness),
            how=self.how.start(seed),
            gaze=(gaze_kinematics.start(seed),),
            idle=None if self.idle is None else self.idle.start(seed),
        )

    def calmed(self, memory: EventfulMemory, calmness: Calmness) -> EventfulMemory:
        """Return the memory with other rates from now on."""
        return changed(memory, when=self.when.calmed(memory.when, calmness))

    def step_each(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[EventfulMemory], controls: object = None
    ) -> list[tuple[Plan | None, EventfulMemory]]:
        """Step several streams, see `engine.RunsOnEngine.step_each`."""
        past, ahead = self.how.control_frames
        decided = self.when.step_each(speakers, [memory.when for memory in memories])
        found: list[EventfulMemory] = []
        rows: list[Floats | None] = []
        for speaker, memory, (events, when) in zip(speakers, memories, decided, strict=True):
            gaze = memory.gaze[1:] or memory.gaze  # after the end of a plan the eyes stay
            found.append(changed(memory, when=when, news=memory.news + events, gaze=gaze))
            # Control rows of frames t - P + 1 to t + A, if frame t brings a plan.
            due, first = self.how.is_due(memory.how), speaker.number + 1 - past
            rows.append(control_track(when.done, first, past + ahead) if due else None)
        moved = self.how.step_each([*map(_believed, speakers)], [memory.how for memory in found], rows)
        return [self._looking(plan, changed(memory, how=how)) for (plan, how), memory in zip(moved, found, strict=True)]

    def _looking(self, plan: Plan | None, memory: EventfulMemory) -> tuple[Plan | None, EventfulMemory]:
        """Return the plan with eyes, idle motion and the new events, and the memory after it."""
        if plan is None:
            return None, memory
        shifts = [event for event in memory.when.done if event.target_rad is not None]
        targets = [target_at(shifts, time_s) for time_s in plan.times_s.tolist()]
        head_rad, eyes, states = gaze_kinematics.follow(targets, plan.frames, memory.gaze[0])
        frames = plan.frames.copy()
        frames[:, :3] += head_rad
        frames[:, EYES] = eyes
        if memory.idle is not None:
            silent_s = memory.when.sensed.hearing.own_voice_s + plan.times_s - plan.times_s[0]
            frames = memory.idle.added(frames, plan.times_s, silent_s)
        drawn = changed(plan, frames=frames, events=memory.news, hazards_hz=memory.when.hazards_hz)
        return drawn, changed(memory, news=(), gaze=(memory.gaze[0], *states))


def _believed(speaker: SpeakerFrame) -> SpeakerFrame:
    """Return the frame, without its face if that is turned or moved further than a person in front of a camera."""
    if speaker.face is None:
        return speaker
    pose = [abs(value) for value in speaker.face.pose.tolist()]
    near = max(pose[:3]) <= TURNED_RAD and max(pose[3:]) <= MOVED_M and not any(map(math.isnan, pose))
    return speaker if near else changed(speaker, face=None)


def target_at(events: Sequence[ListenerEvent], time_s: float) -> tuple[float, float]:
    """Return (yaw, pitch) [rad] of the last gaze shift that has begun by `time_s`; `AT_PERSON` before the first."""
    for event in reversed(events):
        if event.target_rad is not None and event.start_s <= time_s + 1e-9:
            return event.target_rad
    return AT_PERSON
