"""Behind `data`: dyads composed, and what a data set on disk holds and what is wrong with it.

Of a checked set every clip is read once, and nothing is skipped in silence.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.progress import Progress, TaskID

from sfms_robot.errors import ConfigError
from sfms_robot.frames import SPACE_CHANNELS, Doubles
from sfms_robot.lab.corpora import clips, formats
from sfms_robot.lab.corpora.clips import SEAMLESS_CHANNELS, Dyad
from sfms_robot.lab.corpora.collection import ClipError, Dataset, Layout, Order, Problem, guarded
from sfms_robot.lab.corpora.compose.composed import compose_folder
from sfms_robot.lab.corpora.conversion import CONVERTIBLE, Residual, names, to_ours
from sfms_robot.signals.spaces import FlameMatrix, read_matrix


def check_data(folder: Path, layout: str = "auto", order: Order | None = None, window: int = 0) -> dict[str, Any]:
    """Look at every split of a folder.

    Args:
        window: frames that a clip must have.

    Returns:
        layout, order, licence, and per split: clips, minutes, fps, space, frames, sound, features, channels, problems
        (kind, count, names, first detail), notes. `usable` is False when no clip can be used, or the order is swapped.

    Raises ConfigError where there is no data set at all.
    """
    found, place = formats.detect(folder, layout)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        splits = [_split(found, place, name, order, window, progress) for name in formats.split_names(found, place)]
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


def _split(
    layout: Layout, place: Path, split: str, order: Order | None, window: int, progress: Progress
) -> dict[str, Any]:
    try:
        dataset = scanned(layout, place, split, order, progress)
    except ConfigError as error:
        broken = Problem("unreadable", str(place), str(error))
        return _report(
            Dataset(layout=layout.name, split=split, space=layout.space, fps=layout.fps, clips=(), problems=(broken,)),
            _Tally(),
            {},
        )
    task = progress.add_task(split, total=len(dataset))
    tally = _Tally()

    def each(dyad: Dyad | None) -> None:
        if dyad is not None:
            tally.add(dyad)
        progress.advance(task)

    checked = dataset.checked(window, each)
    if said := formats.wrong_order(checked, order or layout.order):
        if order is None:
            checked = replace(checked, problems=(*checked.problems, Problem("swapped order", split, said)))
        else:
            checked = replace(checked, notes=(*checked.notes, said))
    counts, missing = _features(checked, progress.add_task(f"{split}: features", total=len(checked)), progress.advance)
    return _report(replace(checked, problems=(*checked.problems, *missing)), tally, counts)


def scanned(layout: Layout, place: Path, split: str, order: Order | None, progress: Progress) -> Dataset:
    """Names and headers of a split, under a bar that says so: of many files even these take their time."""
    task = progress.add_task(f"{split}: headers", total=None)
    try:
        return formats.scan_split(layout, place, split, order)
    finally:
        progress.remove_task(task)


def _features(dataset: Dataset, task: Any, advance: Callable[[Any], None]) -> tuple[dict[str, int], Sequence[Problem]]:
    """Return how many clips have each shipped feature, and the problems of the others.

    A feature that no clip has is not shipped: a count of 0, not a problem of every clip.
    """
    counts: Counter[str] = Counter()
    problems: dict[str, list[Problem]] = {}
    for clip in dataset.clips:
        for name, read in clip.features.items():
            counts[name] += 0
            try:
                guarded(clip.name, read)
                counts[name] += 1
            except ClipError as error:
                problems.setdefault(name, []).append(error.problem)
        advance(task)
    partly = [
        problem
        for name, found in problems.items()
        for problem in found
        if counts[name] or problem.kind != "missing feature"
    ]
    return dict(counts), partly


@dataclass(kw_only=True)
class _Tally:
    """Figures of the clips read so far; channels are summed up in float64."""

    low: Doubles | None = None
    high: Doubles | None = None
    total: Doubles | None = None
    square: Doubles | None = None
    frames: int = 0
    listening: int = 0
    faceless: int = 0
    sound: Counter[str] = field(default_factory=Counter)

    def add(self, dyad: Dyad) -> None:
        motion = dyad.listener.astype(np.float64)
        ends = motion.min(axis=0), motion.max(axis=0)
        sums = motion.sum(axis=0), np.square(motion).sum(axis=0)
        if self.low is None or self.high is None or self.total is None or self.square is None:
            (self.low, self.high), (self.total, self.square) = ends, sums
        else:
            self.low, self.high = np.minimum(self.low, ends[0]), np.maximum(self.high, ends[1])
            self.total, self.square = self.total + sums[0], self.square + sums[1]
        self.frames += len(motion)
        self.listening += int(dyad.listening.sum())
        self.faceless += int((~np.isfinite(dyad.speaker).all(axis=1)).sum())
        self.sound["waveform" if dyad.audio is not None else "mel" if dyad.mel is not None else "none"] += 1

    def channels(self, names: Sequence[str]) -> list[dict[str, Any]]:
        if self.low is None or self.high is None or self.total is None or self.square is None:
            return []
        mean = self.total / self.frames
        spread = np.sqrt(np.maximum(0.0, self.square / self.frames - mean**2))
        return [
            {"name": name, "min": low, "max": high, "mean": middle, "std": std}
            for name, low, high, middle, std in zip(
                names, *(np.round(row, 5).tolist() for row in (self.low, self.high, mean, spread)), strict=True
            )
        ]


def _report(dataset: Dataset, tally: _Tally, features: dict[str, int]) -> dict[str, Any]:
    width = len(tally.low) if tally.low is not None else 0
    known = {**SPACE_CHANNELS, "seamless27": SEAMLESS_CHANNELS}
    names = known.get(dataset.space) or [f"channel_{index}" for index in range(width)]
    kinds: dict[str, list[Problem]] = {}
    for problem in dataset.problems:
        kinds.setdefault(problem.kind, []).append(problem)
    lengths = dataset.lengths
    return {
        "split": dataset.split,
        "clips": len(dataset),
        "minutes": round(dataset.minutes, 3),
        "fps": dataset.fps,
        "space": dataset.space,
        "frames": {"min": min(lengths), "median": float(np.median(lengths)), "max": max(lengths)} if lengths else None,
        "sound": dict(tally.sound),
        "features": features,
        "listening_share": round(tally.listening / tally.frames, 4) if tally.frames else None,
        "speaker_unknown_frames": tally.faceless,
        "channels": tally.channels(names),
        "problems": [
            {"kind": kind, "count": len(found), "names": [one.where for one in found], "first": found[0].detail}
            for kind, found in kinds.items()
        ],
        "notes": list(dataset.notes),
        "licence": dataset.licence,
    }


def compose_dyads(data: Path, out: Path, minutes: float, seed: int, overwrite: bool = False) -> dict[str, Any]:
    """Compose into out/train, out/validation and out/test. Returns the minutes written per split."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out}: is a file, not a folder to write dyads to")
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        tasks: dict[str, TaskID] = {}

        def told(name: str, wanted: float, done: float) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(f"composing {name}", total=wanted)
            progress.update(tasks[name], completed=done)

        return dict(compose_folder(data, out, seed, minutes, told=told, overwrite=overwrite))


# --- Behind `data convert`: a data set as its authors lay it out in, dyads as `train` and `evaluate` read them out


def convert_data(
    folder: Path,
    out: Path,
    layout: str = "auto",
    order: Order | None = None,
    flame_matrix: Path | None = None,
    flame_order: str = "alphabetical",
) -> dict[str, Any]:
    """Write every split of `folder` as out/SPLIT/NAME.npz in `arkit58` at 25 fps, and out/source.yaml with their
    licence.

    One clip is held in memory at a time. Clips that cannot be used are left out and counted.

    Returns:
        folder, out, layout, licence, per split: clips, minutes, left_out (by kind, with the first), notes; `residual`:
        figures of `Residual.told`, measured on the listeners' motion; notes: parts that our space cannot show.

        Raises ConfigError for a folder without a data set, a space that cannot become ours, an `out` that is not empty,
        an invalid matrix, and where no clip can be used.
    """
    found, place = formats.detect(folder, layout)
    if found.space not in CONVERTIBLE:
        raise ConfigError(f"{place}: {found.name} is in {found.space}, which cannot become arkit58")
    flame = _matrix(found.space, flame_matrix, flame_order)
    _empty(out)
    residual = Residual()
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        sets = {name: scanned(found, place, name, order, progress) for name in formats.split_names(found, place)}
        licence = next((one.licence for one in sets.values() if one.licence), None)
        _origin(out, place, found.name, licence)
        splits = [
            _data_split(dataset, out / name, residual, flame, order or found.order, progress)
            for name, dataset in sets.items()
        ]
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
        "residual_names": dict(names()),
        "notes": list(residual.notes),
    }


def _matrix(space: str, file: Path | None, order: str) -> FlameMatrix | None:
    if file is None:
        return None
    if space != "deca56":
        raise ConfigError(f"--flame-matrix {file}: {space} has no FLAME expression (deca56 has)")
    if not file.is_file():
        raise ConfigError(f"--flame-matrix {file}: no such file")
    return read_matrix(file, order)


def _empty(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file, not a folder to write dyads to")
    if out.is_dir() and any(out.iterdir()):
        raise ConfigError(f"{out}: is not empty: dyads of two conversions would be mixed")


def _origin(out: Path, place: Path, layout: str, licence: str | None) -> None:
    out.mkdir(parents=True, exist_ok=True)
    told = {"layout": layout, "folder": str(place.resolve()), "licence": licence}
    text = "# Written by `sfms-robot data convert`: whose data these dyads are.\n" + yaml.safe_dump(told, width=1000)
    (out / formats.SOURCE).write_text(text, encoding="utf-8")


def _data_split(
    dataset: Dataset, out: Path, residual: Residual, flame: FlameMatrix | None, order: Order | None, progress: Progress
) -> dict[str, Any]:
    if said := formats.wrong_order(dataset, order):
        raise ConfigError(f"{dataset.split}: {said}")
    task = progress.add_task(dataset.split, total=len(dataset))
    problems, seconds, written = list(dataset.problems), 0.0, 0
    for index in range(len(dataset)):
        try:
            dyad = _one(dataset, index, out, residual, flame)
            seconds += len(dyad.listener) / dyad.fps
            written += 1
        except ClipError as error:
            problems.append(error.problem)
        progress.advance(task)
    kinds = {problem.kind: problem for problem in reversed(problems)}
    return {
        "split": dataset.split,
        "clips": written,
        "minutes": round(seconds / 60, 3),
        "left_out": [
            {"kind": kind, "count": sum(one.kind == kind for one in problems), "first": str(first)}
            for kind, first in kinds.items()
        ],
        "notes": list(dataset.notes),
    }


def _one(dataset: Dataset, index: int, out: Path, residual: Residual, flame: FlameMatrix | None) -> Dyad:
    """One clip converted, written, and read back. Raises ClipError for one that cannot be used."""
    dyad = dataset[index]
    converted = guarded(dyad.name, lambda: to_ours(dyad, residual, flame))
    clips.save(out, [converted])
    residual.written(converted, clips.read(out / f"{converted.name}.npz"))
    return converted
