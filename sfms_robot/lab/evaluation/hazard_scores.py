"""The part of a listener that decides when events happen, played without motion: whole meetings in seconds.

There are two ways. Left to itself it decides, and its history is what it decided. Given a person's history it decides
nothing: only its hazards are computed, at every instant, as if it had done what the person did so far. These are ranked
against what the person did next: nods drawn from good hazards with a few seeds rank hardly better than chance.

`ReferenceHazard` is the bar: what the annotations themselves reveal about nods. A logistic hazard of speech and its
length, of looks, laughs and nods, and of the person's earlier nods, fitted on training people and evaluated at every
instant of another person's meeting. It gets exactly what the annotators saw, where a head has a microphone and a
camera; once with the person's own speech, and once fitted and evaluated without.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from sfms_robot.config import Calmness
from sfms_robot.frames import EVENT_KINDS, FRAME_HZ, FRAME_S, Doubles, ListenerEvent, SpeakerFrame
from sfms_robot.lab.corpora.compose.ami import MeetingPerson
from sfms_robot.lab.evaluation.listener_meetings import SHIFT_S
from sfms_robot.lab.evaluation.whole_recordings import heard_in, most_in, scene_in, steps_in
from sfms_robot.lab.learning.events.event_trainer import (
    FLOOR,
    GAZE,
    NOD,
    OTHERS,
    OWN_NODS,
    PHASE,
    Logistic,
    inputs,
    scene_of,
    student,
    teach,
)
from sfms_robot.lab.learning.events.labels import meeting_evidence
from sfms_robot.listeners.events.evidence import HEARD, Sensed
from sfms_robot.listeners.events.model import (
    AT_PERSON,
    LEAD_FRAMES,
    STEP_FRAMES,
    STEP_S,
    EventMemory,
    EventModel,
    last_shift,
)
from sfms_robot.listeners.stream_rng import Use, uniforms

_SILENT: Final = {
    **PHASE,
    **{name: knots for name, knots in FLOOR.items() if name != "floor_mine"},
    **OWN_NODS,
    **GAZE,
    **OTHERS,
}


def sensed(speaker: Sequence[SpeakerFrame], calmness: Calmness | None = None) -> tuple[Doubles, Doubles]:
    """Return the evidence (N, len(HEARD)) of the person in the frames: with the listener's own voice, and without."""
    scene = scene_in(speaker, (calmness or Calmness()).addressed)
    alone = scene.speaks.copy()
    alone[:, 0] = False
    return heard_in(scene), heard_in(replace(scene, speaks=alone))


def annotated(person: MeetingPerson, frames: int) -> tuple[Doubles, Doubles, Doubles]:
    """Return the evidence (frames, len(HEARD)) that annotators saw in place of a microphone and a camera.

    With the listener's own voice, without it, and without it while the others are a minute off.
    """
    own, alone = (heard_in(scene_of(meeting_evidence(each))) for each in (person, mute(person)))
    at = np.minimum(np.arange(frames), len(own) - 1)
    return own[at], alone[at], np.roll(alone, round(SHIFT_S * FRAME_HZ), axis=0)[at]


def delayed(hazards_hz: dict[str, Doubles]) -> dict[str, Doubles]:
    """Return hazards one frame late. A head gets its voice a frame early, which would reveal its own "mm-hm"."""
    return {kind: np.concatenate([values[:1], values[:-1]]) for kind, values in hazards_hz.items()}


def decisions(
    model: EventModel, heard: Doubles, seeds: Sequence[int], calmness: Calmness | None = None
) -> list[tuple[ListenerEvent, ...]]:
    """Return the decisions for each seed without a given history, skipping steps at which no event can begin."""
    steps = steps_in(len(heard))
    most = most_in(model, heard[steps], calmness or Calmness())
    found = []
    for seed in seeds:
        draws = np.array([uniforms(seed, step, Use.EVENT, len(EVENT_KINDS))[model.draws] for step in steps.tolist()])
        frames = [*steps[(draws < most).any(axis=1)].tolist(), len(heard)]
        found.append(_decided(model, heard, frames, model.start(seed, calmness)))
    return found


def _decided(
    model: EventModel, heard: Doubles, frames: Sequence[int], memory: EventMemory
) -> tuple[ListenerEvent, ...]:
    """Decide at the end of each of `frames`, the last of which is beyond the end."""
    found = list[ListenerEvent]()
    at, look_back = 0, math.inf  # the frame from which on a look aside is over
    while (frame := min(frames[at], look_back)) < len(heard):
        ((decision, memory),) = model.decide_each([Sensed(int(frame), heard[int(frame)])], [memory])
        found += decision.events
        at += frame == frames[at]
        look = last_shift(memory.done)
        over = math.inf  # the step at which the newest look is over, if it goes aside
        if look is not None and look.target_rad != AT_PERSON:
            step = math.ceil((look.end_s / FRAME_S - 1 - LEAD_FRAMES - 1e-6 - (STEP_FRAMES - 1)) / STEP_FRAMES)
            over = step * STEP_FRAMES + STEP_FRAMES - 1
        look_back = max(frame + STEP_FRAMES, over)
    return tuple(found)


def spans_of(events: Sequence[ListenerEvent], kind: str) -> Doubles:
    """Return (K, 2) start, end of the events of a kind."""
    return np.array([(one.start_s, one.end_s) for one in events if one.kind == kind], np.float64).reshape(-1, 2)


def mute(person: MeetingPerson) -> MeetingPerson:
    """Return the person without a word; the time of listening still excludes the person's speech."""
    words = {agent: spans for agent, spans in person.words.items() if agent != person.agent}
    return replace(person, words=words)


@dataclass(frozen=True)
class ReferenceHazard:
    """Log-odds of a nod, from two fits: with the person's own speech, and without."""

    speaking: Logistic
    silent: Logistic

    @classmethod
    def of(cls, people: Sequence[MeetingPerson]) -> Self:
        """Fit on these people; takes some seconds for a hundred meetings."""
        rng = np.random.default_rng(0)
        with_voice = [student(person, rng) for person in people]
        without = [student(mute(person), rng) for person in people]
        return cls(teach(with_voice, "nod", NOD), teach(without, "nod", _SILENT))

    def scores(self, person: MeetingPerson, frames: int) -> tuple[Doubles, Doubles, Doubles]:
        """Return (frames,) each: with the own speech, without it, and without it while the others are a minute off."""
        rng = np.random.default_rng(0)
        heard = student(person, rng).evidence
        alone = student(mute(person), rng).evidence
        other = alone.copy()
        other[:, : len(HEARD)] = np.roll(alone[:, : len(HEARD)], round(SHIFT_S / STEP_S), axis=0)
        by_step = (
            self.speaking.log_odds(inputs(heard, NOD)),
            self.silent.log_odds(inputs(alone, _SILENT)),
            self.silent.log_odds(inputs(other, _SILENT)),
        )
        # (M,) known as each step begins -> (frames,) known as each frame is over
        at = ((np.arange(frames) + 1) // STEP_FRAMES).clip(0, len(heard) - 1)
        speaking, silent, shifted = (np.asarray(steps[at]) for steps in by_step)
        return speaking, silent, shifted
