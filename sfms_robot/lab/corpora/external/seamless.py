"""Seamless Interaction (Agrawal et al. 2025; facebookresearch/seamless_interaction @ acc817c): two people face to face.

`{improvised,naturalistic}/{train,dev,test}/BATCH/ARCHIVE/V.._S.._I.._P...{wav,json,npz}`, one of each per person;
partners share vendor, session and interaction, and each listens to the other. `.wav` is the own voice at 48 kHz;
`.json` has `metadata:vad`, the spans of speech; `.npz` has rows at 30 Hz, of which three are read:
`alignment_head_rotation` (T, 3), `FAUValue` (T, 24) and `is_valid` (T, 1), under `movement_v4:` if that exists,
else under `movement:`.

Invalid frames are filled with zeros, in blocks of 2 s. A listener's clip ends where they begin; a speaker's face is
unknown there. Rotation is read as axis-angle in FLAME's axes (`_signs` compares that with the key points), relative to
the head at rest, which is the median over the whole interaction: a person mostly looks at the partner. Gaze, expression
and head codes are outputs of a network and are not read. The translation is not read either, since its unit is not
documented.
"""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import AUDIO_HZ, Bools, Floats
from sfms_robot.lab.corpora.clips import FAU_VALUE, UNREADABLE, WIDTHS, WITHOUT_SHAPE, WITHOUT_UNIT, Dyad, samples_of
from sfms_robot.lab.corpora.collection import (
    Clip,
    ClipError,
    Found,
    Layout,
    Problem,
    frames_of,
    guarded,
    npz,
    npz_shapes,
    track,
)
from sfms_robot.lab.corpora.phrase_timing import listening_mask, voice_activity
from sfms_robot.signals.audio import AudioFile, read_audio
from sfms_robot.signals.events import runs

LABELS: Final = ("improvised", "naturalistic")
SPLITS: Final = {"train": "train", "validation": "dev", "test": "test"}
LICENCE: Final = (
    "CC BY-NC 4.0: not for commercial use; neither the data nor weights trained on them may be sold or shipped"
)
FPS: Final = 30.0
SPACE: Final = "seamless27"  # rotation 3 | action units 24
PREFIXES: Final = ("movement_v4", "movement")  # the newer first, which replaces the other
ROTATION, UNITS, VALID = "alignment_head_rotation", "FAUValue", "is_valid"
KEYS: Final[Mapping[str, int]] = {ROTATION: 3, UNITS: len(FAU_VALUE), VALID: 1}
KEYPOINTS: Final = "boxes_and_keypoints:keypoints"
FILES: Final = (".npz", ".json", ".wav")
VAD: Final = "metadata:vad"
LEAST_FRAMES: Final = 60  # shorter stretches between invalid blocks are left out
EDGE_FRAMES: Final = 2  # zeros were found up to this far on the valid side of a block
SLACK_S: Final = 0.5  # largest difference between the ends of sound, face, annotation and partner
LARGEST_LAG_S: Final = 0.25  # between a voice and its annotation
_LAGS_S: Final = 2.0  # largest lag that is tried
_LAG_GAIN: Final = 0.15  # share of frames by which another lag must agree better than lag 0
_ID: Final = re.compile(r"(V\w+_S\w+_I\w+)_P\w+")


# --- files ------------------------------------------------------------------------------------------------------


def _archives(place: Path, split: str, pattern: str) -> list[Path]:
    """Return the files of a split that match `pattern`, of both labels; `place` may be the folder of one label."""
    bases = [place / label for label in LABELS] if place.name not in LABELS else [place]
    return [file for base in bases for file in sorted((base / split).glob(pattern))]


def _files(place: Path, split: str) -> dict[str, dict[str, Path]]:
    """Return the files of every person, by the person's id and then by ending."""
    found: dict[str, dict[str, Path]] = defaultdict(dict)
    for file in _archives(place, split, "*/*/V*_S*_I*_P*.*"):
        if _ID.fullmatch(file.stem):
            found[file.stem].setdefault(file.suffix, file)
    return dict(sorted(found.items()))


def splits(place: Path) -> Mapping[str, str]:
    patterns = ("*/*/V*_S*_I*_P*.*", "*/*.tar")
    return {ours: theirs for ours, theirs in SPLITS.items() if any(_archives(place, theirs, one) for one in patterns)}


def scan(place: Path, split: str) -> Iterator[Found]:
    files, seen = _files(place, split), Counter[str]()
    interactions: dict[str, list[str]] = defaultdict(list)
    for name in files:
        interactions[name.rsplit("_", 1)[0]].append(name)
    mirrored, signs = _signs(place)
    for file in _archives(place, split, "*/*.tar"):
        if not file.with_suffix("").is_dir():
            yield Problem("unreadable", str(file), "an archive: unpack it beside itself")
    for interaction, names in interactions.items():
        try:
            yield from _clips(interaction, [(name, files[name]) for name in names], mirrored, seen)
        except ClipError as error:
            yield error.problem
    endings = Counter(ending for one in files.values() for ending in one)
    counted = ", ".join(f"{ending} {endings[ending]}" for ending in (*FILES, ".mp4"))
    share, units = seen["invalid"] / max(1, seen["frames"]), ", ".join(f"AU{unit}" for unit in WITHOUT_SHAPE)
    yield f"{split}: {len(files)} people in {len(interactions)} interactions; files: {counted}"
    yield f"{split}: {share:.1%} of {seen['frames'] / FPS / 60:.1f} minutes of faces are invalid and cut"
    yield f"no blendshape shows {units}; no action unit moves {', '.join(WITHOUT_UNIT)}; both sides move alike"
    yield signs


# --- one interaction --------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SeamlessPerson:
    """One person's part of an interaction, from headers and flags.

    Attributes:
        prefix: Prefix of the keys in the .npz.
        valid: (T,) frames whose rows hold a face.
        speaks: (T,) frames that are annotated as speech.
    """

    name: str
    npz: Path
    wav: Path
    prefix: str
    valid: Bools
    speaks: Bools


def _clips(
    interaction: str, people: Sequence[tuple[str, Mapping[str, Path]]], mirrored: bool, seen: Counter[str]
) -> Iterator[Clip]:
    """Yield the clips of both directions: every stretch in which the listener's face is valid."""
    if len(people) != 2:
        problem = "the partner's files are not here" if len(people) == 1 else f"{len(people)} people, not two"
        raise ClipError("missing half", interaction, f"{problem}: {', '.join(name for name, _ in people)}")
    one, two = pair = [_person(*each) for each in people]
    frames = frames_of(interaction, *(each.valid[:, None].shape for each in pair), slack=int(SLACK_S * FPS))
    seen.update(frames=sum(len(each.valid) for each in pair), invalid=sum(int((~each.valid).sum()) for each in pair))
    for listener, speaker in ((one, two), (two, one)):
        for first, end in stretches(listener.valid[:frames]):
            name = f"{listener.name}_f{first:05d}"
            read = partial(_read, name, (speaker, listener), first, end - first, mirrored)
            yield Clip(name=name, frames=end - first, read=read)


def stretches(valid: Bools) -> list[tuple[int, int]]:
    """Return ranges [first, end) of frames to learn from: valid, away from edges of invalid blocks, long enough."""
    cut = [(first + EDGE_FRAMES * (first > 0), end - EDGE_FRAMES * (end < len(valid))) for first, end in runs(valid)]
    return [(first, end) for first, end in cut if end - first >= LEAST_FRAMES]


def _person(name: str, files: Mapping[str, Path]) -> SeamlessPerson:
    """Return a person. Raises ClipError for a missing file, and for lengths that do not fit together."""
    for ending in FILES:
        if ending not in files:
            missing = next(iter(files.values())).with_suffix(ending)
            raise ClipError("missing sound" if ending == ".wav" else "missing half", missing, "no such file")
    rows, wav = files[".npz"], files[".wav"]
    prefix = _prefix(rows)
    valid = guarded(rows, lambda: _valid(rows, prefix))
    spans, seconds = _speech(files[".json"]), len(valid) / FPS
    sound = guarded(wav, partial(AudioFile, wav))
    sound.close()
    sound_s = sound.length / AUDIO_HZ
    if abs(sound_s - seconds) > SLACK_S:
        raise ClipError("lengths differ", wav, f"{sound_s:.2f} s of sound for {seconds:.2f} s of face")
    speaks = np.zeros(len(valid), bool)
    for index, (start_s, end_s) in enumerate(spans):
        if end_s > seconds + SLACK_S:
            detail = f"{VAD}[{index}] ends at {end_s:.2f} s, the interaction at {seconds:.2f} s"
            raise ClipError("time stamps", files[".json"], detail)
        speaks[int(start_s * FPS) : int(np.ceil(end_s * FPS))] = True
    return SeamlessPerson(name=name, npz=rows, wav=wav, prefix=prefix, valid=valid, speaks=speaks)


def _prefix(file: Path) -> str:
    """Return the newest prefix that has all keys. Raises ClipError naming what is missing."""
    shapes = npz_shapes(file)
    complete = [prefix for prefix in PREFIXES if all(f"{prefix}:{key}" in shapes for key in KEYS)]
    if not complete:
        lacking = ", ".join(f"{PREFIXES[-1]}:{key}" for key in KEYS if f"{PREFIXES[-1]}:{key}" not in shapes)
        held = ", ".join(sorted({key.split(":")[0] for key in shapes})) or "nothing"
        raise ClipError("missing half", file, f"has no {lacking} (only {held}; only vendor V00 has movement)")
    prefix = complete[0]
    rows = (shapes[f"{prefix}:{ROTATION}"] or ("T",))[0]
    for key, width in KEYS.items():
        shape = shapes[f"{prefix}:{key}"]
        if shape != (rows, width) and (width, shape) != (1, (rows,)):
            raise ClipError("wrong dims", file, f"{prefix}:{key} has shape {shape}, expected ({rows}, {width})")
    return prefix


def _valid(file: Path, prefix: str) -> Bools:
    return np.asarray(npz(file, f"{prefix}:{VALID}")[0], np.float32).reshape(-1) > 0.5


def _speech(file: Path) -> list[tuple[float, float]]:
    """Return the spans of speech. Raises ClipError for an invalid annotation, or one that goes back in time."""
    try:
        held = json.loads(file.read_text(encoding="utf-8"))
        spans = [(float(one["start"]), float(one["end"])) for one in held[VAD]]
    except (RecursionError, *UNREADABLE) as error:
        raise ClipError("unreadable", file, f"{VAD}: {type(error).__name__}: {error}") from error
    before = 0.0
    for index, (start_s, end_s) in enumerate(spans):
        if not 0.0 <= start_s <= end_s < np.inf:
            raise ClipError("time stamps", file, f"{VAD}[{index}] goes from {start_s:g} to {end_s:g} s")
        if start_s < before:
            raise ClipError("time stamps", file, f"{VAD}[{index}] begins at {start_s:g} s, before the one before it")
        before = start_s
    return spans


def _read(name: str, pair: Sequence[SeamlessPerson], first: int, frames: int, mirrored: bool) -> Dyad:
    """Return the dyad of (speaker, listener) from frame `first` on."""
    speaker, listener = (_motion(person, mirrored)[first : first + frames] for person in pair)
    if missing := int((~np.isfinite(listener).all(axis=1)).sum()):
        detail = f"{missing} of {frames} frames from {first} on are zeros and said to be valid"
        raise ClipError("not finite", pair[1].npz, detail)
    voices, speaks = [], []
    start, wanted = samples_of(first, FPS), samples_of(frames, FPS)
    for person in pair:
        heard = read_audio(person.wav)[start : start + wanted]
        voices.append(np.pad(heard, (0, wanted - len(heard))))  # a voice may end a little early
        speaks.append(person.speaks[first : first + frames])
        if abs(late_s := _lag_s(speaks[-1], voices[-1])) > LARGEST_LAG_S:
            detail = f"the voice comes {late_s:+.2f} s beside {VAD} of {person.name}"
            raise ClipError("time stamps", person.wav, detail)
    return Dyad(
        name=name, audio=voices[0], speaker=speaker, listener=listener,
        listening=listening_mask(speaks[0], speaks[1], FPS), space=SPACE, fps=FPS,
        agent_audio=voices[1],
    )  # fmt: skip


def _motion(person: SeamlessPerson, mirrored: bool) -> Floats:
    """Return (T, 27): rotation about the head at rest, action units; NaN where the face was not tracked."""
    from scipy.spatial.transform import Rotation

    frames = len(person.valid)
    keys = {key: f"{person.prefix}:{key}" for key in (ROTATION, UNITS)}
    rotation, units = (
        track(f"{person.npz} {where}", rows, frames, KEYS[key], gaps=True)
        for (key, where), rows in zip(keys.items(), npz(person.npz, *keys.values()), strict=True)
    )
    known = person.valid & np.isfinite(rotation).all(axis=1) & np.isfinite(units).all(axis=1) & units.any(axis=1)
    out = np.full((frames, WIDTHS[SPACE]), np.nan, np.float32)
    if known.any():
        vectors = rotation[known].astype(np.float64) * ((1, -1, -1) if mirrored else (1, 1, 1))
        rest = Rotation.from_rotvec(np.median(vectors, axis=0))
        out[known, :3] = (rest.inv() * Rotation.from_rotvec(vectors)).as_rotvec()
        out[known, 3:] = units[known]
    return out


def _lag_s(active: Bools, voice: Floats) -> float:
    """Return the delay [s] of a voice after its annotation (N,) at 30 Hz; 0 if it cannot be determined."""
    heard = voice_activity(voice, 1 / FPS)
    noted = np.pad(active, (0, max(0, len(heard) - len(active))))[: len(heard)]
    reach = int(_LAGS_S * FPS)
    if min(noted.sum(), (~noted).sum(), heard.sum(), (~heard).sum()) < reach or len(noted) < 4 * reach:
        return 0.0

    def agreement(lag: int) -> float:
        ours = noted[max(0, -lag) : len(noted) - max(0, lag)]
        return float(np.mean(ours == heard[max(0, lag) : len(heard) - max(0, -lag)]))

    best = max(range(-reach, reach + 1), key=lambda lag: (agreement(lag), -abs(lag)))
    return best / FPS if agreement(best) > agreement(0) + _LAG_GAIN else 0.0


# --- Signs of rotations and action units, checked with the key points of the same frames --------------------------
#
# The axes of `alignment_head_rotation` and the order of `FAUValue` are not published. But the files also hold where
# eyes, nose and lips were seen in the picture (`boxes_and_keypoints:keypoints`, COCO-WholeBody: Jin et al., ECCV 2020),
# and these must move accordingly: the nose goes down when the head does, and to the picture's right when the head turns
# to its own left, the right eye falls below the left one when the right ear does, lips part when the jaw drops, lids
# meet when eyes close.

SIGNS: Final = ("pitch", "yaw", "roll", "jaw drop", "eyes closed")
CLEAR: Final = 0.3  # correlations nearer to 0 prove nothing
_SAMPLE: Final = 8  # number of people whose key points are used
_SURE: Final = 0.3  # least confidence of a key point that is used
_NOSE, _LEFT_EYE, _RIGHT_EYE = 0, 1, 2
_FACE: Final = 23  # the first of 68 landmarks of the face
_LIPS: Final = (_FACE + 62, _FACE + 66)  # inner lip, upper and lower
_LIDS: Final = np.array([(37, 41), (38, 40), (43, 47), (44, 46)]) + _FACE  # upper and lower point
_USED: Final = [_NOSE, _LEFT_EYE, _RIGHT_EYE, *_LIPS, *_LIDS.ravel()]


def _signs(place: Path) -> tuple[bool, str]:
    """Return whether yaw and roll are both opposite to the picture (y down, z away), and a line of text about it.

    It uses a sample over all splits, so that every split is read the same way; the figures are medians over files.
    """
    files = [one[".npz"] for split in splits(place).values() for one in _files(place, split).values() if ".npz" in one]
    spread = np.unique(np.linspace(0, len(files) - 1, _SAMPLE).astype(int)).tolist() if files else []
    found = []
    for file in (files[index] for index in spread):
        try:
            found.append(guarded(file, partial(_correlations, file)))
        except ClipError:  # listed by the scan
            continue
    found = [one for one in found if one]
    medians = {name: [one[name] for one in found if name in one] for name in SIGNS}
    seen = {name: float(np.median(values)) for name, values in medians.items() if values}
    if not seen:
        return (
            False,
            "no key points beside the motion: signs of yaw and roll, and the order of action units, unverified",
        )
    mirrored = all(seen.get(name, 0.0) < -CLEAR for name in ("yaw", "roll"))
    turned = {"yaw", "roll"} if mirrored else set()
    against = [name for name, value in seen.items() if value < -CLEAR and name not in turned]
    unclear = [name for name, value in seen.items() if abs(value) <= CLEAR]
    figures = ", ".join(f"{name} {value:+.2f}" for name, value in seen.items())
    line = f"key points of {len(found)} files beside the motion: {figures}"
    line += "; yaw and roll are turned" if turned else ""
    line += f"; against the picture: {', '.join(against)}" if against else ""
    return mirrored, line + (f"; not proved by these: {', '.join(unclear)}" if unclear else "")


def _correlations(file: Path) -> dict[str, float]:
    """Return correlations of the motion in one .npz with its key points (T, 133, 3) = x, y [pixel], confidence.

    {} for a file without key points, or with too few frames that show the face. A track that does not move has no
    correlation and is left out.
    """
    prefix = _prefix(file)
    if KEYPOINTS not in npz_shapes(file):
        return {}
    rotation, units, points = npz(file, f"{prefix}:{ROTATION}", f"{prefix}:{UNITS}", KEYPOINTS)
    valid = _valid(file, prefix)
    if points.shape[1:] != (133, 3) or len(points) != len(valid):
        return {}
    sure = valid & (points[:, _USED, 2] > _SURE).all(axis=1)
    apart = np.linalg.norm(points[:, _LEFT_EYE, :2] - points[:, _RIGHT_EYE, :2], axis=1)
    used = sure & (apart > 1.0)
    if used.sum() < LEAST_FRAMES:
        return {}
    seen: NDArray[Any] = points[used, :, :2].astype(np.float64) / apart[used, None, None]
    left, right, height = seen[:, _LEFT_EYE], seen[:, _RIGHT_EYE], seen[:, :, 1]
    nose = seen[:, _NOSE] - (left + right) / 2
    lids = (height[:, _LIDS[:, 1]] - height[:, _LIDS[:, 0]]).mean(axis=1)
    lips = height[:, _LIPS[1]] - height[:, _LIPS[0]]
    picture = (nose[:, 1], nose[:, 0], right[:, 1] - left[:, 1], lips, -lids)
    moved = units[used].astype(np.float64)
    tracked = (*rotation[used].astype(np.float64).T, moved[:, FAU_VALUE.index(26)], moved[:, FAU_VALUE.index(43)])
    pairs = {name: np.stack(pair) for name, *pair in zip(SIGNS, tracked, picture, strict=True)}
    return {name: float(np.corrcoef(pair)[0, 1]) for name, pair in pairs.items() if (pair.std(axis=1) > 1e-6).all()}


LAYOUT: Final = Layout(
    name="seamless",
    about="Seamless Interaction: {improvised,naturalistic}/{train,dev,test}/BATCH/ARCHIVE/V_S_I_P.{wav,json,npz}",
    space=SPACE, fps=FPS, splits=splits, scan=scan, below=("", "seamless_interaction"), licence=LICENCE,
)  # fmt: skip
