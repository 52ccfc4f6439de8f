"""Composed dyads: real timing and real movement, combined here.

These parts are recorded: the times at which a listener nods, laughs or says "mm-hm" while others talk, at which the
others talk and pause, laugh and nod, and look at the listener (AMI meeting annotations); the movement of a nod, a
blink, a smile (recordings, `motions`); the sound of speech (`voices`). Their combination is ours: the voice says other
words than were said in the meeting, only its phrases begin and end at the same times. Meetings, people, takes and
voices kept for validation and test are kept whole (`clips.SERIES`).

All others of a meeting become one speaker. The person with the floor sits straight ahead and looks at the listener
where this is annotated; without annotated gaze the speaker looks at random and `Dyad.attention` is unknown. It is also
unknown while no face is seen. Faces and microphones differ from dyad to dyad. If the listener's gaze was not annotated,
looks are drawn from the durations in the training split (`speaking.Dwell`); their order is ours, not recorded.

Stretches with nods, above all at the end of a phrase, and those in which the listener is addressed are drawn more often
than they occur in the meetings; a set of enough minutes contains every stretch once.

A listener's own words also get a voice, one whose mouth was filmed, and the mouth that belongs to it. Two more sets
serve models that speak: `interaction`, stretches in which the person talks a good share of the time, and `speaking`,
the filmed recordings themselves (`speaking.py`). Each is a separate data set, in a folder of that name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal

import numpy as np

from sfms_robot.app.progress import Progress, no_progress
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_S, MOTION_DIM, POSE, SHAPES, Bools, Doubles, Floats, clip_shapes
from sfms_robot.lab.corpora.clips import SPLITS, Dyad, Split, save
from sfms_robot.lab.corpora.compose import speaking
from sfms_robot.lab.corpora.compose.ami import (
    LabelledSpan,
    MeetingPerson,
    interval_table,
    read_people,
    split_series,
)
from sfms_robot.lab.corpora.compose.motions import Rng, first_frame, pick
from sfms_robot.lab.corpora.compose.render_events import Score, act, speaker_motion
from sfms_robot.lab.corpora.compose.speaking import Dwell, away, learn_dwell
from sfms_robot.lab.corpora.compose.voices import (
    VOICE_FOLDERS,
    VoiceClip,
    find_laughter,
    find_voices,
    laugh,
    lay,
    mouth_over,
    reverberant,
    room,
    split_voices,
)
from sfms_robot.lab.corpora.conversational_states import states_of
from sfms_robot.lab.corpora.phrase_timing import listening_mask, nods_per_minute, phrase_end_counts, phrase_ends
from sfms_robot.processes import process_pool
from sfms_robot.signals import event_sizes as sizes
from sfms_robot.signals.motion_primitives import Motions, read_motions

LENGTH_S: Final = (30.0, 60.0)
HELD_OUT_SHARE: Final = 1 / 6  # of the training minutes, for validation and for test
Scene = Literal["listening", "interaction"]
SetName = Scene | Literal["speaking"]
# Minutes of each set, per minute of listening.
SHARES: Final[Mapping[SetName, float]] = {"listening": 1.0, "interaction": 0.5, "speaking": 0.25}
_FILMED: Final = 0.4  # share of dyads with a voice whose mouth was recorded
_FACELESS: Final = 0.25  # share of dyads in which the speaker is heard but not seen
_FLOOR_S: Final = 1.0  # a shorter phrase does not take the floor
# Of a stretch: base, most for nods a minute, each nod after a phrase, most such nods, share of addressed time.
_WEIGHTS: Final = (4.0, 3.0, 2.0, 3, 100.0)

_FILES: Final = ("*_[A-Z]_[0-9][0-9][0-9][0-9].npz", speaking.FILES)  # the first: by Stretch.name


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A piece of a meeting with one person as the listener.

    Attributes:
        nods_per_minute: nods per minute of listening time.
        answers: number of nods that begin 0 to 0.8 s after the end of a phrase.
        addressed: share of the time in which the person with the floor is known to look at the listener.
    """

    person: MeetingPerson
    start_s: float
    end_s: float
    nods_per_minute: float = 0.0
    answers: int = 0
    addressed: float = 0.0

    @property
    def weight(self) -> float:
        """Return the weight of the stretch when stretches are drawn.

        It grows with nods, with nods at the end of a phrase, and with the time in which the listener is addressed.
        """
        base, most, answer, answers, addressed = _WEIGHTS
        nods = min(self.nods_per_minute, most) + answer * min(self.answers, answers)
        return base + nods + addressed * self.addressed

    @property
    def frames(self) -> int:
        return round((self.end_s - self.start_s) * FRAME_HZ)

    @property
    def name(self) -> str:
        return f"{self.person.meeting}_{self.person.agent}_{int(self.start_s):04d}"


@dataclass(frozen=True, kw_only=True)
class Material:
    """Recordings and annotations that the dyads of one split are made of."""

    people: Sequence[MeetingPerson]
    voices: Sequence[VoiceClip]
    laughter: Sequence[Floats]
    motions: Motions
    dwell: Dwell


def compose_folder(
    data: Path,
    out: Path,
    seed: int,
    minutes: float,
    moved: Progress = no_progress,
    overwrite: bool = False,
    jobs: int = 1,
) -> dict[str, float]:
    """Compose from `data` (AMI tables in it or in its ami_listener_annotations/) into out/train, validation and test.

    Two further sets of the same form go into out/interaction and out/speaking; without a filmed voice, `speaking` is
    empty.

    Voices are the bundled speakers, unless `data` has a facegood_audio_mouth/, and those found in `data`
    (facegood_audio_mouth/, speech_audio/, conversation_audio/, ami_audio_clips/, the clips in the folder of the
    tables). Two sets never mix: if `out` holds dyads of an earlier run, ConfigError is raised, or, with `overwrite`,
    they are removed once the new ones are written. `moved` is called after every dyad, with the minutes written of its
    set and those wanted. `jobs`: number of processes. Each part, a split of a set, has its own random numbers, so the
    files are the same with any number. Returns the minutes written per split. Raises ConfigError.
    """
    parts = [
        Part(name, split, (out if name == "listening" else out / name) / split, share * minutes)
        for name, share in SHARES.items()
        for split in SPLITS
    ]
    if not overwrite and (earlier := sorted(_composed(parts))):
        raise ConfigError(
            f"--out {out}: holds dyads already, {earlier[0].name} among {len(earlier)}: another folder, or --overwrite"
        )
    written: dict[Part, dict[Path, float]] = {part: {} for part in parts}
    done = dict.fromkeys(SHARES, 0.0)
    for part, file, minute in _written(data, parts, seed, jobs):
        written[part][file] = minute
        done[part.name] += minute
        wanted = part.minutes * (1 + 2 * HELD_OUT_SHARE)
        moved(done[part.name], wanted, f"{part.name}, {done[part.name]:.0f} of {wanted:.0f} minutes")
    for stale in _composed(parts).difference(*written.values()):
        stale.unlink()
    return {
        part.split if part.name == "listening" else f"{part.name}_{part.split}": sum(files.values())
        for part, files in written.items()
    }


@dataclass(frozen=True)
class Part:
    """A split of a set, its folder, and the minutes wanted of the training split."""

    name: SetName
    split: Split
    folder: Path
    minutes: float

    def write(self, data: Path, seed: int) -> Iterator[tuple[Part, Path, float]]:
        """Write the dyads of the part; yield the file and minutes of each."""
        for dyad in dyads(material_of(data), self.name, self.split, seed, self.minutes):
            save(self.folder, [dyad])
            yield self, self.folder / f"{dyad.name}.npz", len(dyad.listener) * FRAME_S / 60


def _written(data: Path, parts: Sequence[Part], seed: int, jobs: int) -> Iterator[tuple[Part, Path, float]]:
    """Yield each dyad once it is written: its part, file and minutes; with several jobs, part by part."""
    if jobs == 1:
        for part in parts:
            yield from part.write(data, seed)
        return
    with process_pool(min(jobs, len(parts))) as pool:
        largest = sorted(parts, key=lambda part: (part.split != "train", -part.minutes))
        for ended in as_completed([pool.submit(_whole_part, data, part, seed) for part in largest]):
            yield from ended.result()


def _whole_part(data: Path, part: Part, seed: int) -> list[tuple[Part, Path, float]]:
    """Write a part, in a process of a pool."""
    return [*part.write(data, seed)]


@lru_cache(maxsize=1)
def material_of(data: Path) -> dict[Split, Material]:
    """Return the material by split, of a folder and bundled: AMI tables, voices, primitives. Raises ConfigError."""
    ami = data / "ami_listener_annotations" if (data / "ami_listener_annotations").is_dir() else data
    brought = [folder for folder in (*(data / name for name in VOICE_FOLDERS), ami) if folder.is_dir()]
    bundled = [] if (data / "facegood_audio_mouth").is_dir() else [data_dir("sim") / "speakers"]
    people, folders = split_series(read_people(ami)), [*bundled, *brought]
    voices, laughter = split_voices(find_voices(folders)), find_laughter(folders)
    motions, dwell = read_motions(data_dir("sim") / "listeners" / "motions.npz"), learn_dwell(people["train"])
    return {
        split: Material(
            people=people[split], voices=voices[split], laughter=laughter[split], motions=motions[split], dwell=dwell
        )
        for split in SPLITS
    }


def _composed(parts: Sequence[Part]) -> set[Path]:
    """Return every dyad that a run has written to the folders of these parts."""
    return {file for part in parts for pattern in _FILES for file in part.folder.glob(pattern)}


def dyads(material: Mapping[Split, Material], name: SetName, split: Split, seed: int, minutes: float) -> Iterator[Dyad]:
    """Yield the dyads of one split of a set, one by one, so that the set need not fit in memory.

    `minutes`: of the training split. Without filmed voices, the set `speaking` is empty. Raises ConfigError.
    """
    if not minutes > 0:
        raise ConfigError(f"--minutes {minutes:g}: must be above 0")
    number, own = SPLITS.index(split), material[split]
    wanted = minutes * (1 if split == "train" else HELD_OUT_SHARE)
    if name == "speaking":
        yield from speaking.dyads(own.voices, own.motions, own.dwell, [seed, number, 2], wanted)
        return
    rng = np.random.default_rng([seed, number] if name == "listening" else [seed, number, 1])
    for stretch in choose(stretches(own.people, rng, name), wanted, rng):
        yield compose_one(stretch, own, rng)


def cast(voices: Sequence[VoiceClip], rng: Rng) -> VoiceClip:
    """Draw a voice, often one whose mouth was filmed."""
    filmed = rng.random() < _FILMED
    fitting = [voice for voice in voices if (voice.mouth is not None) == filmed] or voices
    return pick(fitting, rng)


def own_voice(voices: Sequence[VoiceClip], other: VoiceClip, rng: Rng) -> VoiceClip | None:
    """Draw a filmed voice for the listener, if possible not the speaker's; None if no voice was filmed."""
    filmed = [voice for voice in voices if voice.mouth is not None]
    fitting = [voice for voice in filmed if voice.name != other.name] or filmed
    return pick(fitting, rng) if fitting else None


# --- choice of stretches ----------------------------------------------------------------------------------------


def stretches(people: Sequence[MeetingPerson], rng: Rng, scene: Scene = "listening") -> list[Stretch]:
    """Cut the time of each person into pieces of 30 to 60 s; keep those on camera that fit the scene.

    Listening: the person mostly listens. Interaction: the person talks at least a fifth of the time, and so do the
    others.
    """
    found = []
    for person in people:
        at = rng.uniform(0, LENGTH_S[0])
        while at + LENGTH_S[1] < person.until_s:
            length = FRAME_S * round(rng.uniform(*LENGTH_S) * FRAME_HZ)
            piece = Stretch(person=person, start_s=at, end_s=at + length)
            at += length
            own, others = (active(spans, piece) for spans in (person.talk, person.others))
            listening = listening_mask(others, own)
            listens = own.mean() <= 0.2 and listening.mean() >= 0.6
            converses = own.mean() > 0.2 and others.mean() > 0.2
            if active(person.unseen, piece).any() or not (listens if scene == "listening" else converses):
                continue
            onsets = within(person.nods, piece)[:, 0]
            rate = nods_per_minute(onsets, listening)
            answers = phrase_end_counts(onsets, phrase_ends(others), listening)[0]
            addressed = float((others & (attention_of(piece) == 1)).mean())
            found.append(replace(piece, nods_per_minute=rate, answers=answers, addressed=addressed))
    return found


def choose(found: Sequence[Stretch], minutes: float, rng: Rng) -> list[Stretch]:
    """Draw about `minutes` of stretches without repetition, by weight; all of them if they last no longer.

    The draw is systematic along the nod rate, so that even a small set has the nod rates of the large one.
    """
    if not found:
        return []
    ranked = sorted(found, key=lambda stretch: stretch.nods_per_minute)
    weights = np.array([stretch.weight for stretch in ranked])
    lengths = np.array([stretch.frames * FRAME_S / 60 for stretch in ranked])
    low, high = 0.0, 1 / weights.min()  # bounds of the factor of the weights; chances are at most 1
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if (np.minimum(1, middle * weights) * lengths).sum() < minutes else (low, middle)
    chances = np.minimum(1, high * weights)
    if chances.sum() < 1:  # less than one stretch is wanted
        chances = chances / chances.sum()
    spots = np.floor(np.cumsum(chances) + rng.random())
    drawn = np.flatnonzero(np.diff(spots, prepend=0.0) >= 1)
    return [ranked[index] for index in rng.permutation(drawn)]


# --- one dyad ---------------------------------------------------------------------------------------------------


def compose_one(stretch: Stretch, material: Material, rng: Rng) -> Dyad:
    """Return one stretch as a dyad: choose its voices, render its motion and its sound."""
    person, frames = stretch.person, stretch.frames
    voice = cast(material.voices, rng)
    others, own = active(person.others, stretch), active(person.talk, stretch)
    spoken, speaking_rng = own_voice(material.voices, voice, rng), rng.spawn(1)[0]
    said = mouth = None
    if spoken is not None:
        speech, mouth = _laid(person.talk, stretch, spoken, speaking_rng)
        said = speaking.sent(speech, speaking_rng)
    if person.gaze is None:
        looks = material.dwell.looks(frames * FRAME_S, rng)
    else:
        kept = away(person, stretch.start_s, stretch.end_s, rng)
        looks = tuple((start - stretch.start_s, end - stretch.start_s, where) for start, end, where in kept)
    score = Score(
        frames=frames,
        nods=within(person.nods, stretch),
        shakes=within(person.shakes, stretch),
        tilts=within(person.tilts, stretch),
        laughs=within(person.laughs, stretch),
        talk=within(person.talk, stretch),
        backchannels=within(person.backchannels, stretch),
        mm_hms=within(person.mm_hms, stretch),
        gaze=looks,
        shared_laughs=within(person.others_laughs, stretch),
        asked=person.asked[(person.asked > stretch.start_s) & (person.asked < stretch.end_s)] - stretch.start_s,
        ends=phrase_ends(others),
        mouth=mouth,
    )
    smiling = rng.spawn(1)[0]
    smiles = sizes.others_smiles(frames * FRAME_S, smiling)
    audio, face = speaker_of(stretch, voice, material.motions, rng, material.laughter, smiles)
    faced = np.asarray(np.isfinite(face).all(axis=1))
    seen_smiles = smiles[faced[(smiles[:, 0] * FRAME_HZ).astype(int)]]
    acted = act(score._replace(smiles=sizes.returned(seen_smiles, smiling)), material.motions, rng)
    return Dyad(
        name=stretch.name,
        audio=audio,
        speaker=face,
        listener=acted.motion,
        listening=listening_mask(others, own),
        agent_audio=said,
        states=states_of(
            own,
            others,
            *(active(each, stretch) for each in (person.backchannels, person.others_backchannels, person.nods)),
        ),
        events=acted.events,
        head_of_gaze_rad=acted.head_of_gaze_rad,
        attention=np.where(faced, attention_of(stretch), np.nan).astype(np.float32),
    )


def _laid(spans: Doubles, stretch: Stretch, voice: VoiceClip, rng: Rng) -> tuple[Floats, Floats | None]:
    """Return sound and mouth (`voices.lay`) of a voice that speaks in spans (K, 2) of the meeting."""
    said = np.clip(spans - stretch.start_s, 0, stretch.frames * FRAME_S)
    return lay(said[said[:, 1] > said[:, 0]], stretch.frames, voice, rng)


def speaker_of(
    stretch: Stretch,
    voice: VoiceClip,
    motions: Motions,
    rng: Rng,
    laughter: Sequence[Floats],
    smiles: Doubles,
) -> tuple[Floats, Floats]:
    """Return sound and face of the others: audio (N * 640,), face (N, 58), rows of NaN where no face is seen.

    `smiles`: (K, 3) start, end [s] and size of the others' smiles, in addition to those of laughs.
    """
    person, frames = stretch.person, stretch.frames
    speech, mouth = _laid(person.others, stretch, voice, rng)
    laughs, nods = within(person.others_laughs, stretch), within(spans_by(person.others_nods), stretch)
    audio = heard(laugh(speech, laughs, laughter, rng), voice, rng)
    if rng.random() < _FACELESS:
        return audio, np.full((frames, MOTION_DIM), np.nan, np.float32)
    moving = mouth_over(speech, motions.talk, frames, rng) if mouth is None else mouth
    return audio, seen(speaker_motion(moving, motions, rng, attention_of(stretch), laughs, nods, smiles), rng)


def attention_of(stretch: Stretch) -> Floats:
    """Return (N,) 1 where the person with the floor looks at the listener, 0 where not, NaN if not annotated.

    The floor belongs to the person who began the latest phrase of a second or more.
    """
    person = stretch.person
    holder = np.full(stretch.frames, "", dtype="<U1")
    for start, _, agent in (phrase for phrase in person.floor if phrase[1] - phrase[0] >= _FLOOR_S):
        if start >= stretch.end_s:
            break
        holder[max(0, first_frame(start - stretch.start_s)) :] = agent
    out = np.full(stretch.frames, np.nan, np.float32)
    for agent in person.gaze_known:
        looks = active(spans_by(person.looked_at, agent), stretch)
        out[holder == agent] = looks[holder == agent]
    return out


def spans_by(told: Sequence[LabelledSpan], agent: str | None = None) -> Doubles:
    """Return the spans (K, 2) of one agent, or of all agents."""
    return interval_table((a, b) for a, b, who in told if agent in (None, who))


def active(spans: Doubles, stretch: Stretch) -> Bools:
    """Return a mask (N,) of the frames whose middle lies in a span."""
    out = np.zeros(stretch.frames, bool)
    for start, end in spans[(spans[:, 1] > stretch.start_s) & (spans[:, 0] < stretch.end_s)]:
        first, last = (int(np.ceil((t - stretch.start_s) * FRAME_HZ - 0.5)) for t in (start, end))
        out[max(0, first) : max(0, last)] = True
    return out


def within(spans: Doubles, stretch: Stretch) -> Doubles:
    """Return the spans that begin in the stretch, 0.5 s or more before its end, in seconds from its start."""
    inside = (spans[:, 0] >= stretch.start_s) & (spans[:, 0] < stretch.end_s - 0.5)
    return spans[inside] - stretch.start_s


# --- A speaker as recorded by some microphone in some room and by some face tracker -------------------------------
#
# These differences say nothing about the person: a listener trained on many of them learns to ignore them.

_CLOSE: Final = 0.4  # share of microphones that record no reverberation
_GAIN_DB: Final = (-14.0, 8.0)
_TILT: Final = (-0.4, 0.5)
_LOST: Final = 0.4  # share of trackers that lose a face now and then
_LOST_A_MINUTE: Final = 2.0
_LOST_S: Final = (0.3, 3.0)


def heard(speech: Floats, voice: VoiceClip, rng: Rng) -> Floats:
    """Return speech (n,) with reverberation, spectral tilt, gain and noise floor."""
    direct = speech if rng.random() < _CLOSE else reverberant(speech, rng)
    tilt = np.float32(rng.uniform(*_TILT))
    toned = direct - tilt * np.concatenate([[0], direct[:-1]]).astype(np.float32)
    gain = np.float32(10 ** (rng.uniform(*_GAIN_DB) / 20))
    return np.asarray(np.clip(gain * toned + room(len(speech), voice, rng), -1, 1), np.float32)


def seen(motion: Floats, rng: Rng) -> Floats:
    """Return a face (N, 58) with a tracker's offset, scale and noise; rows of NaN while it is lost."""
    frames = len(motion)
    out = motion.copy()
    stands = np.concatenate([np.deg2rad(rng.normal(0, 5, 3)), rng.normal(0, 0.05, 3)])
    shakes = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02]) * np.deg2rad(rng.uniform(0.05, 0.3))  # metres: under 0.1 mm
    out[:, POSE] += stands + shakes * rng.standard_normal((frames, 6))
    shapes = out[:, SHAPES]
    rests = np.maximum(0, rng.normal(0, 0.05, shapes.shape[1]))
    shapes *= rng.uniform(0.85, 1.1)
    shapes += rests + rng.uniform(0.002, 0.012) * rng.standard_normal(shapes.shape)
    clip_shapes(out)
    if rng.random() < _LOST:
        for start in rng.uniform(0, frames, rng.poisson(_LOST_A_MINUTE * frames / FRAME_HZ / 60)):
            out[int(start) : int(start + rng.uniform(*_LOST_S) * FRAME_HZ)] = np.nan
    return out
