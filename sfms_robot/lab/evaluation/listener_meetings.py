"""A meeting around one of its people: what reaches him from the others, and what he did.

Everything but himself is kept: when the others spoke becomes a voice and a face, as in composed dyads; the face laughs
and nods when they did, and whether the one who speaks looks at him is what the annotation says. `shifted` puts another
minute of the others in the place of each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import FRAME_HZ, FRAME_S, Doubles, Floats, ListenerEvent, SpeakerFrame, changed
from sfms_robot.lab.corpora.compose.ami import Person
from sfms_robot.lab.corpora.compose.composed import Stretch, active, cast, heard, own_voice
from sfms_robot.lab.corpora.compose.render_events import speaker_motion
from sfms_robot.lab.corpora.compose.speaking import sent
from sfms_robot.lab.corpora.compose.voices import Voice, laugh, lay, mouth_over
from sfms_robot.lab.evaluation import phrase_timing
from sfms_robot.lab.evaluation.rollout import speaker_frames
from sfms_robot.signals import events
from sfms_robot.signals.events import Bools
from sfms_robot.signals.motion_primitives import Motions

SHIFT_S: Final = 60.0
SILENT_S: Final = 1.0  # whoever spoke this recently is not just listening to somebody
FLOOR_S: Final = 1.0  # a phrase this long takes the floor
SIZES: Final[Mapping[str, float]] = {"nod": np.deg2rad(5.0), "gaze_shift": 0.4}  # which nobody measured; else 0.5

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class ListenerMeeting:
    """N frames of 40 ms around one listener.

    Attributes:
        name: meeting and listener; participant: who he is in all his meetings.
        speaker: what he hears and sees; `agent_audio` is his own voice.
        spans_s: what he did by kind, (K, 2) start, end; a kind that nobody annotated of him is not there.
        aside: (K,) which of his gaze shifts go away from whoever speaks or has the floor.
        others, own, unseen: (N,) others speak, he speaks, his head is off camera.
        alone: (N,) exactly one other speaks.
        attention: (N,) 1 or 0: the other who speaks, or had the floor last, looks at him or not; NaN: nobody annotated.
    """

    name: str
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
        """(N,) others spoke in the last 2 s, he is silent and in view."""
        return phrase_timing.listening_mask(self.others, FRAME_HZ, self.own) & ~self.unseen

    @property
    def spoken_to(self) -> Bools:
        """(N,) exactly one other speaks, he has been silent for a second, and it is known where the other looks."""
        ends_s = [end / FRAME_HZ for _, end in events.runs(self.own)]
        spoke = phrase_timing.window_after(ends_s, (0.0, SILENT_S), self.frames, FRAME_HZ)
        return self.listening & self.alone & ~spoke & ~np.isnan(self.attention)

    @property
    def addressed(self) -> Bools:
        return np.asarray(self.spoken_to & (self.attention == 1))

    @property
    def bystander(self) -> Bools:
        return np.asarray(self.spoken_to & (self.attention == 0))

    @property
    def history(self) -> tuple[ListenerEvent, ...]:
        """What he did that a listener might have, as events in their order: nods, while he listened."""
        heard = self.listening[self.instants("nod")]
        spans_s = {**self.spans_s, "nod": self.spans_s["nod"][heard]}
        found = [
            ListenerEvent(
                kind, float(start), float(end - start), SIZES.get(kind, 0.5), target_rad=self._target(kind, at)
            )
            for kind, spans in spans_s.items()
            for at, (start, end) in enumerate(spans)
        ]
        return tuple(sorted(found, key=lambda event: event.start_s))

    def _target(self, kind: str, at: int) -> tuple[float, float] | None:
        if kind != "gaze_shift":
            return None
        return (SIZES[kind], 0.0) if self.aside[at] else (0.0, 0.0)

    def begins(self, kind: str) -> tuple[Ints, Bools]:
        """(K,) last frames before his events of a kind, of those that begin where they might; and where (N,) that is.

        They might where he listens and is not in the middle of one; a look aside might where he looks at whoever
        speaks or has the floor, and other shifts of gaze are left out.
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
        """(N,) the newest of his looks did not go aside."""
        shifts = self.instants("gaze_shift") + 1
        newest = np.searchsorted(shifts, np.arange(self.frames), side="right") - 1
        return np.asarray((newest >= 0) & ~np.r_[self.aside, False][newest])

    def instants(self, kind: str) -> Ints:
        """(K,) the last frame that is over when each event of the kind begins."""
        return frames_before(self.spans_s[kind][:, 0], self.frames)

    def inside(self, kind: str) -> Bools:
        """(N,) an event of the kind is under way when the frame is over."""
        mask = np.zeros(self.frames, bool)
        for start, end in self.spans_s[kind] * FRAME_HZ:
            mask[int(np.floor(start + 1e-6)) : max(0, int(np.ceil(end - 1e-6)) - 1)] = True
        return mask


def frames_before(starts_s: Doubles, frames: int) -> Ints:
    """(K,) the last frame, of so many, that is over at each instant (K,)."""
    before = np.floor(starts_s * FRAME_HZ + 1e-6).astype(np.int64) - 1
    return np.asarray(before.clip(0, frames - 1))


def listener_meeting(
    person: Person, voices: Sequence[Voice], laughter: Sequence[Floats], motions: Motions, rng: np.random.Generator
) -> ListenerMeeting:
    """The time in which his head was annotated: one voice and face for all the others, and a voice for himself."""
    whole = Stretch(person, 0.0, FRAME_S * int(person.until_s * FRAME_HZ))
    voice = cast(voices, rng)
    said = _own_words(whole, own_voice(voices, voice, rng), rng)
    floor = _floor(person, whole)
    attention = _looks(person, whole, floor)
    audio, face = _others(whole, voice, laughter, motions, attention, rng)
    return ListenerMeeting(
        f"{person.meeting}_{person.agent}",
        person.participant,
        tuple(speaker_frames(audio, face, said, attention.astype(np.float32))),
        _annotated(person, whole),
        _aside(person, floor),
        active(person.others, whole),
        active(person.talk, whole),
        active(person.unseen, whole),
        _speakers(person, whole) == 1,
        attention,
    )


def _others(
    stretch: Stretch,
    voice: Voice,
    laughter: Sequence[Floats],
    motions: Motions,
    attention: Doubles,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Their voice (N * 640,) and their face (N, 58)."""
    person, frames = stretch.person, stretch.frames
    spoken = np.clip(person.others, 0, stretch.end_s)
    speech, mouth = lay(spoken[spoken[:, 1] > spoken[:, 0]], frames, voice, rng)
    nods = _spans(person.others_nods)
    moving = mouth_over(speech, motions.talk, frames, rng) if mouth is None else mouth
    face = speaker_motion(moving, motions, rng, attention.astype(np.float32), person.others_laughs, nods)
    return heard(laugh(speech, person.others_laughs, laughter, rng), voice, rng), face


def _own_words(stretch: Stretch, voice: Voice | None, rng: np.random.Generator) -> Floats | None:
    if voice is None:
        return None
    said = np.clip(stretch.person.talk, 0, stretch.end_s)
    speech, _ = lay(said[said[:, 1] > said[:, 0]], stretch.frames, voice, rng)
    return sent(speech, rng)


def _annotated(person: Person, stretch: Stretch) -> dict[str, Doubles]:
    spans = {"nod": person.nods, "mm_hm": person.mm_hms, "laugh": person.laughs}
    if person.gaze is not None:
        spans["gaze_shift"] = np.array([look[:2] for look in person.gaze], np.float64).reshape(-1, 2)
    return {kind: found[found[:, 0] < stretch.end_s] for kind, found in spans.items()}


# --- who speaks, and who looks ----------------------------------------------------------------------------------


def _speakers(person: Person, stretch: Stretch) -> Ints:
    """(N,) how many of the others speak."""
    agents = sorted({agent for _, _, agent in person.floor})
    masks = [active(_spans(person.floor, agent), stretch) for agent in agents]
    return np.asarray(np.sum([np.zeros(stretch.frames, np.int64), *masks], axis=0), np.int64)


def _floor(person: Person, stretch: Stretch) -> NDArray[np.str_]:
    """(N,) the only other who speaks; else who of them spoke for a second last; "" before the first."""
    floor = np.full(stretch.frames, "", dtype="<U1")
    for taken_s, agent in sorted(
        (start + FLOOR_S, agent) for start, end, agent in person.floor if end - start >= FLOOR_S
    ):
        floor[int(np.ceil(taken_s * FRAME_HZ)) :] = agent
    alone = _speakers(person, stretch) == 1
    for agent in {agent for _, _, agent in person.floor}:
        floor[alone & active(_spans(person.floor, agent), stretch)] = agent
    return floor


def _looks(person: Person, stretch: Stretch, floor: NDArray[np.str_]) -> Doubles:
    """(N,) `ListenerMeeting.attention`."""
    out = np.full(stretch.frames, np.nan)
    for agent in person.gaze_known:
        his = floor == agent
        out[his] = active(_spans(person.looked_at, agent), stretch)[his]
    return out


def _aside(person: Person, floor: NDArray[np.str_]) -> Bools:
    """(K,) his looks that go elsewhere than to whoever speaks or has the floor."""
    looks = [look for look in person.gaze or () if look[0] < len(floor) * FRAME_S]
    at = frames_before(np.array([start for start, _, _ in looks], np.float64), len(floor))
    return np.array([target != floor[frame] for (_, _, target), frame in zip(looks, at, strict=True)], bool)


def _spans(told: Sequence[tuple[float, float, str]], agent: str | None = None) -> Doubles:
    """(K, 2) of what one agent did, or all."""
    return np.array([(a, b) for a, b, who in told if agent in (None, who)], np.float64).reshape(-1, 2)


# --- the same, otherwise ----------------------------------------------------------------------------------------


def part(speaker: Sequence[SpeakerFrame], first: int, frames: int) -> list[SpeakerFrame]:
    """So many frames from `first` on, timed from their own beginning."""
    return [_at((index + 1) * FRAME_S, frame) for index, frame in enumerate(speaker[first : first + frames])]


def without_own_voice(speaker: Sequence[SpeakerFrame]) -> list[SpeakerFrame]:
    """As a head hears it that never speaks."""
    return [changed(frame, agent_audio=None) for frame in speaker]


def shifted(speaker: Sequence[SpeakerFrame], by_s: float = SHIFT_S) -> list[SpeakerFrame]:
    """What comes from the others, `by_s` late; the end comes at the beginning. His own voice stays where it is."""
    by = round(by_s * FRAME_HZ) % len(speaker)
    before = [*speaker[len(speaker) - by :], *speaker[: len(speaker) - by]]
    return [
        changed(_at(frame.time_s, other), agent_audio=frame.agent_audio)
        for frame, other in zip(speaker, before, strict=True)
    ]


def _at(time_s: float, frame: SpeakerFrame) -> SpeakerFrame:
    return changed(frame, time_s=time_s, face=frame.face and changed(frame.face, time_s=time_s))
