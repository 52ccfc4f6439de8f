"""Seamless Interaction (Agrawal et al. 2025; facebookresearch/seamless_interaction @ acc817c): two people face to face.

`{improvised,naturalistic}/{train,dev,test}/BATCH/ARCHIVE/V.._S.._I.._P...{wav,json,npz}`, one of each a person;
partners share vendor, session and interaction, and each listens to the other. `.wav` is the own voice at 48 kHz;
`.json` has `metadata:vad`, the spans of speech; `.npz` has rows at 30 Hz, of which three are read:
`alignment_head_rotation`
(T, 3), `FAUValue` (T, 24) and `is_valid` (T, 1), under `movement_v4:` where that is there, else under `movement:`.

Invalid frames are filled with zeros, in blocks of 2 s. A listener's clip ends where they begin; a speaker's face is
unknown there. Rotation is taken as axis-angle in FLAME's axes (`correlations` holds that against the key points),
relative to the head at rest: its median over the whole interaction, where a person mostly looks, which is the partner.
Gaze, expression and head codes are outputs of a network and are not read, nor is the translation, whose unit is not
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

from sfms_robot.frames import AUDIO_HZ, Doubles, Floats
from sfms_robot.lab.corpora.action_units import FAU_VALUE, WITHOUT_SHAPE, WITHOUT_UNIT
from sfms_robot.lab.corpora.clips import UNREADABLE, WIDTHS, Dyad, samples_of
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order, Problem, guarded
from sfms_robot.lab.corpora.reading import frames_of, npz_shapes, track
from sfms_robot.lab.evaluation.phrase_timing import listening_mask, voice_activity
from sfms_robot.signals.audio import AudioFile, read_audio
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
    return Dataset(
        layout=NAME,
        split=split,
        space=SPACE,
        fps=FPS,
        clips=tuple(clips),
        problems=tuple(problems),
        notes=(*found, proof.told()),
        features=(),
        licence=LICENCE,
    )


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
    """Return what was found and what is missing, a line each."""
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
) -> tuple[SeamlessPerson, SeamlessPerson]:
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


def _clips(pair: tuple[SeamlessPerson, SeamlessPerson], mirrored: bool, row: int) -> list[Clip]:
    """Both directions: every stretch in which the listener's face is valid."""
    frames = min(len(person.valid) for person in pair)
    found: list[Clip] = []
    for listener, speaker in (pair, pair[::-1]):
        for first, end in stretches(listener.valid[:frames]):
            name = f"{listener.name}_f{first:05d}"
            read = partial(_read, name, speaker, listener, first, end - first, mirrored)
            found.append(Clip(name=name, frames=end - first, row=row + len(found), read=read))
    return found


def stretches(valid: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Half-open [first, end) of frames to learn from: valid ones, off the edges of invalid blocks, long enough."""
    cut = [(first + EDGE_FRAMES * (first > 0), end - EDGE_FRAMES * (end < len(valid))) for first, end in runs(valid)]
    return [(first, end) for first, end in cut if end - first >= LEAST_FRAMES]


def _read(
    name: str, speaker: SeamlessPerson, listener: SeamlessPerson, first: int, frames: int, mirrored: bool
) -> Dyad:
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
    return Dyad(
        name=name,
        audio=voices[0],
        speaker=faces[0],
        listener=faces[1],
        listening=listening,
        space=SPACE,
        fps=FPS,
        agent_audio=voices[1],
    )


# --- which way numbers point ------------------------------------------------------------------------------------


def _evidence(place: Path) -> Evidence:
    """From a sample over all splits, so that every split is read the same way."""
    files = [one[".npz"] for split in splits(place).values() for one in _files(place, split).values() if ".npz" in one]
    spread = np.unique(np.linspace(0, len(files) - 1, _SAMPLE).astype(int)).tolist() if files else []
    found = []
    for file in (files[index] for index in spread):
        try:
            one = guarded(str(file), partial(correlations_of, file))
        except ClipError:  # named by the scan
            continue
        if one:
            found.append(one)
    return weigh(found)


# --- Which way Seamless Interaction's numbers point, told by the key points of the same frames --------------------
#
# Nobody has published the axes of `alignment_head_rotation`, nor the order of `FAUValue`. But the files also hold where
# eyes, nose and lips were seen in the picture (`boxes_and_keypoints:keypoints`, COCO-WholeBody: Jin et al., ECCV 2020),
# and these must go along: the nose goes down when the head does, to the picture's right when it turns to its own left,
# the right eye falls below the left one when the right ear does, lips part when the jaw drops, lids meet when eyes
# close.

SIGNS: Final = ("pitch", "yaw", "roll", "jaw drop", "eyes closed")
CLEAR: Final = 0.3  # correlations nearer to 0 prove nothing
_SURE: Final = 0.3  # confidence of a key point
_NOSE, _LEFT_EYE, _RIGHT_EYE = 0, 1, 2
_FACE: Final = 23  # the first of 68 landmarks of the face
_LIPS: Final = (_FACE + 62, _FACE + 66)  # inner lip, upper and lower
_LIDS: Final = tuple((_FACE + above, _FACE + below) for above, below in ((37, 41), (38, 40), (43, 47), (44, 46)))
_USED: Final = sorted({_NOSE, _LEFT_EYE, _RIGHT_EYE, *_LIPS, *(point for pair in _LIDS for point in pair)})


@dataclass(frozen=True)
class Evidence:
    """Correlations of what was tracked with what was seen, by name of `SIGNS`: the median over `files`; {}: none."""

    correlations: dict[str, float]
    files: int

    @property
    def mirrored(self) -> bool:
        """Yaw and roll both go against the picture: a frame with y down and z away from the viewer."""
        return all(self.correlations.get(name, 0.0) < -CLEAR for name in ("yaw", "roll"))

    def told(self) -> str:
        """One line for a person."""
        if not self.correlations:
            return "no key points beside the motion: signs of yaw and roll, and the order of action units, unverified"
        found = ", ".join(f"{name} {value:+.2f}" for name, value in self.correlations.items())
        turned = {"yaw", "roll"} if self.mirrored else set()
        against = [name for name, value in self.correlations.items() if value < -CLEAR and name not in turned]
        unclear = [name for name, value in self.correlations.items() if abs(value) <= CLEAR]
        said = f"key points of {self.files} files beside the motion: {found}"
        said += "; yaw and roll are turned" if turned else ""
        said += f"; against the picture: {', '.join(against)}" if against else ""
        return said + (f"; not proved by these: {', '.join(unclear)}" if unclear else "")


def correlations(rotation_rad: Doubles, units: Doubles, keypoints: NDArray[Any]) -> dict[str, float] | None:
    """Of valid frames: rotation (N, 3), units (N, 24), keypoints (N, 133, 3) = x, y [pixel], confidence.

    None where too few frames show the face. A track that does not move has no correlation and is left out.
    """
    sure = (keypoints[:, _USED, 2] > _SURE).all(axis=1)
    seen = np.asarray(keypoints[sure, :, :2], np.float64)
    left, right = seen[:, _LEFT_EYE], seen[:, _RIGHT_EYE]
    apart = np.linalg.norm(left - right, axis=1)
    usable = apart > 1.0
    if usable.sum() < LEAST_FRAMES:
        return None
    nose = seen[:, _NOSE] - (left + right) / 2
    lids = np.mean([seen[:, below, 1] - seen[:, above, 1] for above, below in _LIDS], axis=0)
    picture = (nose[:, 1], nose[:, 0], right[:, 1] - left[:, 1], seen[:, _LIPS[1], 1] - seen[:, _LIPS[0], 1], -lids)
    tracked = (*rotation_rad[sure].T, units[sure, FAU_VALUE.index(26)], units[sure, FAU_VALUE.index(43)])
    found = {}
    for name, ours, theirs in zip(SIGNS, tracked, picture, strict=True):
        pair = np.stack([ours[usable], theirs[usable] / apart[usable]])
        if (pair.std(axis=1) > 1e-6).all():
            found[name] = float(np.corrcoef(pair)[0, 1])
    return found


def weigh(files: Sequence[dict[str, float]]) -> Evidence:
    """The median over files of each correlation."""
    names = [name for name in SIGNS if any(name in one for one in files)]
    return Evidence({name: float(np.median([one[name] for one in files if name in one])) for name in names}, len(files))


# --- One person of Seamless Interaction: three files in, his motion, his voice and when he speaks out -------------

FPS: Final = 30.0
SPACE: Final = "seamless27"  # rotation 3 | action units 24
PREFIXES: Final = ("movement_v4", "movement")  # the newer first: it replaces the other
ROTATION, UNITS, VALID = "alignment_head_rotation", "FAUValue", "is_valid"
KEYS: Final[Mapping[str, int]] = {ROTATION: 3, UNITS: len(FAU_VALUE), VALID: 1}
KEYPOINTS: Final = "boxes_and_keypoints:keypoints"
FILES: Final = (".npz", ".json", ".wav")
VAD: Final = "metadata:vad"
SLACK_S: Final = 0.5  # by which the ends of sound, face, annotation and partner may differ
LARGEST_LAG_S: Final = 0.25  # between a voice and what is annotated of it
_LAGS_S: Final = 2.0  # looked for
_LAG_GAIN: Final = 0.15  # by which another lag has to agree better


@dataclass(frozen=True, kw_only=True)
class SeamlessPerson:
    """One person's part of an interaction, from headers and flags.

    Attributes:
        prefix: of his rows in the .npz.
        valid: (T,) whose rows hold something.
        speech_s: (start, end) of what he says.
    """

    name: str
    npz: Path
    wav: Path
    prefix: str
    valid: NDArray[np.bool_]
    speech_s: Sequence[tuple[float, float]]

    @property
    def seconds(self) -> float:
        return len(self.valid) / FPS

    def speaks(self, first: int, frames: int) -> NDArray[np.bool_]:
        """(frames,) from that frame on."""
        out = np.zeros(len(self.valid), bool)
        for start_s, end_s in self.speech_s:
            out[int(start_s * FPS) : int(np.ceil(end_s * FPS))] = True
        return out[first : first + frames]


def person_of(name: str, files: Mapping[str, Path]) -> SeamlessPerson:
    """From files by their ending. Raises ClipError for one that is missing, and for ends that do not fit together."""
    somewhere = next(iter(files.values()))
    for ending in FILES:
        if ending not in files:
            kind: Any = "missing sound" if ending == ".wav" else "missing half"
            raise ClipError.of(kind, somewhere.with_suffix(ending), "no such file")
    prefix = prefix_of(files[".npz"])
    valid = guarded(str(files[".npz"]), lambda: _flags(files[".npz"], prefix))
    person = SeamlessPerson(
        name=name, npz=files[".npz"], wav=files[".wav"], prefix=prefix, valid=valid, speech_s=_speech(files[".json"])
    )
    sound_s = guarded(str(person.wav), lambda: _sound_s(person.wav))
    if abs(sound_s - person.seconds) > SLACK_S:
        detail = f"{sound_s:.2f} s of sound for {person.seconds:.2f} s of face"
        raise ClipError.of("lengths differ", person.wav, detail)
    for index, (_, end_s) in enumerate(person.speech_s):
        if end_s > person.seconds + SLACK_S:
            detail = f"{VAD}[{index}] ends at {end_s:.2f} s, the interaction at {person.seconds:.2f} s"
            raise ClipError.of("time stamps", files[".json"], detail)
    return person


def _flags(file: Path, prefix: str) -> NDArray[np.bool_]:
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        flags: NDArray[np.bool_] = np.asarray(arrays[f"{prefix}:{VALID}"], np.float32).reshape(-1) > 0.5
    return flags


def prefix_of(file: Path) -> str:
    """The newest that has all that is needed. Raises ClipError naming what is missing."""
    shapes = npz_shapes(file)
    for prefix in PREFIXES:
        if any(f"{prefix}:{key}" not in shapes for key in KEYS):
            continue
        for key, width in KEYS.items():
            shape = shapes[f"{prefix}:{key}"]
            fits = len(shape) == 2 and shape[1] == width or len(shape) == width == 1
            if not fits or shape[0] != shapes[f"{prefix}:{ROTATION}"][0]:
                rows = shapes[f"{prefix}:{ROTATION}"][0] if shapes[f"{prefix}:{ROTATION}"] else "T"
                raise ClipError.of("wrong dims", file, f"{prefix}:{key} has shape {shape}, expected ({rows}, {width})")
        return prefix
    lacking = ", ".join(f"{PREFIXES[-1]}:{key}" for key in KEYS if f"{PREFIXES[-1]}:{key}" not in shapes)
    held = ", ".join(sorted({key.split(":")[0] for key in shapes})) or "nothing"
    raise ClipError.of("missing half", file, f"has no {lacking} (only {held}; only vendor V00 has movement)")


def _speech(file: Path) -> tuple[tuple[float, float], ...]:
    """Return the spans of speech. Raises ClipError for an invalid annotation, or one that goes back in time."""
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        spans = [(float(one["start"]), float(one["end"])) for one in told[VAD]]
    except (RecursionError, *UNREADABLE) as error:
        raise ClipError.of("unreadable", file, f"{VAD}: {type(error).__name__}: {error}") from error
    before = 0.0
    for index, (start_s, end_s) in enumerate(spans):
        if not 0.0 <= start_s <= end_s < np.inf:
            raise ClipError.of("time stamps", file, f"{VAD}[{index}] goes from {start_s:g} to {end_s:g} s")
        if start_s < before:
            raise ClipError.of("time stamps", file, f"{VAD}[{index}] begins at {start_s:g} s, before the one before it")
        before = start_s
    return tuple(spans)


def _sound_s(file: Path) -> float:
    sound = AudioFile(file)
    sound.close()
    return sound.length / AUDIO_HZ


def motion_of(person: SeamlessPerson, mirrored: bool) -> Floats:
    """(T, 27): rotation about the head at rest, action units; NaN where the face was not tracked."""
    from scipy.spatial.transform import Rotation

    frames, known = len(person.valid), person.valid.copy()
    rotation, units = (_rows(person, key, frames) for key in (ROTATION, UNITS))
    known &= np.isfinite(rotation).all(axis=1) & np.isfinite(units).all(axis=1) & units.any(axis=1)
    out = np.full((frames, WIDTHS[SPACE]), np.nan, np.float32)
    if known.any():
        vectors = rotation[known].astype(np.float64) * ((1, -1, -1) if mirrored else (1, 1, 1))
        rest = Rotation.from_rotvec(np.median(vectors, axis=0))
        out[known, :3] = (rest.inv() * Rotation.from_rotvec(vectors)).as_rotvec()
        out[known, 3:] = units[known]
    return out


def _rows(person: SeamlessPerson, key: str, frames: int) -> Floats:
    where = f"{person.prefix}:{key}"
    with person.npz.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        return track(f"{person.npz} {where}", arrays[where], frames, KEYS[key], gaps=True)


def voice_of(person: SeamlessPerson, first: int, frames: int) -> Floats:
    """Mono 16 kHz, from that frame on; silence where it ends a little early."""
    start, wanted = samples_of(first, FPS), samples_of(frames, FPS)
    heard = read_audio(person.wav)[start : start + wanted]
    return np.pad(heard, (0, wanted - len(heard)))


def lag_s(active: NDArray[np.bool_], voice: Floats) -> float:
    """Return the delay of a voice after its annotation, (N,) at 30 Hz; 0 where it is not known."""
    heard = np.asarray(voice_activity(voice, AUDIO_HZ, 1 / FPS), bool)
    told = np.pad(active, (0, max(0, len(heard) - len(active))))[: len(heard)]
    reach = int(_LAGS_S * FPS)
    if min(told.sum(), (~told).sum(), heard.sum(), (~heard).sum()) < reach or len(told) < 4 * reach:
        return 0.0

    def agreement(lag: int) -> float:
        ours = told[max(0, -lag) : len(told) - max(0, lag)]
        theirs = heard[max(0, lag) : len(heard) - max(0, -lag)]
        return float(np.mean(ours == theirs))

    lags = range(-reach, reach + 1)
    best = max(lags, key=lambda lag: (agreement(lag), -abs(lag)))
    return best / FPS if agreement(best) > agreement(0) + _LAG_GAIN else 0.0


def correlations_of(file: Path) -> dict[str, float] | None:
    """Of one .npz, between motion and key points; None where it has none, or too few. Raises as a broken file does."""
    prefix = prefix_of(file)
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        if KEYPOINTS not in arrays:
            return None
        rotation, units = (np.asarray(arrays[f"{prefix}:{key}"], np.float64) for key in (ROTATION, UNITS))
        valid = np.asarray(arrays[f"{prefix}:{VALID}"]).reshape(-1) > 0.5
        points = np.asarray(arrays[KEYPOINTS])
    if points.shape[1:] != (133, 3) or len(points) != len(valid):
        return None
    return correlations(rotation[valid], units[valid], points[valid])


LAYOUT: Final = Layout(
    name=NAME,
    about="Seamless Interaction: {improvised,naturalistic}/{train,dev,test}/BATCH/ARCHIVE/V_S_I_P.{wav,json,npz}",
    space=SPACE, fps=FPS, order=None, root=root, splits=splits, scan=scan,
)  # fmt: skip
