"""`evaluate people`: a blind comparison of listeners by people: its clips, its answers, its table.

A study is a folder. `study.json` describes what is compared, `clips/` has each condition's motion to each voice under a
name that does not reveal the condition, and `answers.csv` immediately gets a row for each given answer. If the command
is called again with the same arguments, it resumes the study.

A trial shows two clips of the same voice, left and right, and asks `QUESTIONS` about them. Each participant sees every
pair of conditions with every voice once, in a random order and on random sides. For each pair the table has the share
of the first among the choices, with the exact (Clopper and Pearson) interval and the binomial test against one half;
for three and more conditions also Bradley and Terry's strengths s, by which i is chosen before j with a probability of
1 / (1 + exp(s_j - s_i)). Their intervals draw people with replacement, since answers of one person are dependent; with
one person they are left out.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import secrets
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np
import soundfile
from pydantic import TypeAdapter
from scipy.stats import binomtest

from sfms_robot.app.progress import tracked
from sfms_robot.config import find
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_HZ, FRAME_SAMPLES, Doubles, Floats, SpeakerFrame
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.clips import Split
from sfms_robot.lab.evaluation.intervals import LEVEL, draw_people, ends
from sfms_robot.lab.evaluation.robustness import unseen, voice_folders
from sfms_robot.lab.evaluation.rollout import frames_of_dyad, rollout, speaker_frames, spread, streamable
from sfms_robot.listeners.registry import load_listener, one_thread
from sfms_robot.viewer.page_process import Address
from sfms_robot.viewer.study_server import serve_study

QUESTIONS: Final = {
    "person": "Which listens more like a person?",
    "attentive": "Which is more attentive?",
    "natural": "Which moves more naturally?",
    "in_time": "Which reacts more in time with the voice?",
}
NEITHER: Final = "neither"
RECORDED: Final = "recorded"
_STUDY, _ANSWERS, _CLIPS = "study.json", "answers.csv", "clips"
_WARM_UP: Final = 10 * FRAME_HZ  # frames before the beginning of a clip, since a listener has memory
_HOPS: Final = 997  # difference between the seeds of two voices
_STEPS: Final = 200


@dataclass(frozen=True)
class Trial:
    """Two conditions side by side, and the number of the voice that both hear."""

    trial: int
    voice: int
    left: str
    right: str


@dataclass(frozen=True, kw_only=True)
class Preference:
    """One answer: `chosen` is the value of `left` or `right` (names of conditions), or NEITHER."""

    participant: str
    trial: int
    voice: int
    question: str
    left: str
    right: str
    chosen: str


_COLUMNS: Final = tuple(field.name for field in fields(Preference))
_PREFERENCE: Final = TypeAdapter(Preference)


class Study:
    """A prepared study, answered by one participant after another."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        described = json.loads((folder / _STUDY).read_text(encoding="utf-8"))
        self.conditions: list[str] = described["conditions"]
        self._voices, self._seed = len(described["voices"]), int(described["seed"])
        self._file = folder / _ANSWERS
        self._answers = read_answers(self._file) if self._file.is_file() else []

    @property
    def questions(self) -> Mapping[str, str]:
        return QUESTIONS

    @property
    def clips(self) -> Path:
        return self.folder / _CLIPS

    def begin(self) -> str:
        """Return an anonymous name for a new participant, with which the page can resume later."""
        return secrets.token_hex(6)

    def next(self, participant: str) -> Figures:
        """Return counts of trials and the participant's next trial, if any, whose clips do not reveal conditions."""
        shown = self._trials(participant)
        done = {answer.trial for answer in self._answers if answer.participant == participant}
        left = [trial for trial in shown if trial.trial not in done]
        found: Figures = {"answered": len(shown) - len(left), "trials": len(shown)}
        if left:
            trial = left[0]
            found |= {"trial": trial.trial, "audio": f"voice-{trial.voice}.wav"}
            for side in ("left", "right"):
                found[side] = f"{clip_name(self._seed, getattr(trial, side), trial.voice)}.f32"
        return found

    def answer(self, participant: str, number: int, chosen: Mapping[str, str]) -> None:
        """Store an answer to each question (left, right or neither) before returning.

        Raises ConfigError for an invalid answer, or if it cannot be written.
        """
        shown = self._trials(participant)
        if not 0 <= number < len(shown):
            raise ConfigError(f"trial = {number!r} is not one of this study (0 to {len(shown) - 1})")
        if set(chosen) != set(QUESTIONS) or not set(chosen.values()) <= {"left", "right", NEITHER}:
            raise ConfigError(f"answers: {', '.join(QUESTIONS)} want left, right or {NEITHER} each")
        if any((answer.participant, answer.trial) == (participant, number) for answer in self._answers):
            return  # the answer was sent twice on a bad connection
        trial = shown[number]
        sides = {"left": trial.left, "right": trial.right, NEITHER: NEITHER}
        rows = [
            Preference(participant=participant, question=question, chosen=sides[chosen[question]], **asdict(trial))
            for question in QUESTIONS
        ]
        size = self._file.stat().st_size if self._file.is_file() else 0
        try:
            with self._file.open("a", encoding="utf-8", newline="") as lines:
                table = csv.DictWriter(lines, _COLUMNS)
                if not size:
                    table.writeheader()
                table.writerows(map(asdict, rows))
        except OSError as error:
            with suppress(OSError):
                os.truncate(self._file, size)  # no part of an answer
            raise ConfigError(f"{self._file}: cannot be written: {error.strerror}") from error
        self._answers += rows

    def results(self) -> Figures:
        return summary(self._answers)

    def _trials(self, participant: str) -> list[Trial]:
        return trials(self.conditions, self._voices, self._seed, participant)


def trials(conditions: Sequence[str], voices: int, seed: int, participant: str) -> list[Trial]:
    """Return every pair with every voice, in this participant's order and on this participant's sides."""
    digest = hashlib.sha256(f"{seed} {participant}".encode()).digest()
    rng = np.random.default_rng(list(digest[:8]))
    pairs = [(voice, *pair) for voice in range(voices) for pair in combinations(conditions, 2)]
    shown = []
    for number, place in enumerate(rng.permutation(len(pairs))):
        voice, one, other = pairs[int(place)]
        left, right = (one, other) if rng.random() < 0.5 else (other, one)
        shown.append(Trial(number, voice, left, right))
    return shown


def serve(study: Study, view: str, ready: Callable[[str, int | None], None]) -> None:
    """Serve the page until interrupted. Calls `ready(url, taken port or None)` once. Raises ConfigError, PortError."""
    serve_study(study, Address.parsed(view), ready)


# --- clips ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _StudyVoice:
    """One voice: the listener's input, the sound of the clip, and the recorded listener if there is one."""

    name: str
    frames: Sequence[SpeakerFrame]
    audio: Floats
    recorded: Floats | None


def prepare(
    conditions: Sequence[str], data: Path | None, split: Split, *, voices: int, seconds: float, seed: int, folder: Path
) -> Study:
    """Return the study in `folder`, and make it if it is missing. Blocks for minutes.

    Args:
        conditions: Listeners by name or folder, and RECORDED for the people of `data`.
        data: Composed dyads, or any data set with voices; None: bundled voices.
        split: Split of the data.
        voices: Number of voices; each condition listens to every voice.
        seconds: Length of a clip.
        seed: Seed of the listeners and of the order of trials.
        folder: Folder of the study.

    Raises RobotError.
    """
    described = {
        "version": 1,
        "conditions": list(conditions),
        "weights": _weights(conditions, data),
        "data": data and data.name,
        "split": split,
        "seconds": seconds,
        "asked_voices": voices,
        "seed": seed,
    }
    file, clips = folder / _STUDY, folder / _CLIPS
    if file.is_file():
        found = {"split": "test", **json.loads(file.read_text(encoding="utf-8"))}
        if found != described | {"voices": found.get("voices")}:
            raise ConfigError(f"{file}: another study (other conditions, voices or seed); name another folder (--out)")
        return Study(folder)
    heard = _voices(data, split, voices, round(seconds * FRAME_HZ))
    clips.mkdir(parents=True, exist_ok=True)
    one_thread()
    for condition in tracked(conditions, "clips"):
        listener = None if condition == RECORDED else load_listener(condition)
        for number, each in enumerate(heard):
            motion, length = each.recorded, len(each.audio) // FRAME_SAMPLES
            if listener is not None:
                motion = rollout(listener, each.frames, [seed + _HOPS * number]).motion[0, -length:]
            assert motion is not None  # `_weights` requires data for recorded people
            motion.astype("<f4").tofile(clips / f"{clip_name(seed, condition, number)}.f32")
    for number, each in enumerate(heard):
        soundfile.write(clips / f"voice-{number}.wav", each.audio, AUDIO_HZ, subtype="PCM_16")
    described["voices"] = [each.name for each in heard]
    file.write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    return Study(folder)


def clip_name(seed: int, condition: str, voice: int) -> str:
    """Return a name that does not reveal the condition in the page's requests."""
    return hashlib.sha256(f"{seed} {condition} {voice}".encode()).hexdigest()[:12]


def _weights(conditions: Sequence[str], data: Path | None) -> dict[str, str]:
    """Return the digest of each listener's weights. Raises ConfigError for conditions that cannot be compared."""
    if len(set(conditions)) != len(conditions) or len(conditions) < 2:
        raise ConfigError("--listener: two or more, each once; 'recorded' is what the people of --data did")
    if RECORDED in conditions and data is None:
        raise ConfigError("--listener recorded: needs --data (composed dyads, or a data set)")
    weights = {}
    for name in conditions:
        if name != RECORDED:
            folder = find("listeners", name, "config.yaml")
            load_listener(folder)  # raises its errors here
            weights[name] = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    return weights


def _voices(data: Path | None, split: Split, count: int, length: int) -> list[_StudyVoice]:
    """Return voices of `length` frames, each after a warm-up. Raises ConfigError if there are too few."""
    found: list[_StudyVoice] = []

    def cut(name: str, frames: Sequence[SpeakerFrame], audio: Floats, recorded: Floats | None, end: int) -> None:
        """Add the clip of the last `length` frames before `end`, with the warm-up before it."""
        begin = end - length
        sound = audio[begin * FRAME_SAMPLES : end * FRAME_SAMPLES]
        motion = None if recorded is None else recorded[begin:end]
        found.append(_StudyVoice(name, frames[max(0, begin - _WARM_UP) : end], sound, motion))

    if data is not None:
        for dyad in streamable(data, split):
            if dyad.audio is not None and len(dyad.speaker) >= length:
                end = min(len(dyad.speaker), length + _WARM_UP)
                cut(dyad.name, frames_of_dyad(dyad), dyad.audio, dyad.listener, end)
    else:  # consecutive pieces of the bundled voices
        for speaker in unseen(voice_folders(None), split):
            frames = speaker_frames(speaker.voice, speaker.face, attention=np.ones(len(speaker.face), np.float32))
            for end in range(length, len(frames) + 1, length):
                cut(f"{speaker.name} {(end - length) / FRAME_HZ:.0f} s", frames, speaker.voice, None, end)
    if len(found) < count:
        raise ConfigError(f"--voices {count}: there are {len(found)} of {length / FRAME_HZ:g} s or more")
    return spread(found, count)


# --- answers --------------------------------------------------------------------------------------------------------


def read_answers(file: Path) -> list[Preference]:
    """Read answers; an empty file has none. Raises ConfigError with the line of the file."""
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            rows = csv.DictReader(lines)
            if tuple(rows.fieldnames or _COLUMNS) != _COLUMNS:
                raise ConfigError(f"{file}: not answers of a comparison: its columns are not {', '.join(_COLUMNS)}")
            return [_answer(file, number, row) for number, row in enumerate(rows, start=2)]
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error


def _answer(file: Path, line: int, row: Mapping[str, str | None]) -> Preference:
    try:
        answer = _PREFERENCE.validate_python({key: value for key, value in row.items() if value is not None})
    except ValueError as error:
        raise ConfigError(f"{file}: line {line} is not an answer: {error}") from error
    if answer.question not in QUESTIONS:
        raise ConfigError.at(file, f"line {line}: question", answer.question, "is not a question", QUESTIONS)
    if answer.chosen not in (choices := (answer.left, answer.right, NEITHER)):
        raise ConfigError.at(file, f"line {line}: chosen", answer.chosen, "is not a choice", choices)
    return answer


def summary(answers: Sequence[Preference]) -> Figures:
    """Return per question and pair of conditions: counts, share of the first, interval, p; and strengths."""
    conditions = sorted({name for answer in answers for name in (answer.left, answer.right)})
    rows, strengths = [], {}
    for question in QUESTIONS:
        asked = [answer for answer in answers if answer.question == question]
        rows += [_pair(question, first, second, asked) for first, second in combinations(conditions, 2)]
        if len(conditions) > 2 and asked:
            strengths[question] = _strengths(conditions, asked)
    chosen = [answer for answer in answers if answer.chosen != NEITHER]
    left = sum(answer.chosen == answer.left for answer in chosen)
    return {
        "participants": len({answer.participant for answer in answers}),
        "answers": len(answers),
        "conditions": conditions,
        "rows": [row for row in rows if row["answers"]],
        "bradley_terry": strengths,
        "sides": {"left": left, "right": len(chosen) - left},  # far from even if people did not look
    }


def _pair(question: str, first: str, second: str, asked: Sequence[Preference]) -> Figures:
    here = [answer for answer in asked if {answer.left, answer.right} == {first, second}]
    wins = [sum(answer.chosen == name for answer in here) for name in (first, second)]
    row: Figures = {
        "question": question, "first": first, "second": second, "answers": len(here), "first_chosen": wins[0],
        "second_chosen": wins[1], "neither": len(here) - sum(wins), "share": None, "interval": None, "p": None,
    }  # fmt: skip
    if sum(wins):
        test = binomtest(wins[0], sum(wins), 0.5)
        interval = [*map(float, test.proportion_ci(LEVEL, method="exact"))]
        row |= {"share": wins[0] / sum(wins), "interval": interval, "p": float(test.pvalue)}
    return row


def _strengths(conditions: Sequence[str], asked: Sequence[Preference]) -> dict[str, Figures]:
    people = sorted({answer.participant for answer in asked})
    wins = np.zeros((len(people), len(conditions), len(conditions)))
    for answer in asked:
        place = people.index(answer.participant)
        for better, worse in ((answer.left, answer.right), (answer.right, answer.left)):
            share = 0.5 if answer.chosen == NEITHER else float(answer.chosen == better)
            wins[place, conditions.index(better), conditions.index(worse)] += share
    value, interval = bradley_terry(wins.sum(axis=0)), None
    if len(people) > 1:
        drawn = draw_people(len(people), 0)
        interval = ends(np.array([bradley_terry(np.tensordot(counts, wins, axes=1)) for counts in drawn])).T.tolist()
    return {
        name: {"strength": float(value[place]), "interval": interval and interval[place]}
        for place, name in enumerate(conditions)
    }


def bradley_terry(wins: Doubles) -> Doubles:
    """Return log strengths (K,) with mean 0 of wins (K, K), row before column, by Hunter's minorization (2004)."""
    padded = wins + 0.5 * (1 - np.eye(len(wins)))  # half a win each way: strengths stay finite if one always wins
    met, won = padded + padded.T, padded.sum(axis=1)
    strength = np.ones(len(wins))
    for _ in range(_STEPS):
        strength = won / (met / (strength[:, None] + strength[None, :])).sum(axis=1)
        strength /= np.exp(np.log(strength).mean())
    return np.log(strength)
