"""The part of a listener that decides when something happens, played alone: no motion, so whole meetings in seconds.

Two ways. Left to itself it decides, and goes by what it decided. Given a person's own history it decides nothing: only
its hazards are asked, at every instant, as if it had done so far what he did. These are what is ranked against what he
did next: nods drawn from good hazards by a few seeds rank his hardly better than chance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfms_robot.config import Calmness
from sfms_robot.frames import EVENT_KINDS, FRAME_HZ, FRAME_S, Doubles, ListenerEvent, SpeakerFrame
from sfms_robot.lab.corpora.compose.ami import Person
from sfms_robot.lab.evaluation.listener_meetings import SHIFT_S
from sfms_robot.lab.evaluation.reference_hazard import mute
from sfms_robot.lab.evaluation.whole_recordings import Ints, hazards_in, heard_in, most_in, scene_in, steps_in
from sfms_robot.lab.learning.events.event_trainer import scene_of
from sfms_robot.lab.learning.events.labels import meeting_evidence
from sfms_robot.listeners.events.evidence import Sensed
from sfms_robot.listeners.events.model import AT_PERSON, LEAD_FRAMES, STEP_FRAMES, DecideMemory, EventModel
from sfms_robot.listeners.stream_rng import Use, uniforms_of


def sensed(speaker: Sequence[SpeakerFrame], calmness: Calmness | None = None) -> tuple[Doubles, Doubles]:
    """(N, len(HEARD)) what the frames say of the person, of all streams alike: given the own voice, and without it."""
    scene = scene_in(speaker, (calmness or Calmness()).addressed)
    alone = scene.speaks.copy()
    alone[:, 0] = False
    return heard_in(scene), heard_in(replace(scene, speaks=alone))


def annotated(person: Person, frames: int) -> tuple[Doubles, Doubles, Doubles]:
    """(frames, len(HEARD)) each, what annotators saw of his meeting where a head has a microphone and a camera: given
    his own voice, without it, and without it where the others are a minute off, as of `ReferenceHazard`.
    """
    own, alone = (heard_in(scene_of(meeting_evidence(each))) for each in (person, mute(person)))
    at = np.minimum(np.arange(frames), len(own) - 1)
    return own[at], alone[at], np.roll(alone, round(SHIFT_S * FRAME_HZ), axis=0)[at]


def forced_hazards(
    model: EventModel, heard: Doubles, history: Sequence[ListenerEvent], calmness: Calmness | None = None
) -> dict[str, Doubles]:
    """By kind (N,) events a second after each frame, given what of `history` (in order) has begun by its end."""
    return hazards_in(model, heard, history, calmness or Calmness())


def delayed(hazards_hz: dict[str, Doubles]) -> dict[str, Doubles]:
    """A frame late. A head is told its own voice a frame before it sounds, which would tell its own "mm-hm"."""
    return {kind: np.concatenate([values[:1], values[:-1]]) for kind, values in hazards_hz.items()}


def decisions(
    model: EventModel, heard: Doubles, seeds: Sequence[int], calmness: Calmness | None = None
) -> list[tuple[ListenerEvent, ...]]:
    """What is decided for each seed, left to itself: as frame by frame, but steps where nothing can happen left out."""
    steps = steps_in(len(heard))
    most = most_in(model, heard[steps], calmness or Calmness())
    return [_decided(model, heard, seed, calmness, steps, most) for seed in seeds]


def _decided(
    model: EventModel, heard: Doubles, seed: int, calmness: Calmness | None, steps: Ints, most: Doubles
) -> tuple[ListenerEvent, ...]:
    draws = uniforms_of(seed, steps, Use.EVENT, len(EVENT_KINDS))[:, model.draws]
    frames = [*steps[(draws < most).any(axis=1)].tolist(), len(heard)]
    memory, found = model.start(seed, calmness).decided, list[ListenerEvent]()
    at, look_back = 0, math.inf  # the frame from which on a look aside is over
    while (frame := min(frames[at], look_back)) < len(heard):
        ((decision, memory),) = model.decide_each([Sensed(int(frame), heard[int(frame)])], [memory])
        found += decision.events
        at += frame == frames[at]
        look_back = max(frame + STEP_FRAMES, _over(memory))
    return tuple(found)


def _over(memory: DecideMemory) -> float:
    """The step at which the newest look is over if it goes aside; never, if it does not."""
    look = next((event for event in reversed(memory.done) if event.kind == "gaze_shift"), None)
    if look is None or look.target_rad == AT_PERSON:
        return math.inf
    step = math.ceil((look.end_s / FRAME_S - 1 - LEAD_FRAMES - 1e-6 - (STEP_FRAMES - 1)) / STEP_FRAMES)
    return step * STEP_FRAMES + STEP_FRAMES - 1


def spans_of(events: Sequence[ListenerEvent], kind: str) -> Doubles:
    """(K, 2) start, end of the events of a kind."""
    return np.array([(one.start_s, one.end_s) for one in events if one.kind == kind], np.float64).reshape(-1, 2)
