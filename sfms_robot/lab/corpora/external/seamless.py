"""Seamless Interaction (Agrawal et al. 2025; facebookresearch/seamless_interaction @ acc817c): two people face to face.

`{improvised,naturalistic}/{train,dev,test}/BATCH/ARCHIVE/V.._S.._I.._P...{wav,json,npz}`, one of each a person;
partners share vendor, session and interaction, and each listens to the other. `.wav` is his own voice at 48 kHz;
`.json` has `metadata:vad`, when he speaks; `.npz` has rows at 30 Hz, of which three are read: `alignment_head_rotation`
(T, 3), `FAUValue` (T, 24) and `is_valid` (T, 1), under `movement_v4:` where that is there, else under `movement:`.

Invalid frames are filled with zeros, in blocks of 2 s. A listener's clip ends where they begin; a speaker's face is
unknown there. Rotation is taken as axis-angle in FLAME's axes (`seamless_evidence` holds that against the key points),
relative to the head at rest: its median over the whole interaction, where a person mostly looks, which is the partner.
Gaze, expression and head codes are a network's own and are not read, nor is the translation, whose unit nobody tells.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.lab.corpora.action_units import WITHOUT_SHAPE, WITHOUT_UNIT
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order, Problem, guarded
from sfms_robot.lab.corpora.external.seamless_evidence import Evidence, weigh
from sfms_robot.lab.corpora.external.seamless_person import (
    FILES,
    FPS,
    LARGEST_LAG_S,
    PREFIXES,
    SLACK_S,
    SPACE,
    VAD,
    Person,
    correlations,
    lag_s,
    motion_of,
    person_of,
    voice_of,
)
from sfms_robot.lab.corpora.reading import frames_of, npz_shapes
from sfms_robot.lab.evaluation.phrase_timing import listening_mask
from sfms_robot.signals.events import runs

NAME: Final = "seamless"
LABELS: Final = ("improvised", "naturalistic")
SPLITS: Final = {"train": "train", "validation": "dev", "test": "test"}
LICENCE: Final = (
    "CC BY-NC 4.0: not for commercial use; neither the data nor weights trained on them may be sold or shipped"
)

LEAST_FRAMES: Final = 60  # shorter stretches between invalid blocks are left out
EDGE_FRAMES: Final = 2  # zeros have been seen so far on the valid side of a block
_CUT_S: Final = 0.1  # speech so near to an end of the interaction goes on beyond it
_SAMPLE: Final = 8  # people whose key points are looked at
_ID: Final = re.compile(r"(V\w+_S\w+_I\w+)_P\w+")


# --- what is there ----------------------------------------------------------------------------------------------


def root(folder: Path) -> Path | None:
    for place in (folder, folder / "seamless_interaction"):
        if any(_holds(split) for ours in SPLITS for split in _folders(place, SPLITS[ours])):
            return place
    return None


def _folders(place: Path, split: str) -> list[Path]:
    """Of one split, of both labels; `place` may be the folder of one label."""
    bases = [place / label for label in LABELS] if place.name not in LABELS else [place]
    return [base / split for base in bases if (base / split).is_dir()]


def _holds(split: Path) -> bool:
    return any(next(split.glob(pattern), None) for pattern in ("*/*/V*_S*_I*_P*.*", "*/*.tar"))


def splits(place: Path) -> Mapping[str, str]:
    return {ours: theirs for ours, theirs in SPLITS.items() if any(map(_holds, _folders(place, theirs)))}


def _files(place: Path, split: str) -> dict[str, dict[str, Path]]:
    """Files of every person by their ending, by his id."""
    found: dict[str, dict[str, Path]] = defaultdict(dict)
    for folder in _folders(place, split):
        for file in sorted(folder.glob("*/*/V*_S*_I*_P*.*")):
            if _ID.fullmatch(file.stem):
                found[file.stem].setdefault(file.suffix, file)
    return dict(sorted(found.items()))


def scan(place: Path, split: str, order: Order | None) -> Dataset:
    files = _files(place, split)
    interactions: dict[str, list[str]] = defaultdict(list)
    for name in files:
        interactions[name.rsplit("_", 1)[0]].append(name)
    proof = _evidence(place)
    clips: list[Clip] = []
    problems = [
        Problem("unreadable", str(file), "an archive: unpack it beside itself") for file in _packed(place, split)
    ]
    seen = _Seen()
    for interaction, names in interactions.items():
        try:
            pair = _pair(interaction, names, files, seen)
            clips += _clips(pair, proof.mirrored, len(clips))
        except ClipError as error:
            seen.late += error.problem.kind in ("time stamps", "lengths differ")
            problems.append(error.problem)
    found = _found(split, files, len(interactions), seen)
    return Dataset(NAME, split, SPACE, FPS, tuple(clips), tuple(problems), (*found, proof.told()), (), LICENCE)


@dataclass
class _Seen:
    """Counts over a scan, for what is said at its end."""

    frames: int = 0
    invalid: int = 0
    mid_speech: int = 0
    late: int = 0


def _packed(place: Path, split: str) -> Iterator[Path]:
    for folder in _folders(place, split):
        yield from (file for file in sorted(folder.glob("*/*.tar")) if not file.with_suffix("").is_dir())


def _found(split: str, files: Mapping[str, Mapping[str, Path]], interactions: int, seen: _Seen) -> tuple[str, ...]:
    """What is there and what is not, a line each."""
    endings = Counter(ending for one in files.values() for ending in one)
    prefixes: Counter[str] = Counter()
    for one in files.values():
        try:
            keys = npz_shapes(one[".npz"]) if ".npz" in one else ()
        except ClipError:
            continue
        prefixes.update({key.split(":")[0] for key in keys})
    counted = ", ".join(f"{ending} {endings[ending]}" for ending in (*FILES, ".mp4"))
    held = ", ".join(f"{prefix} {prefixes[prefix]}" for prefix in (*PREFIXES, "smplh", "boxes_and_keypoints"))
    share = seen.invalid / seen.frames if seen.frames else 0.0
    units = ", ".join(f"AU{unit}" for unit in WITHOUT_SHAPE)
    return (
        f"{split}: {len(files)} people in {interactions} interactions; files: {counted}; in .npz: {held}",
        f"{split}: {share:.1%} of {seen.frames / FPS / 60:.1f} minutes of faces are invalid and cut",
        f"{split}: time stamps (about 10 % are wrong, its authors say): {seen.late} of {interactions} interactions "
        f"contradict themselves, {seen.mid_speech} begin or end inside speech; voices are held against {VAD} when read",
        f"no blendshape shows {units}; no action unit moves {', '.join(WITHOUT_UNIT)}; both sides move alike",
    )


# --- one interaction --------------------------------------------------------------------------------------------


def _pair(
    interaction: str, names: Sequence[str], files: Mapping[str, Mapping[str, Path]], seen: _Seen
) -> tuple[Person, Person]:
    if len(names) != 2:
        others = ", ".join(names)
        problem = "his partner's files are not here" if len(names) == 1 else f"{len(names)} people, not two"
        raise ClipError.of("missing half", interaction, f"{problem}: {others}")
    one, two = (person_of(name, files[name]) for name in names)
    frames_of(interaction, one.valid[:, None].shape, two.valid[:, None].shape, slack=int(SLACK_S * FPS))
    for person in (one, two):
        seen.frames += len(person.valid)
        seen.invalid += int((~person.valid).sum())
    seen.mid_speech += any(
        start_s < _CUT_S or end_s > person.seconds - _CUT_S
        for person in (one, two)
        for start_s, end_s in person.speech_s
    )
    return one, two


def _clips(pair: tuple[Person, Person], mirrored: bool, row: int) -> list[Clip]:
    """Both directions: every stretch in which the listener's face is valid."""
    frames = min(len(person.valid) for person in pair)
    found: list[Clip] = []
    for listener, speaker in (pair, pair[::-1]):
        for first, end in stretches(listener.valid[:frames]):
            name = f"{listener.name}_f{first:05d}"
            read = partial(_read, name, speaker, listener, first, end - first, mirrored)
            found.append(Clip(name, end - first, row + len(found), read))
    return found


def stretches(valid: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Half-open [first, end) of frames to learn from: valid ones, off the edges of invalid blocks, long enough."""
    cut = [(first + EDGE_FRAMES * (first > 0), end - EDGE_FRAMES * (end < len(valid))) for first, end in runs(valid)]
    return [(first, end) for first, end in cut if end - first >= LEAST_FRAMES]


def _read(name: str, speaker: Person, listener: Person, first: int, frames: int, mirrored: bool) -> Dyad:
    faces = [motion_of(person, mirrored)[first : first + frames] for person in (speaker, listener)]
    if missing := int((~np.isfinite(faces[1]).all(axis=1)).sum()):
        detail = f"{missing} of {frames} frames from {first} on are zeros and said to be valid"
        raise ClipError.of("not finite", listener.npz, detail)
    voices = [voice_of(person, first, frames) for person in (speaker, listener)]
    speaks = [person.speaks(first, frames) for person in (speaker, listener)]
    for person, voice, active in zip((speaker, listener), voices, speaks, strict=True):
        if abs(late_s := lag_s(active, voice)) > LARGEST_LAG_S:
            detail = f"the voice comes {late_s:+.2f} s beside {VAD} of {person.name}"
            raise ClipError.of("time stamps", person.wav, detail)
    listening = np.asarray(listening_mask(speaks[0], FPS, speaks[1]), bool)
    return Dyad(name, voices[0], faces[0], faces[1], listening, SPACE, FPS, agent_audio=voices[1])


# --- which way numbers point ------------------------------------------------------------------------------------


def _evidence(place: Path) -> Evidence:
    """From a sample over all splits, so that every split is read the same way."""
    files = [one[".npz"] for split in splits(place).values() for one in _files(place, split).values() if ".npz" in one]
    spread = np.unique(np.linspace(0, len(files) - 1, _SAMPLE).astype(int)).tolist() if files else []
    found = []
    for file in (files[index] for index in spread):
        try:
            one = guarded(str(file), partial(correlations, file))
        except ClipError:  # named by the scan
            continue
        if one:
            found.append(one)
    return weigh(found)


LAYOUT: Final = Layout(
    NAME, "Seamless Interaction: {improvised,naturalistic}/{train,dev,test}/BATCH/ARCHIVE/V_S_I_P.{wav,json,npz}",
    SPACE, FPS, None, root, splits, scan,
)  # fmt: skip
