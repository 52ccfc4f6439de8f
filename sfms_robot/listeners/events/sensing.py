"""A person's frame as evidence: the ear hears who speaks, the face says who looks, nods, smiles and laughs. A head that
talks moves all the time, by more than many a nod: nods are those of somebody silent.

Each input may be missing. No microphone: a mouth that moves is a voice. No face: nobody nods or laughs. Nobody who
tells whether the head is looked at: it is, for one person talks to one head; an attention of NaN says that nobody
knows, and so does a face that has told it before and is lost. Attention flickers; looked-at changes only when a quarter
second of it, smoothed, has clearly crossed the middle, and one that never does leaves it as it would be untold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from sfms_robot.frames import FRAME_S, Doubles, Floats, SpeakerFrame, changed
from sfms_robot.listeners.events.evidence import Hearing, Instant, Scene, hear, hearing
from sfms_robot.listeners.events.face_signs import FaceState, read_signs
from sfms_robot.signals import phase, voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.signals.voice_activity import Ear

Addressed = Literal["sense", "assume", "never"]
OWN_VOICE_DB: Final = -50.0  # of full scale; what a program says is silent otherwise
LOOK_S: Final = 0.25
LOOKED, NOT_LOOKED = 0.6, 0.4
LOST_FRAMES: Final = 25  # without a face nobody knows where its owner looks
_KEPT: Final = math.exp(-FRAME_S / LOOK_S)


@dataclass(frozen=True)
class SenseMemory:
    """What is remembered of the person.

    Attributes:
        addressed: as asked for.
        ear: of their voice; deaf: there has been no sound to hear at all.
        attention: smoothed; None before any. looked: 1, 0, or NaN for nobody knows.
        unseen: frames since their face; None before the first.
        tells: somebody has told their attention.
    """

    addressed: Addressed = "sense"
    ear: Ear = field(default_factory=voice_activity.start)
    deaf: bool = True
    attention: float | None = None
    looked: float = math.nan
    unseen: int | None = None
    tells: bool = False
    face: FaceState = FaceState()
    hearing: Hearing = field(default_factory=hearing)


@dataclass(frozen=True)
class Sensed:
    """Evidence (len(HEARD),) after the frame of that index in loop time."""

    frame: int
    heard: Doubles


def sense(speaker: SpeakerFrame, memory: SenseMemory) -> tuple[Sensed, SenseMemory]:
    """Pure. Several streams of one speaker may share it if their `addressed` is the same."""
    deaf = memory.deaf and not len(speaker.audio)
    ear = memory.ear if deaf else voice_activity.step(energy_db(speaker.audio), memory.ear)
    signs, face = read_signs(speaker.face, memory.face)
    looked, watching = _looked(speaker, memory)
    talks = signs.mouth_moves if deaf else ear.active
    nods = signs.nods and not talks and not memory.hearing.voices.speech
    instant = Instant((_sounds(speaker.agent_audio), talks), (math.nan, looked), signs.laughs, nods, signs.smiles)
    heard, remembered = hear(instant, memory.hearing)
    frame = round(speaker.time_s / FRAME_S) - 1
    return Sensed(frame, heard), changed(watching, ear=ear, deaf=deaf, face=face, hearing=remembered)


def scene_in(speaker: Sequence[SpeakerFrame], addressed: Addressed = "sense") -> Scene:
    """What `sense` takes from each frame of a recording; `evidence.heard_in` makes its rows of that."""
    memory = SenseMemory(addressed)
    deaf, ear, face = True, memory.ear, memory.face
    speaks, looks, signs = np.zeros((len(speaker), 2), bool), np.full((len(speaker), 2), np.nan), []
    speaks[:, 0] = [_sounds(frame.agent_audio) for frame in speaker]
    for index, frame in enumerate(speaker):
        deaf = deaf and not len(frame.audio)
        ear = ear if deaf else voice_activity.step(energy_db(frame.audio), ear)
        sign, face = read_signs(frame.face, face)
        looks[index, 1], memory = _looked(frame, memory)
        speaks[index, 1] = sign.mouth_moves if deaf else ear.active
        signs.append((sign.laughs, sign.nods, sign.smiles))
    laughs, nods, smiles = np.array(signs, bool).reshape(-1, 3).T
    silent = phase.times(speaks[:, 1])[:, 0] == 0
    return Scene(speaks, looks, laughs, nods & silent & np.r_[True, silent][:-1], smiles)


def _sounds(own_voice: Floats | None) -> bool:
    return own_voice is not None and energy_db(own_voice) > OWN_VOICE_DB


def _looked(speaker: SpeakerFrame, memory: SenseMemory) -> tuple[float, SenseMemory]:
    """1, 0 or NaN, and what is remembered of it."""
    if memory.addressed != "sense":
        return float(memory.addressed == "assume"), memory
    if speaker.face is None and speaker.attention is None:
        unseen = None if memory.unseen is None else memory.unseen + 1
        if unseen is None:
            return 1.0, memory
        lost = unseen > LOST_FRAMES
        gone = changed(memory, unseen=unseen, attention=None if lost else memory.attention,
                       looked=math.nan if lost else memory.looked)  # fmt: skip
        return gone.looked, gone
    given = speaker.attention
    if given is None or not math.isfinite(given):
        if given is None and not memory.tells:
            return 1.0, changed(memory, unseen=0)
        return math.nan, changed(memory, unseen=0, attention=None, looked=math.nan)
    before = 1.0 if memory.attention is None else memory.attention
    given = min(max(given, 0.0), 1.0)
    level = given + (before - given) * _KEPT
    looked = 1.0 if math.isnan(memory.looked) else memory.looked
    if level > LOOKED:
        looked = 1.0
    elif level < NOT_LOOKED:
        looked = 0.0
    return looked, changed(memory, unseen=0, attention=level, looked=looked, tells=True)
