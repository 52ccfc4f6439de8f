"""Functions behind `data`: compose dyads, check the content of a data set on disk, convert it to our layout.

A check reads every clip of the set once and reports everything that it skips.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from sfms_robot.app.progress import bar, tracked
from sfms_robot.errors import ConfigError
from sfms_robot.frames import SPACE_CHANNELS, Doubles
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora import clips, formats
from sfms_robot.lab.corpora.clips import SEAMLESS_CHANNELS, Dyad
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order, Problem, guarded
from sfms_robot.lab.corpora.compose.composed import compose_folder
from sfms_robot.lab.corpora.conversion import CONVERTIBLE, FIGURES, Residual, to_ours
from sfms_robot.listeners.space import FlameMatrix, read_matrix


def compose_dyads(data: Path, out: Path, minutes: float, seed: int, overwrite: bool, jobs: int) -> Figures:
    """Compose dyads into out/train, out/validation and out/test. Returns the minutes written per split."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out}: is a file, not a folder to write dyads to")
    with bar("composing dyads") as moved:
        moved(0, 0, "reading")
        return dict(compose_folder(data, out, seed, minutes, moved, overwrite, jobs))


# --- `data check` ---------------------------------------------------------------------------------------------------


def check_data(folder: Path, layout: str = "auto", order: Order | None = None, window: int = 0) -> Figures:
    """Read every split of the data set in a folder.

    Args:
        window: Least number of frames of a clip.

    Returns:
        layout, order, licence, and per split: clips, minutes, fps, space, frames, sound, features, channels, problems
        (kind, count, names, first detail), notes. `usable` is False when no clip can be used, or the order is swapped.

    Raises ConfigError if the folder holds no data set.
    """
    found, place = formats.detect(folder, layout)
    splits = [_checked(found, place, name, order, window) for name in formats.split_names(found, place)]
    swapped = any(problem["kind"] == "swapped order" for split in splits for problem in split["problems"])
    return {
        "folder": str(place),
        "layout": found.name,
        "about": found.about,
        "order": order or found.order,
        "window": window,
        "licence": next((split["licence"] for split in splits if split["licence"]), None),
        "usable": not swapped and any(split["clips"] for split in splits),
        "splits": splits,
    }


def _checked(layout: Layout, place: Path, split: str, order: Order | None, window: int) -> Figures:
    """Read every clip of a split; return its report."""
    try:
        dataset = formats.scan_split(layout, place, split, order)
    except ConfigError as error:
        dataset = Dataset(
            layout=layout.name, split=split, space=layout.space, fps=layout.fps, clips=(),
            problems=(Problem("unreadable", str(place), str(error)),),
        )  # fmt: skip
    tally, kept, problems = _Tally(), list[Clip](), list(dataset.problems)
    for index, clip in enumerate(tracked(dataset.clips, split)):
        try:
            if clip.frames < (least := max(1, window)):
                raise ClipError("too short", clip.name, f"{clip.frames} frames, a window needs {least}")
            tally.add(dataset[index], clip)
            kept.append(clip)
        except ClipError as error:
            problems.append(error.problem)
    checked = replace(dataset, clips=tuple(kept))
    notes = list(dataset.notes)
    if said := formats.wrong_order(checked, order or layout.order):
        if order is None:
            problems.append(Problem("swapped order", split, said))
        else:
            notes.append(said)
    kinds = _by_kind([*problems, *tally.missing()])
    lengths = checked.lengths
    return {
        "split": split,
        "clips": len(checked),
        "minutes": round(checked.minutes, 3),
        "fps": dataset.fps,
        "space": dataset.space,
        "frames": {"min": min(lengths), "median": float(np.median(lengths)), "max": max(lengths)} if lengths else None,
        "sound": dict(tally.sound),
        "features": dict(tally.features),
        "listening_share": round(tally.listening / sum(lengths), 4) if lengths else None,
        "speaker_unknown_frames": tally.faceless,
        "channels": tally.channels(dataset.space, sum(lengths)),
        "problems": [
            {"kind": kind, "count": len(found), "names": [one.where for one in found], "first": found[0].detail}
            for kind, found in kinds.items()
        ],
        "notes": notes,
        "licence": dataset.licence,
    }


def _by_kind(problems: Sequence[Problem]) -> dict[str, list[Problem]]:
    kinds: dict[str, list[Problem]] = {}
    for problem in problems:
        kinds.setdefault(problem.kind, []).append(problem)
    return kinds


class _Tally:
    """Figures of the clips read so far.

    Attributes:
        listening, faceless: Frames in which the listener listens, and in which the speaker's face is not known.
        sound: Number of clips by the form of their sound.
        features: Number of clips that have each shipped feature.
    """

    def __init__(self) -> None:
        self.listening = self.faceless = 0
        self.sound: Counter[str] = Counter()
        self.features: Counter[str] = Counter()
        self._missing: dict[str, list[Problem]] = {}
        self._motion: list[Doubles] = []  # (4, D) per clip: least, greatest, sum, sum of squares

    def add(self, dyad: Dyad, clip: Clip) -> None:
        """Count a clip, and read each of its shipped features."""
        motion = dyad.listener.astype(np.float64)
        self._motion.append(
            np.stack([motion.min(axis=0), motion.max(axis=0), motion.sum(axis=0), np.square(motion).sum(axis=0)])
        )
        self.listening += int(dyad.listening.sum())
        self.faceless += int((~np.isfinite(dyad.speaker).all(axis=1)).sum())
        self.sound["waveform" if dyad.audio is not None else "mel" if dyad.mel is not None else "none"] += 1
        for name, read in clip.features.items():
            self.features[name] += 0
            try:
                guarded(clip.name, read)
                self.features[name] += 1
            except ClipError as error:
                self._missing.setdefault(name, []).append(error.problem)

    def missing(self) -> Iterator[Problem]:
        """Yield the problems of features. A feature missing from all clips is not shipped, which is not a problem."""
        for name, found in self._missing.items():
            yield from (one for one in found if self.features[name] or one.kind != "missing feature")

    def channels(self, space: str, frames: int) -> list[Figures]:
        """Return range, mean and standard deviation of each channel over all frames."""
        if not self._motion:
            return []
        low, high, total, square = np.stack(self._motion, axis=1)
        mean = total.sum(axis=0) / frames
        spread = np.sqrt(np.maximum(0.0, square.sum(axis=0) / frames - mean**2))
        known = {**SPACE_CHANNELS, "seamless27": SEAMLESS_CHANNELS}
        figures = (np.round(each, 5).tolist() for each in (low.min(0), high.max(0), mean, spread))
        titles = known.get(space) or [f"channel_{index}" for index in range(len(mean))]
        keys = ("name", "min", "max", "mean", "std")
        return [dict(zip(keys, row, strict=True)) for row in zip(titles, *figures, strict=True)]


# --- `data convert`: from the layout of a data set's authors to dyads for `train` and `evaluate` -----------------


def convert_data(
    folder: Path,
    out: Path,
    layout: str = "auto",
    order: Order | None = None,
    flame_matrix: Path | None = None,
    flame_order: str = "alphabetical",
) -> Figures:
    """Write every split of `folder` as out/SPLIT/NAME.npz in `arkit58` at 25 fps, and their licence.

    The licence goes to out/source.yaml. One clip is held in memory at a time. Clips that cannot be used are left out
    and counted.

    Returns:
        folder, out, layout, licence, per split: clips, minutes, left_out (by kind, with the first), notes; `residual`:
        figures of `Residual.told`, measured on the listeners' motion; notes: parts that our space cannot represent.

        Raises ConfigError for a folder without a data set, a space that cannot be converted to ours, an `out` that is
        not empty, an invalid matrix, and a data set without a usable clip.
    """
    found, place = formats.detect(folder, layout)
    if found.space not in CONVERTIBLE:
        raise ConfigError(f"{place}: {found.name} is in {found.space}, which cannot become arkit58")
    flame = None
    if flame_matrix is not None:
        if found.space != "deca56":
            raise ConfigError(f"--flame-matrix {flame_matrix}: {found.space} has no FLAME expression (deca56 has)")
        if not flame_matrix.is_file():
            raise ConfigError(f"--flame-matrix {flame_matrix}: no such file")
        flame = read_matrix(flame_matrix, flame_order)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file, not a folder to write dyads to")
    if out.is_dir() and any(out.iterdir()):
        raise ConfigError(f"{out}: is not empty: dyads of two conversions would be mixed")
    residual = Residual()
    sets = [formats.scan_split(found, place, name, order) for name in formats.split_names(found, place)]
    if order is None:
        for one in sets:
            if said := formats.wrong_order(one, found.order):
                raise ConfigError(f"{one.split}: {said}")
    licence = next((one.licence for one in sets if one.licence), None)
    out.mkdir(parents=True, exist_ok=True)
    origin = {"layout": found.name, "folder": str(place.resolve()), "licence": licence}
    text = "# Written by `sfms-robot data convert`: whose data these dyads are.\n" + yaml.safe_dump(origin, width=1000)
    (out / formats.SOURCE).write_text(text, encoding="utf-8")
    splits = [_converted(dataset, out / dataset.split, residual, flame) for dataset in sets]
    if not any(split["clips"] for split in splits):
        (out / formats.SOURCE).unlink()
        first = next((one for split in splits for one in split["left_out"]), None)
        raise ConfigError(f"{place}: no usable clip" + (f": {first['first']}" if first else ""))
    return {
        "folder": str(place),
        "out": str(out),
        "layout": found.name,
        "licence": licence,
        "splits": splits,
        "residual": residual.told(),
        "residual_names": FIGURES,
        "notes": list(residual.notes),
    }


def _converted(dataset: Dataset, out: Path, residual: Residual, flame: FlameMatrix | None) -> Figures:
    """Convert and write every clip of a split, and compare it with the file read back; return the split's report."""
    problems, seconds, written = list(dataset.problems), 0.0, 0
    for index in tracked(range(len(dataset)), dataset.split):
        try:
            dyad = dataset[index]
            ours = guarded(dyad.name, partial(to_ours, dyad, residual, flame))
        except ClipError as error:
            problems.append(error.problem)
            continue
        clips.save(out, [ours])
        residual.written(ours, clips.read(out / f"{ours.name}.npz"))
        seconds += len(ours.listener) / ours.fps
        written += 1
    return {
        "split": dataset.split,
        "clips": written,
        "minutes": round(seconds / 60, 3),
        "left_out": [
            {"kind": kind, "count": len(found), "first": str(found[0])} for kind, found in _by_kind(problems).items()
        ],
        "notes": list(dataset.notes),
    }
