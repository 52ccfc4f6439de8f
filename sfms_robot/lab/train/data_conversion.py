"""Behind `data convert`: a data set as its authors lay it out in, dyads as `train` and `evaluate` read them out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.progress import Progress

from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora import clips, formats, stored
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import ClipError, Dataset, Order, guarded
from sfms_robot.lab.corpora.conversion import CONVERTIBLE, Residual, names, to_ours
from sfms_robot.lab.train.datasets import scanned
from sfms_robot.signals.spaces import FlameMatrix, read_matrix


def convert_data(
    folder: Path,
    out: Path,
    layout: str = "auto",
    order: Order | None = None,
    flame_matrix: Path | None = None,
    flame_order: str = "alphabetical",
) -> dict[str, Any]:
    """Every split of `folder` as out/SPLIT/NAME.npz in `arkit58` at 25 fps, and out/source.yaml with their licence.

    One clip is held in memory at a time. What cannot be used is left out and counted.

    Returns:
        folder, out, layout, licence, per split: clips, minutes, left_out (by kind, with the first), notes; `residual`:
        figures of `Residual.told`, measured on the listeners' motion; notes: what our space cannot show.

    Raises ConfigError for a folder that is no data set, a space that cannot become ours, an `out` that holds something,
    a matrix that is none, and where no clip can be used.
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
            _split(dataset, out / name, residual, flame, order or found.order, progress)
            for name, dataset in sets.items()
        ]
    if not any(split["clips"] for split in splits):
        (out / stored.SOURCE).unlink()
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
    (out / stored.SOURCE).write_text(text, encoding="utf-8")


def _split(
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
