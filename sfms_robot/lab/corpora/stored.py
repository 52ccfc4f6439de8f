"""Dyads as `clips.save` keeps them: `{train,validation,test}/NAME.npz`: what `data compose` and `data convert` make.

What was converted has a `source.yaml` beside its splits, which says whose data they are: their licence goes along.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.config.base import read as read_yaml
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Floats
from sfms_robot.lab.corpora.clips import read
from sfms_robot.lab.corpora.collection import Clip, ClipError, Dataset, Layout, Order
from sfms_robot.lab.corpora.reading import collect, npz_shapes
from sfms_robot.lab.corpora.splits import SPLITS

SOURCE: Final = "source.yaml"
_FEATURE: Final = "feature."


def root(folder: Path) -> Path | None:
    places = (folder, *(folder / split for split in SPLITS))
    first = next((file for place in places for file in sorted(place.glob("*.npz"))[:1]), None)
    if first is None:
        return None
    try:
        return folder if "listening" in npz_shapes(first) else None
    except ClipError:
        return folder if not first.stem.endswith(("_speaker1", "_speaker2")) else None


def splits(place: Path) -> Mapping[str, str]:
    found: dict[str, str] = {split: split for split in SPLITS if next((place / split).glob("*.npz"), None)}
    return found or {"train": "."}


def scan(place: Path, split: str, order: Order | None) -> Dataset:
    files = sorted((place / split).glob("*.npz"))
    first: list[tuple[str, float]] = []

    def clip(row: int, name: str) -> Clip:
        file = files[row]
        shapes = npz_shapes(file)
        if "listening" not in shapes:
            raise ClipError.of("unreadable", file, "not a dyad: has no listening")
        kind = _kind(file, shapes)
        if not first:
            first.append(kind)
        if kind != first[0]:
            raise ClipError.of("wrong dims", file, f"{kind[0]} at {kind[1]:g} fps among {first[0][0]}")
        shipped = [key for key in shapes if key.startswith(_FEATURE)]
        features = {key.removeprefix(_FEATURE): partial(_feature, file, key) for key in shipped}
        return Clip(name=name, frames=shapes["listening"][0], row=row, read=partial(read, file), features=features)

    clips, problems = collect([(row, file.stem) for row, file in enumerate(files)], clip)
    space, fps = first[0] if first else ("arkit58", float(FRAME_HZ))
    return Dataset(
        layout="composed", split=split, space=space, fps=fps, clips=clips, problems=problems, licence=_licence(place)
    )


def _licence(place: Path) -> str | None:
    """Of what was converted; `place` may be one split of it. Raises ConfigError for a file that says something else."""
    file = next((base / SOURCE for base in (place, place.parent) if (base / SOURCE).is_file()), None)
    if file is None:
        return None
    told = read_yaml(file)
    if not isinstance(told, dict) or not isinstance(told.get("licence"), str | None):
        raise ConfigError.at(file, "licence", told.get("licence") if isinstance(told, dict) else told, "is no text")
    return told.get("licence")


def _kind(file: Path, shapes: Mapping[str, tuple[int, ...]]) -> tuple[str, float]:
    if "space" not in shapes:
        return "arkit58", float(FRAME_HZ)
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        return str(arrays["space"]), float(arrays["fps"])


def _feature(file: Path, key: str) -> Floats:
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        return np.asarray(arrays[key], np.float32)


LAYOUT: Final = Layout(
    name="composed", about="dyads of sfms-robot: {train,validation,test}/NAME.npz", space="arkit58",
    fps=float(FRAME_HZ), order=None, root=root, splits=splits, scan=scan,
)  # fmt: skip
