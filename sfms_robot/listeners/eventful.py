"""A listener in four parts: events say when, a model of motion says how, kinematics move the eyes, a face never rests.

For each frame, in this order:

    events      hazards judge the person and what was done before, and decide (`events.model`)
    control     what has been decided becomes rows of numbers, of the past and of the frames to be planned
    motion      the model draws head and face from those rows; the direction of the eyes it leaves alone
    gaze        the eyes go to the target of the last gaze shift, the head follows, and while it nods the eyes stay
    idle        the small motion of a resting face, where the listener has learned any (`idle`)

Frame t ends at (t + 1) T. When it has been heard, with P past and A ahead of `MotionModel.control_frames`, horizon H:

    frame             t-P+1 .. t-1   t | t+1  t+2  t+3  t+4 .. t+H
    control rows          0 .. P-2 P-1 |   P  P+1  P+2  ..   P+A-1
    plan frames                        |   0    1    2    3 ..  H-1      times_s[0] = (t + 2) T
    memory.gaze                      0 |   1    2    3    4 ..   H       state of the eyes after that frame
    events decided                   d | begin behind frame t+3 = t + LEAD_FRAMES, at (t + 4) T

The hazards of frame t are drawn when frame t brings a plan. With hop h the frames t+1 .. t+h-1 wait, and their hazards
are drawn, in order, with frame t+h: only its plan could show an event. So an event begins no sooner than the plan that
brings it, for any hop up to LEAD_FRAMES + 1, and is never taken back. By then h frames of the plan in force have
passed, so the eyes are where `memory.gaze[h]` says, which becomes `memory.gaze[0]`.

The model of motion learned from people who sat before a camera. A face further from that than a camera follows (upside
down, far off) is not passed to it; events judge it against its own last second (`events.evidence`).

Laws: `step_many` of several streams is each one's `step`; a plan brings each event once; with nothing decided the eyes
look at the person; memory holds what is still under way, no more.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, Self, cast

import numpy as np

from sfms_robot.config import Calmness
from sfms_robot.frames import FRAME_HZ, FRAME_S, Floats, ListenerEvent, Plan, SpeakerFrame, changed
from sfms_robot.listeners.events.model import Decision, EventMemory, EventModel
from sfms_robot.listeners.idle import IdleMotion, IdleStream
from sfms_robot.signals import gaze_kinematics
from sfms_robot.signals.control import control_track
from sfms_robot.signals.gaze_kinematics import GazeState

EYES: Final = list(gaze_kinematics.EYE_CHANNELS)
AT_THE_PERSON: Final = (0.0, 0.0)
TURNED_RAD: Final = np.deg2rad(60.0)
MOVED_M: Final = 1.0


class MotionModel(Protocol):
    """A listener that draws the motion of events decided elsewhere.

    Attributes:
        control_frames: rows of control that it takes (past, ahead); the past ends with the newest frame heard.
    """

    @property
    def control_frames(self) -> tuple[int, int]: ...

    @property
    def hop(self) -> int: ...

    @property
    def horizon(self) -> int: ...

    def start(self, seed: int) -> Any: ...

    def step(self, speaker: SpeakerFrame, memory: Any, control: Floats | None = None) -> tuple[Plan | None, Any]: ...


Moved = Sequence[tuple[Plan | None, Any]]
Move = Callable[[Sequence[SpeakerFrame], Sequence[Any], Sequence[Floats | None]], Moved]


@dataclass(frozen=True, kw_only=True)
class EventfulMemory:
    """The memory of one stream.

    Attributes:
        when, how: of the events, and of the motion.
        events: decided, and not over for longer than the model looks back; the last gaze shift always.
        news: those of them that no plan has brought yet.
        gaze: state of the eyes after the newest frame decided upon, then after every frame of the plan in force.
        idle: the stream's own idle motion; None: it has none.
        waiting: frames since then, whose hazards are drawn with the next plan.
    """

    when: EventMemory
    how: Any
    events: tuple[ListenerEvent, ...]
    news: tuple[ListenerEvent, ...]
    gaze: tuple[GazeState, ...]
    idle: IdleStream | None = None
    waiting: tuple[SpeakerFrame, ...] = ()


class EventfulListener:
    """`ports.Listener`: `when` decides, `how` moves, `idle` moves a face at rest. Holds weights only."""

    def __init__(
        self, how: MotionModel, when: EventModel, calmness: Calmness | None = None, idle: IdleMotion | None = None
    ) -> None:
        self.how, self.when, self.calmness, self.idle = how, when, calmness or Calmness(), idle

    @property
    def hop(self) -> int:
        """Return the frames from one plan to the next."""
        return self.how.hop

    @property
    def horizon(self) -> int:
        """Return the frames of a plan."""
        return self.how.horizon

    @property
    def hops(self) -> Sequence[int]:
        """Return the hops that `at_hop` takes."""
        return tuple(getattr(self.how, "hops", (self.hop,)))

    def at_hop(self, hop: int) -> Self:
        """Return the same listener, planning every `hop` frames."""
        other = copy.copy(self)
        other.how = self.how if hop == self.hop else cast(Any, self.how).at_hop(hop)
        return other

    def build_graphs(self) -> Self:
        """Compile the networks; their weights must not change any more. Return the listener."""
        build: Callable[[], object] | None = getattr(self.how, "build_graphs", None)
        if build is not None:
            build()
        return self

    def start(self, seed: int) -> EventfulMemory:
        """Return the memory of a stream that has heard nothing and decided nothing."""
        when = self.when.start(seed, self.calmness)
        idle = None if self.idle is None else self.idle.start(seed)
        gaze = (gaze_kinematics.start(seed),)
        return EventfulMemory(when=when, how=self.how.start(seed), events=(), news=(), gaze=gaze, idle=idle)

    def calmed(self, memory: EventfulMemory, calmness: Calmness) -> EventfulMemory:
        """Return the memory with other rates from now on."""
        if memory.waiting:
            ((_, memory),) = self._decided([memory.waiting], [memory])
        return changed(memory, when=self.when.calmed(memory.when, calmness))

    def step(self, speaker: SpeakerFrame, memory: EventfulMemory) -> tuple[Plan | None, EventfulMemory]:
        """Take one frame; return a plan on every `hop`-th, None between, and the memory after it."""
        return self.step_each([speaker], [memory])[0]

    def step_each(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[EventfulMemory]
    ) -> list[tuple[Plan | None, EventfulMemory]]:
        """Step several streams, as `engine.RunsOnEngine`."""
        return self._step(speakers, memories, self._move_each)

    def step_many(
        self, speaker: SpeakerFrame, memories: Sequence[EventfulMemory]
    ) -> tuple[list[Plan], list[EventfulMemory]]:
        """Step streams that began together and have had the same speaker ever since; no plans between hops."""
        found = self._step([speaker] * len(memories), memories, self._move_many)
        return [plan for plan, _ in found if plan is not None], [memory for _, memory in found]

    def _step(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[EventfulMemory], move: Move
    ) -> list[tuple[Plan | None, EventfulMemory]]:
        decided = self._heard(speakers, memories)
        controls = [
            None if decision is None else self._control(speaker, memory)
            for speaker, (decision, memory) in zip(speakers, decided, strict=True)
        ]
        moved = move([*map(_believed, speakers)], [memory.how for _, memory in decided], controls)
        return [
            self._looking(plan, decision, changed(memory, how=how))
            for (plan, how), (decision, memory) in zip(moved, decided, strict=True)
        ]

    def _move_each(
        self, speakers: Sequence[SpeakerFrame], hows: Sequence[Any], controls: Sequence[Floats | None]
    ) -> Moved:
        together: Move | None = getattr(self.how, "step_each", None)
        if together is not None:
            return together(speakers, hows, controls)
        return [self.how.step(*each) for each in zip(speakers, hows, controls, strict=True)]

    def _move_many(
        self, speakers: Sequence[SpeakerFrame], hows: Sequence[Any], controls: Sequence[Floats | None]
    ) -> Moved:
        together = getattr(self.how, "step_many", None)
        if together is None:
            return self._move_each(speakers, hows, controls)
        plans, after = together(speakers[0], hows, controls)
        return [*zip(plans or [None] * len(hows), after, strict=True)]

    def _heard(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[EventfulMemory]
    ) -> list[tuple[Decision | None, EventfulMemory]]:
        """Return the decision of each stream up to a frame that brings a plan, and the memory after it.

        With any other frame the decision is None, and the frame waits.
        """
        is_due: Callable[[Any], bool] = getattr(self.how, "is_due", lambda _: True)
        found: list[tuple[Decision | None, EventfulMemory]] = [
            (None, memory if is_due(memory.how) else changed(memory, waiting=(*memory.waiting, _kept(speaker))))
            for speaker, memory in zip(speakers, memories, strict=True)
        ]
        due = [row for row, memory in enumerate(memories) if is_due(memory.how)]
        frames = [(*memories[row].waiting, speakers[row]) for row in due]
        for row, each in zip(due, self._decided(frames, [memories[row] for row in due]), strict=True):
            found[row] = each
        return found

    def _decided(
        self, speakers: Sequence[Sequence[SpeakerFrame]], memories: Sequence[EventfulMemory]
    ) -> list[tuple[Decision, EventfulMemory]]:
        """Draw the hazards of the frames of each stream; return the last decision, and the memory with all events."""
        past_s = self.how.control_frames[0] * FRAME_S
        drawn = [(Decision((), {}), memory.when, memory.news) for memory in memories]
        for at in range(max(map(len, speakers), default=0)):
            rows = [row for row, own in enumerate(speakers) if at < len(own)]
            decided = self.when.step_each([speakers[row][at] for row in rows], [drawn[row][1] for row in rows])
            for row, (decision, when) in zip(rows, decided, strict=True):
                drawn[row] = decision, when, drawn[row][2] + decision.events
        found = []
        for own, memory, (decision, when, news) in zip(speakers, memories, drawn, strict=True):
            events = _remembered((*memory.events, *news[len(memory.news) :]), own[-1].time_s - past_s)
            gaze = memory.gaze[min(len(own), len(memory.gaze) - 1) :]  # so many frames have passed
            found.append((decision, changed(memory, when=when, events=events, news=news, gaze=gaze, waiting=())))
        return found

    def _control(self, speaker: SpeakerFrame, memory: EventfulMemory) -> Floats:
        """Return the control rows of frames t - P + 1 to t + A, when frame t brings a plan."""
        past, ahead = self.how.control_frames
        return control_track(memory.events, frame_of(speaker) + 1 - past, past + ahead)

    def _looking(
        self, plan: Plan | None, decision: Decision | None, memory: EventfulMemory
    ) -> tuple[Plan | None, EventfulMemory]:
        """Return the plan with eyes, idle motion and the new events, and the memory after it."""
        if plan is None or decision is None:
            return None, memory
        newest = memory.gaze
        shifts = [event for event in memory.events if event.target_rad is not None]
        targets = [target_at(shifts, time_s) for time_s in plan.times_s.tolist()]
        head_rad, eyes, states = gaze_kinematics.follow(targets, plan.frames, newest[0])
        frames = plan.frames.copy()
        frames[:, :3] += head_rad
        frames[:, EYES] = eyes
        if memory.idle is not None:
            silent_s = memory.when.sensed.hearing.own_voice_s + plan.times_s - plan.times_s[0]
            frames = memory.idle.added(frames, plan.times_s, silent_s)
        drawn = changed(plan, frames=frames, events=memory.news, hazards_hz=decision.hazards_hz)
        return drawn, changed(memory, news=(), gaze=(newest[0], *states))


def _believed(speaker: SpeakerFrame) -> SpeakerFrame:
    """Return the frame without its face where that is turned or moved further than a person before a camera is."""
    if speaker.face is None:
        return speaker
    pose = [abs(value) for value in speaker.face.pose.tolist()]
    near = max(pose[:3]) <= TURNED_RAD and max(pose[3:]) <= MOVED_M and not any(map(math.isnan, pose))
    return speaker if near else changed(speaker, face=None)


def _kept(speaker: SpeakerFrame) -> SpeakerFrame:
    """Return the frame with copies of its arrays: the caller may use them again."""
    face, own = speaker.face, speaker.agent_audio
    return changed(
        speaker,
        audio=np.array(speaker.audio),
        agent_audio=None if own is None else np.array(own),
        face=None if face is None else changed(face, pose=np.array(face.pose), blendshapes=np.array(face.blendshapes)),
    )


def frame_of(speaker: SpeakerFrame) -> int:
    """Return the index of a frame in loop time: frame 0 ends at 0.04 s."""
    return round(speaker.time_s * FRAME_HZ) - 1


def target_at(events: Sequence[ListenerEvent], time_s: float) -> tuple[float, float]:
    """Return (yaw, pitch) [rad] of the last gaze shift that has begun by `time_s`; at the person before the first."""
    for event in reversed(events):
        if event.target_rad is not None and event.start_s <= time_s + 1e-9:
            return event.target_rad
    return AT_THE_PERSON


def _remembered(events: tuple[ListenerEvent, ...], keep_s: float) -> tuple[ListenerEvent, ...]:
    """Return events that are not over by `keep_s`, in order of decision, and the last gaze shift begun by then."""
    if not events:
        return events
    shifts = [event for event in events if event.target_rad is not None and event.start_s <= keep_s]
    return tuple(
        event
        for event in events
        if event in shifts[-1:] or (event.end_s > keep_s if event.target_rad is None else event.start_s > keep_s)
    )
