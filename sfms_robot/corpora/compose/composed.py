"""Composed dyads: real timing, real movement, put together here.

Real are: when somebody nods, looks away, laughs or says "mm-hm" while others talk, and when they talk and pause (AMI
meeting annotations); how a nod, a blink, a smile moves (recordings, `motions`); how speech sounds (`voices`). That they
belong together is ours: the voice says other words than the meeting did, only its phrases begin and end when they did.
Whoever holds the floor sits straight ahead. Stretches with nods, above all those with nods at the end of a phrase, are
drawn more often than they are in the meetings. Meetings, people, takes and voices kept for validation are whole ones.

A listener's own words get a voice as well, one whose mouth was filmed, and the mouth that belongs to it. Two more sets
serve models that speak: `interaction`, stretches in which the person talks a good share of the time, and `speaking`,
the filmed recordings themselves (`speaking.py`). Each is a data set of its own in a folder of that name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from sfms_robot.corpora import conversational_states as labels
from sfms_robot.corpora.clips import Dyad, save
from sfms_robot.corpora.compose import speaking
from sfms_robot.corpora.compose.acting import Score, listener_motion, speaker_motion
from sfms_robot.corpora.compose.ami import Person, read_people, split_series
from sfms_robot.corpora.compose.motions import SPLITS, Motions
from sfms_robot.corpora.compose.motions import load as load_motions
from sfms_robot.corpora.compose.voices import Voice, find_voices, lay, room, split_voices
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, MOTION_DIM, Doubles, Floats
from sfms_robot.signals.events import listening_mask, nods_per_minute, phrase_end_counts, phrase_ends

LENGTH_S: Final = (30.0, 60.0)
VALIDATION_SHARE: Final = 1 / 6  # of the training minutes
SHARES: Final = {"interaction": 0.5, "speaking": 0.25}  # minutes of the sets that speak, per minute of listening
Scene = Literal["listening", "interaction"]
_FILMED: Final = 0.65  # share of dyads with a voice whose mouth was recorded
_FACELESS: Final = 0.3  # share of those in which the speaker is heard only
_LOOKS: Final = 0.6  # share of the looks away that is kept: across a table with papers people look away a lot
_LONGEST_LOOK_S: Final = (1.5, 4.0)  # a look away ends after this: in meetings people watch slides for minutes
_WEIGHTS: Final = (4.0, 3.0, 2.0, 3)  # of a stretch: base + nods a minute, up to + a nod after a phrase, up to

_FILES: Final = ("*_[A-Z]_[0-9][0-9][0-9][0-9].npz", speaking.FILES)  # Stretch.name


@dataclass(frozen=True)
class Stretch:
    """A piece of a meeting in which a person mostly listens.

    Attributes:
        nods_per_minute: of listening time.
        answers: nods that begin 0 to 0.8 s after the end of a phrase.
    """

    person: Person
    start_s: float
    end_s: float
    nods_per_minute: float = 0.0
    answers: int = 0

    @property
    def weight(self) -> float:
        """How often it is drawn: more for nods, and more again for nods when a phrase ends."""
        base, most, answer, answers = _WEIGHTS
        return base + min(self.nods_per_minute, most) + answer * min(self.answers, answers)

    @property
    def frames(self) -> int:
        return int(round((self.end_s - self.start_s) * FRAME_HZ))

    @property
    def name(self) -> str:
        return f"{self.person.meeting}_{self.person.agent}_{int(self.start_s):04d}"


def compose(ami: Path, voices: Sequence[Path], motions: Path, seed: int, minutes: float) -> dict[str, list[Dyad]]:
    """`minutes` of "train" dyads and a sixth of it of "validation" dyads; the same for the same seed.

    `ami` holds the AMI tables, `voices` are folders of WAV files, `motions` is a file of motion primitives. Raises
    ConfigError.
    """
    made: dict[str, list[Dyad]] = {split: [] for split in SPLITS}
    for split, dyad in dyads(ami, voices, motions, seed, minutes):
        made[split].append(dyad)
    return made


def compose_folder(data: Path, out: Path, seed: int, minutes: float, voices: Sequence[Path] = ()) -> dict[str, float]:
    """Compose from `data` (AMI tables in it or in its ami_listener_annotations/) into out/train and out/validation.

    Beside them, out/interaction and out/speaking are sets of the same form. No filmed voice, no speaking.

    Voices are the bundled speakers, those found in `data` (facegood_audio_mouth/, speech_audio/, the AMI clips) and
    those of further folders. Dyads of an earlier run are removed from `out` once the new ones are written, so that two
    sets never mix. Returns the minutes written per split. Raises ConfigError.
    """
    ami = data / "ami_listener_annotations" if (data / "ami_listener_annotations").is_dir() else data
    brought = [folder for folder in (data / "facegood_audio_mouth", data / "speech_audio", ami) if folder.is_dir()]
    bundled = [] if (data / "facegood_audio_mouth").is_dir() else [data_dir("sim") / "speakers"]
    motions = data_dir("sim") / "listeners" / "motions.npz"
    sounds = [*bundled, *brought, *voices]
    spoken = speaking.dyads(find_voices(sounds), motions, seed, SHARES["speaking"] * minutes)
    conversation = dyads(ami, sounds, motions, seed, SHARES["interaction"] * minutes, "interaction")
    return {
        **_write(dyads(ami, sounds, motions, seed, minutes), out),
        **_named("interaction", _write(conversation, out / "interaction")),
        **_named("speaking", _write(spoken, out / "speaking")),
    }


def _write(made: Iterator[tuple[str, Dyad]], out: Path) -> dict[str, float]:
    """Write a set and remove what an earlier one left; minutes per split."""
    written, fresh = dict.fromkeys(SPLITS, 0.0), set()
    for split, dyad in made:
        save(out / split, [dyad])
        fresh.add(out / split / f"{dyad.name}.npz")
        written[split] += len(dyad.listener) * FRAME_S / 60
    for split in SPLITS:
        for stale in {file for pattern in _FILES for file in (out / split).glob(pattern)} - fresh:
            stale.unlink()
    return written


def _named(scene: str, minutes: Mapping[str, float]) -> dict[str, float]:
    return {f"{scene}_{split}": value for split, value in minutes.items()}


def dyads(
    ami: Path, voices: Sequence[Path], motions: Path, seed: int, minutes: float, scene: Scene = "listening"
) -> Iterator[tuple[str, Dyad]]:
    """The same one by one, as (split, dyad): for sets that need not lie in memory."""
    if not minutes > 0:
        raise ConfigError(f"--minutes {minutes:g}: must be above 0")
    people = split_series(read_people(ami))
    spoken = split_voices(find_voices(voices))
    moves = load_motions(motions)
    for number, split in enumerate(SPLITS):
        rng = np.random.default_rng([seed, number] if scene == "listening" else [seed, number, 1])
        wanted = minutes * (1 if split == "train" else VALIDATION_SHARE)
        annotated = [person for person in people[split] if person.gaze is not None]
        for stretch in choose(stretches(people[split], rng, scene), wanted, rng):
            lender = annotated[int(rng.integers(len(annotated)))] if annotated else None
            voice = cast(spoken[split], rng)
            yield split, compose_one(stretch, lender, voice, own_voice(spoken[split], voice, rng), moves[split], rng)


def cast(voices: Sequence[Voice], rng: np.random.Generator) -> Voice:
    """A voice by lot, mostly one whose mouth was filmed."""
    filmed = rng.random() < _FILMED
    fitting = [voice for voice in voices if (voice.mouth is not None) == filmed] or voices
    return fitting[int(rng.integers(len(fitting)))]


def own_voice(voices: Sequence[Voice], other: Voice, rng: np.random.Generator) -> Voice | None:
    """A filmed voice for the listener, another one than the speaker's if there is one; None: none was filmed."""
    filmed = [voice for voice in voices if voice.mouth is not None]
    fitting = [voice for voice in filmed if voice.name != other.name] or filmed
    return fitting[int(rng.integers(len(fitting)))] if fitting else None


# --- which stretches --------------------------------------------------------------------------------------------


def stretches(people: Sequence[Person], rng: np.random.Generator, scene: Scene = "listening") -> list[Stretch]:
    """Cut everybody's time into pieces of 30 to 60 s; keep those he was seen in and that make the scene.

    Listening: he mostly listens. Interaction: he talks a fifth of the time or more, and so do the others together.
    """
    found = []
    for person in people:
        at = float(rng.uniform(0, LENGTH_S[0]))
        while at + LENGTH_S[1] < person.until_s:
            length = FRAME_S * round(float(rng.uniform(*LENGTH_S)) * FRAME_HZ)
            piece = Stretch(person, at, at + length)
            at += length
            own, others = (active(spans, piece) for spans in (person.talk, person.others))
            listening = listening_mask(others, FRAME_HZ, own)
            listens = own.mean() <= 0.2 and listening.mean() >= 0.6
            converses = own.mean() > 0.2 and others.mean() > 0.2
            if active(person.unseen, piece).any() or not (listens if scene == "listening" else converses):
                continue
            onsets = within(person.nods, piece)[:, 0]
            rate = nods_per_minute(onsets, listening, FRAME_HZ)
            answers = phrase_end_counts(onsets, phrase_ends(others, FRAME_HZ), listening, FRAME_HZ)[0]
            found.append(replace(piece, nods_per_minute=rate, answers=answers))
    return found


def choose(found: Sequence[Stretch], minutes: float, rng: np.random.Generator) -> list[Stretch]:
    """Draw about `minutes` of stretches without repetition, by weight.

    Systematic draw along the nod rate: even a small set has the rates of the large one.
    """
    if not found:
        return []
    ranked = sorted(found, key=lambda stretch: stretch.nods_per_minute)
    weights = np.array([stretch.weight for stretch in ranked])
    mean_s = float(np.average([stretch.frames * FRAME_S for stretch in ranked], weights=weights))
    count = max(1, round(60 * minutes / mean_s))
    spots = (rng.random() + np.arange(count)) / count
    drawn = np.unique(np.searchsorted(np.cumsum(weights) / weights.sum(), spots).clip(max=len(ranked) - 1))
    return [ranked[int(index)] for index in rng.permutation(drawn)]


# --- one dyad ---------------------------------------------------------------------------------------------------


def compose_one(
    stretch: Stretch,
    lender: Person | None,
    voice: Voice,
    own_voice: Voice | None,
    motions: Motions,
    rng: np.random.Generator,
) -> Dyad:
    """One stretch, acted and voiced. `lender` gives his looks where those of this meeting were not annotated."""
    person, frames = stretch.person, stretch.frames
    others, own = active(person.others, stretch), active(person.talk, stretch)
    said, mouth = _own_words(stretch, own_voice, rng.spawn(1)[0])
    score = Score(
        frames,
        nods=within(person.nods, stretch),
        shakes=within(person.shakes, stretch),
        tilts=within(person.tilts, stretch),
        laughs=within(person.laughs, stretch),
        talk=within(person.talk, stretch),
        backchannels=within(person.backchannels, stretch),
        gaze=_looks(stretch, lender, rng),
        shared_laughs=within(person.others_laughs, stretch),
        asked=person.asked[(person.asked > stretch.start_s) & (person.asked < stretch.end_s)] - stretch.start_s,
        ends=phrase_ends(others, FRAME_HZ),
        mouth=mouth,
    )
    heard = labels.Voices(
        own,
        others,
        active(person.backchannels, stretch),
        active(person.others_backchannels, stretch),
        active(person.nods, stretch),
    )
    audio, face = speaker_of(stretch, voice, motions, rng)
    return Dyad(
        stretch.name,
        audio,
        face,
        listener_motion(score, motions, rng),
        listening_mask(others, FRAME_HZ, own),
        agent_audio=said,
        states=labels.label(heard),
    )


def _own_words(stretch: Stretch, voice: Voice | None, rng: np.random.Generator) -> tuple[Floats | None, Floats | None]:
    """The listener's own voice (N * 640,), as a program would send it to a loudspeaker, and its mouth (N, 52)."""
    if voice is None:
        return None, None
    said = np.clip(stretch.person.talk - stretch.start_s, 0, stretch.frames * FRAME_S)
    speech, mouth = lay(said[said[:, 1] > said[:, 0]], stretch.frames, voice, rng)
    return speaking.sent(speech, rng), mouth


def speaker_of(stretch: Stretch, voice: Voice, motions: Motions, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """What is heard and seen of the others: audio (N * 640,), face (N, 58), rows of NaN for a voice without one."""
    said = np.clip(stretch.person.others - stretch.start_s, 0, stretch.frames * FRAME_S)
    speech, mouth = lay(said[said[:, 1] > said[:, 0]], stretch.frames, voice, rng)
    faceless = mouth is None or rng.random() < _FACELESS
    audio = _recorded(speech, voice, rng)
    if mouth is None or faceless:
        return audio, np.full((stretch.frames, MOTION_DIM), np.nan, np.float32)
    return audio, speaker_motion(mouth, motions, rng)


def _recorded(speech: Floats, voice: Voice, rng: np.random.Generator) -> Floats:
    """Speech as some microphone in some room would take it: tilt, gain, noise floor."""
    tilt = np.float32(rng.uniform(-0.3, 0.3))
    heard = speech - tilt * np.concatenate([[0], speech[:-1]]).astype(np.float32)
    gain = np.float32(10 ** (rng.uniform(-10, 6) / 20))
    return np.asarray(np.clip(gain * heard + room(len(speech), voice, rng), -1, 1), np.float32)


def _looks(stretch: Stretch, lender: Person | None, rng: np.random.Generator) -> tuple[tuple[float, float, str], ...]:
    """Looks away from whoever has the floor, in seconds of the stretch, none longer than a few seconds."""
    person = stretch.person
    if person.gaze is None:
        if lender is None:
            return ()
        length = stretch.end_s - stretch.start_s
        begin = float(rng.uniform(0, max(0.0, lender.until_s - length)))
        stretch, person = Stretch(lender, begin, begin + length), lender
    looks = []
    for start, end, target in person.gaze or ():
        if end < stretch.start_s or start > stretch.end_s:
            continue
        where = _where(person, start, end, target)
        if where is not None and rng.random() < _LOOKS:
            end = min(end, start + float(rng.uniform(*_LONGEST_LOOK_S)))
            looks.append((start - stretch.start_s, end - stretch.start_s, where))
    return tuple(looks)


def _where(person: Person, start: float, end: float, target: str) -> str | None:
    """A gaze target as a direction; None for somebody who speaks during the look, or is about to or just has."""
    if len(target) != 1:
        return {"table": "down", "slide-screen": "screen", "whiteboard": "screen"}.get(target, "away")
    heard = any(agent == target and a < end + 1 and b > start - 1 for a, b, agent in person.floor)
    return None if heard else f"side {target}"


def active(spans: Doubles, stretch: Stretch) -> NDArray[np.bool_]:
    """(N,) frames whose middle lies in a span."""
    out = np.zeros(stretch.frames, bool)
    for start, end in spans[(spans[:, 1] > stretch.start_s) & (spans[:, 0] < stretch.end_s)]:
        first, last = (int(np.ceil((t - stretch.start_s) * FRAME_HZ - 0.5)) for t in (start, end))
        out[max(0, first) : max(0, last)] = True
    return out


def within(spans: Doubles, stretch: Stretch) -> Doubles:
    """Spans that begin inside, in seconds of the stretch, with room to be seen before its end."""
    inside = (spans[:, 0] >= stretch.start_s) & (spans[:, 0] < stretch.end_s - 0.5)
    return spans[inside] - stretch.start_s
