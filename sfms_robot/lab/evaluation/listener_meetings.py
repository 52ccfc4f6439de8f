"""A meeting around one of its people: the listener's input from the others, and the listener's own events.

Everything except the listener's own behaviour is kept: the speech of the others becomes a voice and a face, as in
composed dyads; the face laughs and nods when they did, and the annotation states whether the person who speaks looks at
the listener. `shifted` replaces each minute of the others by another minute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, Bools, Doubles, Floats, Ints, ListenerEvent, SpeakerFrame, changed
from sfms_robot.lab.corpora import phrase_timing
from sfms_robot.lab.corpora.compose.ami import MeetingPerson
from sfms_robot.lab.corpora.compose.composed import Stretch, active, cast, heard, own_voice, spans_by
from sfms_robot.lab.corpora.compose.render_events import speaker_motion
from sfms_robot.lab.corpora.compose.speaking import sent
from sfms_robot.lab.corpora.compose.voices import VoiceClip, laugh, lay, mouth_over
from sfms_robot.lab.evaluation.rollout import speaker_frames
from sfms_robot.signals import events
from sfms_robot.signals.motion_primitives import Motions

SHIFT_S: Final = 60.0
_SILENT_S: Final = 1.0  # a listener who spoke this recently does more than listen
_FLOOR_S: Final = 1.0  # a phrase this long takes the floor
_SIZES: Final[Mapping[str, float]] = {"nod": np.deg2rad(5.0), "gaze_shift": 0.4}  # assumed; others 0.5


@dataclass(frozen=True, kw_only=True)
class ListenerMeeting:
    """N frames of 40 ms around one listener.

    Attributes:
        participant: The listener, the same name in all meetings.
        speaker: What the listener hears and sees; `agent_audio` is the listener's own voice.
        spans_s: What the listener did by kind, (K, 2) start, end; kinds without annotation are missing.
        aside: (K,) the gaze shifts that go away from the person who speaks or has the floor.
        others, own, unseen: (N,) others speak, the listener speaks, the listener's head is off camera.
        alone: (N,) exactly one other speaks.
        attention: (N,) 1 or 0: the other who speaks, or had the floor last, looks at the listener; NaN: not annotated.
    """

    participant: str
    speaker: tuple[SpeakerFrame, ...]
    spans_s: Mapping[str, Doubles]
    aside: Bools
    others: Bools
    own: Bools
    unseen: Bools
    alone: Bools
    attention: Doubles

    @property
    def frames(self) -> int:
        return len(self.others)

    @property
    def listening(self) -> Bools:
        """Return (N,): others spoke in the last 2 s, the listener is silent and in view."""
        return phrase_timing.listening_mask(self.others, self.own) & ~self.unseen

    @property
    def spoken_to(self) -> Bools:
        """Return (N,): exactly one other speaks, with known attention, and the listener was silent for a second."""
        ends_s = [end / FRAME_HZ for _, end in events.runs(self.own)]
        spoke = phrase_timing.window_after(ends_s, (0.0, _SILENT_S), self.frames)
        return self.listening & self.alone & ~spoke & ~np.isnan(self.attention)

    @property
    def addressed(self) -> Bools:
        return np.asarray(self.spoken_to & (self.attention == 1))

    @property
    def bystander(self) -> Bools:
        return np.asarray(self.spoken_to & (self.attention == 0))

    @property
    def history(self) -> tuple[ListenerEvent, ...]:
        """Return the annotated events, in order, as the history of a listener model; nods only while listening."""
        nods = self.spans_s["nod"][self.listening[self.instants("nod")]]
        found = []
        for kind, spans in {**self.spans_s, "nod": nods}.items():
            size = _SIZES.get(kind, 0.5)
            for at, (start, end) in enumerate(spans):
                target = None if kind != "gaze_shift" else (size, 0.0) if self.aside[at] else (0.0, 0.0)
                found.append(ListenerEvent(kind, float(start), float(end - start), size, target_rad=target))
        return tuple(sorted(found, key=lambda event: event.start_s))

    def begins(self, kind: str) -> tuple[Ints, Bools]:
        """Return last frames (K,) before the events of a kind that begin in allowed frames, and these frames (N,).

        Events may begin while the listener listens and no event of the kind is under way; a look aside may begin while
        the listener looks at the person who speaks or has the floor, and other gaze shifts do not count.
        """
        instants = self.instants(kind)
        if kind == "gaze_shift":
            might = self.listening & self.looks_at_speaker
            instants = instants[self.aside]
        else:
            might = self.listening & ~self.inside(kind)
        return instants[might[instants]], might

    @property
    def looks_at_speaker(self) -> Bools:
        """Return (N,): the newest gaze shift did not go aside."""
        shifts = self.instants("gaze_shift") + 1
        newest = np.searchsorted(shifts, np.arange(self.frames), side="right") - 1
        return np.asarray((newest >= 0) & ~np.r_[self.aside, False][newest])

    def instants(self, kind: str) -> Ints:
        """Return (K,) the last frame that is complete when each event of the kind begins."""
        return frames_before(self.spans_s[kind][:, 0], self.frames)

    def inside(self, kind: str) -> Bools:
        """Return (N,): an event of the kind is under way at the end of the frame."""
        mask = np.zeros(self.frames, bool)
        for start, end in self.spans_s[kind] * FRAME_HZ:
            mask[int(np.floor(start + 1e-6)) : max(0, int(np.ceil(end - 1e-6)) - 1)] = True
        return mask


def frames_before(starts_s: Doubles, frames: int) -> Ints:
    """Return the last frame (K,), of `frames`, that is complete at each instant (K,)."""
    before = np.floor(starts_s * FRAME_HZ + 1e-6).astype(np.int64) - 1
    return before.clip(0, frames - 1)


def listener_meeting(
    person: MeetingPerson,
    voices: Sequence[VoiceClip],
    laughter: Sequence[Floats],
    motions: Motions,
    rng: np.random.Generator,
) -> ListenerMeeting:
    """Compose the annotated time: one voice and face for all others, one voice for the listener."""
    whole = Stretch(person=person, start_s=0.0, end_s=FRAME_S * int(person.until_s * FRAME_HZ))
    voice = cast(voices, rng)
    own, said = own_voice(voices, voice, rng), None
    if own is not None:
        said = sent(lay(_spoken(person.talk, whole), whole.frames, own, rng)[0], rng)
    talks = {agent: active(spans_by(person.floor, agent), whole) for agent in {agent for _, _, agent in person.floor}}
    alone = np.sum([np.zeros(whole.frames, np.int64), *talks.values()], axis=0) == 1
    floor = np.full(whole.frames, "", dtype="<U1")  # the only other who speaks, else the last who spoke for a second
    for taken_s, agent in sorted(
        (start + _FLOOR_S, agent) for start, end, agent in person.floor if end - start >= _FLOOR_S
    ):
        floor[int(np.ceil(taken_s * FRAME_HZ)) :] = agent
    for agent, talk in talks.items():
        floor[alone & talk] = agent
    attention = np.full(whole.frames, np.nan)
    for agent in person.gaze_known:
        theirs = floor == agent
        attention[theirs] = active(spans_by(person.looked_at, agent), whole)[theirs]
    speech, mouth = lay(_spoken(person.others, whole), whole.frames, voice, rng)
    moving = mouth_over(speech, motions.talk, whole.frames, rng) if mouth is None else mouth
    look, nods = attention.astype(np.float32), spans_by(person.others_nods)
    face = speaker_motion(moving, motions, rng, look, person.others_laughs, nods)
    audio = heard(laugh(speech, person.others_laughs, laughter, rng), voice, rng)
    spans = {"nod": person.nods, "mm_hm": person.mm_hms, "laugh": person.laughs}
    looks = [each for each in person.gaze or () if each[0] < whole.frames * FRAME_S]
    if person.gaze is not None:
        spans["gaze_shift"] = np.array([each[:2] for each in person.gaze], np.float64).reshape(-1, 2)
    at = frames_before(np.array([start for start, _, _ in looks], np.float64), whole.frames)
    return ListenerMeeting(
        participant=person.participant,
        speaker=tuple(speaker_frames(audio, face, said, look)),
        spans_s={kind: found[found[:, 0] < whole.end_s] for kind, found in spans.items()},
        aside=np.array([target != floor[frame] for (_, _, target), frame in zip(looks, at, strict=True)], bool),
        others=active(person.others, whole),
        own=active(person.talk, whole),
        unseen=active(person.unseen, whole),
        alone=alone,
        attention=attention,
    )


def _spoken(spans: Doubles, stretch: Stretch) -> Doubles:
    spoken = np.clip(spans, 0, stretch.end_s)
    return spoken[spoken[:, 1] > spoken[:, 0]]


# --- parts and variants ---------------------------------------------------------------------------------------------


def part(speaker: Sequence[SpeakerFrame], first: int, frames: int) -> list[SpeakerFrame]:
    """Return `frames` frames from `first` on, timed from the beginning of the part."""
    return [
        changed(frame, time_s=number * FRAME_S, face=frame.face and changed(frame.face, time_s=number * FRAME_S))
        for number, frame in enumerate(speaker[first : first + frames], start=1)
    ]


def shifted(speaker: Sequence[SpeakerFrame]) -> Sequence[SpeakerFrame]:
    """Return the frames delayed by `SHIFT_S`, the end at the beginning; their times and own voice move with them."""
    at = -round(SHIFT_S * FRAME_HZ) % len(speaker)
    return [*speaker[at:], *speaker[:at]]
