"""`evaluate people`: a blind comparison of listeners by people, its clips, its answers, its table.

A study is a folder: `study.json` says what is compared, `clips/` holds each condition's motion to each voice under a
name that does not tell which, `answers.csv` gets a row per answer as it is given. Called again with the same arguments
it goes on.
"""

from __future__ import annotations

import csv
import hashlib
import json
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import soundfile
from rich.console import Console
from rich.progress import Progress

from sfms_robot.config import find
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_HZ, FRAME_SAMPLES, Floats, SpeakerFrame
from sfms_robot.lab.corpora.collection import usable
from sfms_robot.lab.corpora.conversion import at_frame_rate
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.evaluate.unseen_speakers import unseen, voice_folders
from sfms_robot.lab.evaluation.preferences import NEITHER, QUESTIONS, Preference, Trial, summary, trials
from sfms_robot.lab.evaluation.rollout import frames_of_dyad, rollout, speaker_frames
from sfms_robot.listeners.registry import load_listener, one_thread

RECORDED: Final = "recorded"
STUDY_FILE, ANSWERS_FILE, CLIPS = "study.json", "answers.csv", "clips"
_COLUMNS: Final = tuple(field.name for field in fields(Preference))
_WARM_UP_S: Final = 10.0  # heard before a clip begins: a listener remembers
_HOPS: Final = 997  # between the seeds of voices


@dataclass(frozen=True)
class StudyOptions:
    """The flags of `evaluate people`.

    Attributes:
        conditions: listeners by name or folder, and RECORDED for what the people of `data` did.
        data: composed dyads, or any data set with voices; None: the bundled voices that nobody was trained on.
    """

    conditions: Sequence[str]
    data: Path | None
    voices: int
    seconds: float
    seed: int
    folder: Path


@dataclass(frozen=True)
class _Heard:
    """One voice: what a listener gets, the sound alone, and the recorded listener where there is one."""

    name: str
    frames: Sequence[SpeakerFrame]
    audio: Floats
    recorded: Floats | None


class Study:
    """A study that people take part in, one answer after the other. Raises ConfigError for what nobody could answer."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        told = json.loads((folder / STUDY_FILE).read_text(encoding="utf-8"))
        self.conditions: list[str] = told["conditions"]
        self._voices, self._seed = len(told["voices"]), int(told["seed"])
        self._answers = read_answers(folder / ANSWERS_FILE) if (folder / ANSWERS_FILE).is_file() else []

    @property
    def questions(self) -> Mapping[str, str]:
        return QUESTIONS

    @property
    def clips(self) -> Path:
        return self.folder / CLIPS

    def begin(self) -> str:
        """Somebody takes part: a name by which the page goes on later. It tells nothing of who it is."""
        return secrets.token_hex(6)

    def next(self, participant: str) -> dict[str, Any]:
        """What this person is to see now: clips without their conditions' names, or that all is answered."""
        shown = self._trials(participant)
        done = {answer.trial for answer in self._answers if answer.participant == participant}
        left = [trial for trial in shown if trial.number not in done]
        told: dict[str, Any] = {"answered": len(shown) - len(left), "trials": len(shown)}
        if left:
            names = {side: clip_name(self._seed, getattr(left[0], side), left[0].voice) for side in ("left", "right")}
            told |= {"trial": left[0].number, "audio": f"voice-{left[0].voice}.wav"}
            told |= {side: f"{name}.f32" for side, name in names.items()}
        return told

    def answer(self, participant: str, number: int, chosen: Mapping[str, str]) -> None:
        """`chosen`: question -> left, right or neither, each question once. Written before this returns."""
        trial = next((trial for trial in self._trials(participant) if trial.number == number), None)
        if trial is None:
            raise ConfigError(
                f"trial = {number!r} is not one of this study (0 to {len(self._trials(participant)) - 1})"
            )
        if set(chosen) != set(QUESTIONS) or not set(chosen.values()) <= {"left", "right", NEITHER}:
            raise ConfigError(f"answers: {', '.join(QUESTIONS)} want left, right or {NEITHER} each")
        if any((answer.participant, answer.trial) == (participant, number) for answer in self._answers):
            return  # the page asked twice, on a bad line
        sides = {"left": trial.left, "right": trial.right, NEITHER: NEITHER}
        rows = [
            Preference(participant, number, trial.voice, question, trial.left, trial.right, sides[chosen[question]])
            for question in QUESTIONS
        ]
        append_answers(self.folder / ANSWERS_FILE, rows)
        self._answers += rows

    def results(self) -> dict[str, Any]:
        return summary(self._answers)

    def _trials(self, participant: str) -> list[Trial]:
        return trials(self.conditions, self._voices, self._seed, participant)


def prepare(options: StudyOptions) -> Study:
    """The study in `options.folder`, made where it is not there yet. Blocks for minutes. Raises RobotError."""
    told = _described(options)
    file = options.folder / STUDY_FILE
    if file.is_file():
        if json.loads(file.read_text(encoding="utf-8")) != told | {"voices": _voice_names(file)}:
            raise ConfigError(f"{file}: another study (other conditions, voices or seed); name another folder (--out)")
        return Study(options.folder)
    heard = _heard(options)
    clips = options.folder / CLIPS
    clips.mkdir(parents=True, exist_ok=True)
    one_thread()
    with Progress(console=Console(stderr=True)) as progress:
        for condition in progress.track(options.conditions, description="clips"):
            for number, motion in enumerate(_motions(condition, heard, options)):
                motion.astype("<f4").tofile(clips / f"{clip_name(options.seed, condition, number)}.f32")
    for number, each in enumerate(heard):
        soundfile.write(clips / f"voice-{number}.wav", each.audio, AUDIO_HZ, subtype="PCM_16")
    file.write_text(json.dumps(told | {"voices": [each.name for each in heard]}, indent=1) + "\n", encoding="utf-8")
    return Study(options.folder)


def clip_name(seed: int, condition: str, voice: int) -> str:
    """Says nothing of the condition to who looks at the page's requests."""
    return hashlib.sha256(f"{seed} {condition} {voice}".encode()).hexdigest()[:12]


def read_answers(file: Path) -> list[Preference]:
    """Raises ConfigError of one line that names the line of the file."""
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            rows = csv.DictReader(lines)
            if tuple(rows.fieldnames or ()) != _COLUMNS:
                raise ConfigError(f"{file}: not answers of a comparison: its columns are not {', '.join(_COLUMNS)}")
            return [_answer(file, number, row) for number, row in enumerate(rows, start=2)]
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error


def _answer(file: Path, line: int, row: Mapping[str, str | None]) -> Preference:
    try:
        values: dict[str, Any] = {key: value for key, value in row.items() if value is not None}
        answer = Preference(**values | {"trial": int(values["trial"]), "voice": int(values["voice"])})
    except (TypeError, ValueError, KeyError) as error:
        raise ConfigError(f"{file}: line {line} is not an answer: {error}") from error
    if answer.question not in QUESTIONS:
        raise ConfigError.at(file, f"line {line}: question", answer.question, "is not asked", QUESTIONS)
    if answer.chosen not in (choices := (answer.left, answer.right, NEITHER)):
        raise ConfigError.at(file, f"line {line}: chosen", answer.chosen, "was not to choose", choices)
    return answer


def append_answers(file: Path, answers: Sequence[Preference]) -> None:
    """Raises ConfigError where it cannot be written."""
    try:
        new = not file.is_file()
        with file.open("a", encoding="utf-8", newline="") as lines:
            rows = csv.DictWriter(lines, _COLUMNS)
            if new:
                rows.writeheader()
            rows.writerows(asdict(answer) for answer in answers)
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error.strerror}") from error


def _described(options: StudyOptions) -> dict[str, Any]:
    """What makes a study this one and no other; listeners by their weights too."""
    if len(set(options.conditions)) != len(options.conditions) or len(options.conditions) < 2:
        raise ConfigError("--listener: two or more, each once; 'recorded' is what the people of --data did")
    if RECORDED in options.conditions and options.data is None:
        raise ConfigError("--listener recorded: --data says whose motion (composed dyads, or a data set)")
    weights = {}
    for name in options.conditions:
        if name != RECORDED:
            folder = find("listeners", name, "config.yaml")
            load_listener(folder)  # what is wrong with it is said here
            weights[name] = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    return {
        "version": 1,
        "conditions": list(options.conditions),
        "weights": weights,
        "data": None if options.data is None else options.data.name,
        "seconds": options.seconds,
        "asked_voices": options.voices,
        "seed": options.seed,
    }


def _voice_names(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8")).get("voices")


def _heard(options: StudyOptions) -> list[_Heard]:
    """The voices, each cut to warm-up and clip. Raises ConfigError where there are too few."""
    length = round(options.seconds * FRAME_HZ)
    found = _of_data(options.data, length) if options.data is not None else _bundled(length)
    if len(found) < options.voices:
        raise ConfigError(f"--voices {options.voices}: there are {len(found)} of {options.seconds:g} s or more")
    places = np.linspace(0, len(found) - 1, options.voices).round().astype(int)
    return [found[place] for place in places]


def _bundled(length: int) -> list[_Heard]:
    """Pieces of the shipped voices that no listener was trained on, one behind the other."""
    found = []
    for speaker in unseen(voice_folders(None)):
        count = len(speaker.voice) // FRAME_SAMPLES
        face = np.full((count, 58), np.nan, np.float32) if speaker.face is None else speaker.face[:count]
        frames = speaker_frames(speaker.voice, face, attention=np.ones(count, np.float32))
        for end in range(length, count + 1, length):
            name = f"{speaker.name} {(end - length) / FRAME_HZ:.0f} s"
            found.append(_cut(name, frames, speaker.voice, None, end, length))
    return found


def _of_data(data: Path, length: int) -> list[_Heard]:
    found = []
    for dyad in map(at_frame_rate, usable(open_for("arkit58", data, "test"))):
        count = len(dyad.speaker)
        if dyad.audio is not None and count >= length:
            end = min(count, length + round(_WARM_UP_S * FRAME_HZ))
            found.append(_cut(dyad.name, frames_of_dyad(dyad), dyad.audio, dyad.listener, end, length))
    return found


def _cut(
    name: str, frames: Sequence[SpeakerFrame], audio: Floats, recorded: Floats | None, end: int, length: int
) -> _Heard:
    """The clip is the last `length` frames before `end`; what is heard before it warms up."""
    first, begin = max(0, end - length - round(_WARM_UP_S * FRAME_HZ)), end - length
    sound = audio[begin * FRAME_SAMPLES : end * FRAME_SAMPLES]
    return _Heard(name, frames[first:end], sound, None if recorded is None else recorded[begin:end])


def _motions(condition: str, heard: Sequence[_Heard], options: StudyOptions) -> list[Floats]:
    """(N, 58) for every voice."""
    length = round(options.seconds * FRAME_HZ)
    if condition == RECORDED:
        return [each.recorded for each in heard if each.recorded is not None]
    listener = load_listener(find("listeners", condition, "config.yaml"))
    return [
        rollout(listener, each.frames, [options.seed + _HOPS * number]).motion[0, -length:]
        for number, each in enumerate(heard)
    ]


def table(answers: Path) -> dict[str, Any]:
    """What the answers in a CSV file say. Raises ConfigError."""
    return summary(read_answers(answers))


def serve(study: Study, view: str, ready: Callable[[str, int | None], None]) -> None:
    """Ask people until interrupted. `ready(url, taken port or None)` once. Raises ConfigError, PortError."""
    from sfms_robot.viewer.page_process import Address
    from sfms_robot.viewer.study_server import serve_study

    serve_study(study, Address.parsed(view), ready)
