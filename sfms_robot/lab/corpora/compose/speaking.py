"""Dyads in which only the agent speaks: filmed recordings, voice and mouth together.

Only in these dyads are lips and sound from the same moment and the same person throughout; the head and the rest of the
face come from other recordings. Models learn from these dyads to follow `--agent-audio`, and are scored on them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, MOTION_DIM, Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.compose.ami import LabelledSpan, LabelledSpans, MeetingPerson, interval_table
from sfms_robot.lab.corpora.compose.motions import Rng, pick
from sfms_robot.lab.corpora.compose.render_events import Score, act
from sfms_robot.lab.corpora.compose.voices import VoiceClip, room
from sfms_robot.lab.corpora.conversational_states import states_of_activity
from sfms_robot.lab.corpora.phrase_timing import phrase_ends, voice_activity
from sfms_robot.signals.event_sizes import aside_s
from sfms_robot.signals.events import runs
from sfms_robot.signals.motion_primitives import Motions

LENGTH_S: Final = (15.0, 35.0)
FILES: Final = "speaking_*_[0-9][0-9][0-9].npz"
_QUIET: Final = 0.5  # share of dyads in which the other's microphone records zeros, not even room noise
_GAIN_DB: Final = (-10.0, 6.0)


def dyads(
    voices: Sequence[VoiceClip], motions: Motions, dwell: Dwell, seed: Sequence[int], minutes: float
) -> Iterator[Dyad]:
    """Yield about `minutes` of pieces of the filmed voices; nothing if no voice was filmed."""
    filmed = [voice for voice in voices if voice.mouth is not None]
    weights = np.array([len(voice.recording) for voice in filmed], float)
    rng = np.random.default_rng(seed)
    frames, count = minutes * 60 * FRAME_HZ, 0
    while filmed and frames > 0:
        voice = filmed[rng.choice(len(filmed), p=weights / weights.sum())]
        dyad = take(f"speaking_{voice.name}_{count:03d}", voice, motions, dwell, rng)
        yield dyad
        frames, count = frames - len(dyad.listener), count + 1


def take(name: str, voice: VoiceClip, motions: Motions, dwell: Dwell, rng: Rng) -> Dyad:
    """Return a piece of a filmed recording. Raises ValueError for a voice that was not filmed."""
    if voice.mouth is None:
        raise ValueError(f"{voice.name} was not filmed")
    whole = min(len(voice.recording) // FRAME_SAMPLES, len(voice.mouth) - 1)
    frames = min(int(rng.uniform(*LENGTH_S) * FRAME_HZ), whole)
    first = rng.integers(whole - frames + 1)
    said = voice.recording[first * FRAME_SAMPLES : (first + frames) * FRAME_SAMPLES]
    active = voice_activity(said)
    score = Score(
        frames=frames,
        talk=interval_table(runs(active)) * FRAME_S,
        gaze=dwell.looks(frames * FRAME_S, rng),
        ends=phrase_ends(active),
        mouth=voice.mouth[first + 1 : first + frames + 1],  # a frame shows the face at its end
    )
    acted = act(score, motions, rng)
    silent = np.zeros(frames, bool)
    heard = np.zeros(len(said), np.float32) if rng.random() < _QUIET else room(len(said), voice, rng)
    return Dyad(
        name=name,
        audio=heard,
        speaker=np.full((frames, MOTION_DIM), np.nan, np.float32),
        listener=acted.motion,
        listening=silent,
        agent_audio=sent(said, rng),
        states=states_of_activity(active, silent),
        events=acted.events,
        head_of_gaze_rad=acted.head_of_gaze_rad,
        attention=np.full(frames, np.nan, np.float32),
    )


def sent(speech: Floats, rng: Rng) -> Floats:
    """Return speech as a program sends it to a loudspeaker: at a random level, its silence exactly or nearly zero."""
    gain = np.float32(10 ** (rng.uniform(*_GAIN_DB) / 20))
    hiss = rng.standard_normal(len(speech), np.float32) * np.float32(10 ** (rng.uniform(-90, -60) / 20))
    floor = hiss if rng.random() < 0.3 else np.float32(0)
    return np.clip(gain * speech + floor, -1, 1)


# --- Where listeners look: annotated looks away from the person with the floor, and durations learned from them -----
#
# At a table with papers people look away much more than in front of one face, and they watch slides for minutes. So
# only a share of the looks is kept, and none lasts longer than a look aside drawn for people without a table between
# them (`signals.event_sizes`), which also sets the lengths of a listener's own looks. If gaze was not annotated, looks
# are drawn from the kept ones: at the person and away in turns, each as long as some annotated look. These do not
# depend on the sound, which is our simplification.

_KEPT: Final = 0.4
_NEAR_S: Final = 300.0  # longer than any look
_PLACES: Final = {"table": "down", "slide-screen": "screen", "whiteboard": "screen"}


@dataclass(frozen=True)
class Dwell:
    """Durations [s] of looks at the person with the floor, and of looks elsewhere with their target."""

    at_s: tuple[float, ...]
    away: tuple[tuple[float, str], ...]

    def looks(self, length_s: float, rng: Rng) -> LabelledSpans:
        """Draw looks away within `length_s` seconds; none if no durations were learned."""
        found: list[LabelledSpan] = []
        if not self.at_s or not self.away:
            return ()
        at = rng.uniform(0, 1) * pick(self.at_s, rng)
        while at < length_s:
            lasts_s, where = pick(self.away, rng)
            found.append((at, min(at + lasts_s, length_s), where))
            at += lasts_s + pick(self.at_s, rng)
        return tuple(found)


def learn_dwell(people: Sequence[MeetingPerson]) -> Dwell:
    """Return the durations of all people with annotated gaze; empty if there are none."""
    rng = np.random.default_rng(0)
    at_s: list[float] = []
    elsewhere: list[tuple[float, str]] = []
    for person in people:
        looks = away(person, 0.0, person.until_s, rng)
        at_s += [after[0] - before[1] for before, after in zip(looks[:-1], looks[1:], strict=True)]
        elsewhere += [(end - start, where) for start, end, where in looks]
    return Dwell(tuple(lasts for lasts in at_s if lasts > 0), tuple(elsewhere))


def away(person: MeetingPerson, start_s: float, end_s: float, rng: Rng) -> list[LabelledSpan]:
    """Return a person's kept looks away between two times of the meeting."""
    found: list[LabelledSpan] = []
    near = [(a, b, who) for a, b, who in person.floor if a < end_s + _NEAR_S and b > start_s - _NEAR_S]
    floor = {agent: np.array([(a, b) for a, b, who in near if who == agent]) for agent in {who for _, _, who in near}}
    for start, end, target in person.gaze or ():
        if end < start_s or start > end_s:
            continue
        where = _PLACES.get(target, "away") if len(target) != 1 else f"side {target}"
        if len(target) == 1 and target in floor:
            spoke = floor[target]
            if ((spoke[:, 0] < end + 1) & (spoke[:, 1] > start - 1)).any():
                continue  # the person looked at speaks during the look or less than 1 s before or after it
        if rng.random() < _KEPT:
            found.append((start, min(end, start + aside_s(rng.random())), where))
    return found
