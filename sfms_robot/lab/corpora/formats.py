"""Access to data sets of every layout: detect the layout and the splits of a folder, and open one split.

Some projects write the six pose channels first and some last, under the same file names. The order is an argument, by
default the layout's own; files that look like the other order are refused before anything is learned from them.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np

from sfms_robot.app.progress import bar
from sfms_robot.config.base import read as read_yaml
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Doubles, Floats
from sfms_robot.lab.corpora.clips import FEATURE, SPLITS, read
from sfms_robot.lab.corpora.collection import (
    OUR_NAMES,
    Clip,
    ClipError,
    Dataset,
    Found,
    Layout,
    Order,
    Problem,
    attempt,
    npz,
    npz_shapes,
)
from sfms_robot.lab.corpora.conversion import CONVERTIBLE, in_arkit
from sfms_robot.lab.corpora.external import dualtalk, l2l, react, seamless, vico

# --- Dyads as `clips.save` keeps them: `{train,validation,test}/NAME.npz`, from `data compose` and `data convert` -----

SOURCE: Final = "source.yaml"  # in the folder of converted data: their layout and licence


def _stored_splits(place: Path) -> Mapping[str, str]:
    found = {str(split): str(split) for split in SPLITS if any((place / split).glob("*.npz"))}
    first = next((file for split in ("", *found) for file in sorted((place / split).glob("*.npz"))[:1]), None)
    if first is None:
        return {}
    try:
        ours = "listening" in npz_shapes(first)
    except ClipError:
        ours = not first.stem.endswith(("_speaker1", "_speaker2"))
    return (found or {"train": "."}) if ours else {}


def _stored_kind(file: Path) -> tuple[str, float]:
    """Return space and frame rate of one dyad. Raises ClipError for a file that is not a dyad."""
    shapes = npz_shapes(file)
    if "listening" not in shapes:
        raise ClipError("unreadable", file, "not a dyad: has no listening")
    space, fps = npz(file, "space", "fps") if "space" in shapes else ("arkit58", FRAME_HZ)
    return str(space), float(fps)


def _stored_facts(place: Path, split: str) -> Mapping[str, Any]:
    """Return space and rate of the first dyad, and the licence of converted data.

    `place` may also be the folder of one split. Raises ConfigError for an invalid source.yaml.
    """
    facts: dict[str, Any] = {}
    for file in sorted((place / split).glob("*.npz")):
        try:
            facts["space"], facts["fps"] = _stored_kind(file)
            break
        except ClipError:  # listed by the scan
            continue
    source = next((base / SOURCE for base in (place, place.parent) if (base / SOURCE).is_file()), None)
    if source is not None:
        told = read_yaml(source)
        facts["licence"] = told.get("licence") if isinstance(told, dict) else told
        if not isinstance(told, dict) or not isinstance(facts["licence"], str | None):
            raise ConfigError.at(source, "licence", facts["licence"], "is not text")
    return facts


def _stored_scan(place: Path, split: str) -> Iterator[Found]:
    kinds: list[tuple[str, float]] = []

    def clip(file: Path) -> Clip:
        kinds.append(kind := _stored_kind(file))
        if kind != kinds[0]:
            raise ClipError("wrong dims", file, f"{kind[0]} at {kind[1]:g} fps among {kinds[0][0]}")
        shapes = npz_shapes(file)
        features = {key.removeprefix(FEATURE): partial(_stored_feature, file, key)
                    for key in shapes if key.startswith(FEATURE)}  # fmt: skip
        return Clip(name=file.stem, frames=shapes["listening"][0], read=partial(read, file), features=features)

    yield from attempt(sorted((place / split).glob("*.npz")), clip)


def _stored_feature(file: Path, key: str) -> Floats:
    return np.asarray(npz(file, key)[0], np.float32)


COMPOSED: Final = Layout(
    name="composed", about="dyads of sfms-robot: {train,validation,test}/NAME.npz", space="arkit58",
    fps=float(FRAME_HZ), splits=_stored_splits, scan=_stored_scan, facts=_stored_facts, below=("",),
)  # fmt: skip


# --- Every layout ---------------------------------------------------------------------------------------------------

LAYOUTS: Final = {
    layout.name: layout
    for layout in (
        l2l.LAYOUT, l2l.LM_LISTENER_LAYOUT, react.LAYOUT, react.LAYOUT_2025,
        dualtalk.ARKIT_LAYOUT, dualtalk.LAYOUT, vico.DIM, vico.VICO, seamless.LAYOUT, COMPOSED,
    )
}  # fmt: skip
_SAMPLE: Final = 8  # number of clips checked for the order of their channels
_SEED: Final = 0

log = logging.getLogger(__name__)


def detect(folder: Path, layout: str = "auto") -> tuple[Layout, Path]:
    """Return the layout of a folder and the place of the data in it. Raises ConfigError if there is none."""
    if layout != "auto" and layout not in LAYOUTS:
        raise ConfigError(f"--layout {layout}: is not known (auto, {', '.join(LAYOUTS)})")
    if not folder.is_dir():
        problem = "expected a folder, got a file (unpack an archive first)" if folder.exists() else "no such folder"
        raise ConfigError(f"{folder}: {problem}")
    tried = list(LAYOUTS.values()) if layout == "auto" else [LAYOUTS[layout]]
    # Our own layout first: converted dyads keep the names of their files, which may fit another layout.
    for candidate in sorted(tried, key=lambda one: one is not COMPOSED):
        place = candidate.root(folder)
        if place is not None:
            return candidate, place
    known = "; ".join(f"{candidate.name} ({candidate.about})" for candidate in tried)
    raise ConfigError(f"{folder}: no data set that is known here: {known}")


def split_names(layout: Layout, place: Path) -> tuple[str, ...]:
    """Return our names of the splits that `open_dataset` can open."""
    found = set(layout.splits(place))
    if "train" in found and layout.held_out:
        found.add("validation")
    return tuple(sorted(found, key=lambda name: (SPLITS.index(name) if name in SPLITS else len(SPLITS), name)))


def open_dataset(
    folder: Path,
    split: str,
    layout: str = "auto",
    order: Order | None = None,
    features: Iterable[str] = (),
) -> Dataset:
    """Open one split of a data set on disk; its dyads are read one at a time when they are accessed.

    Args:
        split: train, validation (val, valid, dev), test or another split of the layout. If the layout ships no
            validation, a share of train is held out, the same every time.
        layout: a key of `LAYOUTS`, or "auto".
        order: of the channels in the files, by default the layout's. Files that look like the other order are refused
            unless the order is given here.
        features: names of shipped features that each dyad will have.

    Clips that cannot be used are in `problems` and counted in a warning. Raises ConfigError when no clip is left.
    """
    found, place = detect(folder, layout)
    dataset = scan_split(found, place, OUR_NAMES.get(split, split), order)
    if not dataset.clips:
        why = f": {dataset.problems[0]}" if dataset.problems else ""
        raise ConfigError(f"{place}: no usable clip in {split} ({len(dataset.problems)} problems){why}")
    if order is None and (said := wrong_order(dataset, found.order)):
        raise ConfigError(f"{place}: {said}")
    dataset = replace(dataset, features=tuple(features))
    if dataset.problems:
        left_out = Counter(problem.kind for problem in dataset.problems)
        said = ", ".join(f"{count} {kind}" for kind, count in left_out.items())
        log.warning(
            "%s %s: %d clips, %.1f min; left out: %s", found.name, dataset.split, len(dataset), dataset.minutes, said
        )
    if dataset.licence is not None and dataset.split == "train":  # the split that weights are trained on
        log.warning("%s: %s", place, dataset.licence)
    return dataset


def open_for(space: str, folder: Path, split: str, order: Order | None = None, features: Iterable[str] = ()) -> Dataset:
    """Open a data set for a listener that works in `space`, in that space or in arkit58, which converts to any space.

    A set in faceverse58 is converted to arkit58. Every dyad has those of `features` that the data ship; the others are
    computed from the sound.
    """
    dataset = open_dataset(folder, split, order=order)
    dataset = replace(dataset, features=tuple(name for name in features if name in dataset.clips[0].features))
    if dataset.space in (space, "arkit58"):
        return dataset
    if dataset.space != "faceverse58":
        way = "; `sfms-robot data convert` makes arkit58 of it" if dataset.space in CONVERTIBLE else ""
        raise ConfigError(f"{folder}: {dataset.layout} is in {dataset.space}, which cannot become {space}{way}")
    return dataset.map(in_arkit, "arkit58")


def scan_split(layout: Layout, place: Path, split: str, order: Order | None = None) -> Dataset:
    """Return one split unchecked, even if empty or in the wrong order: for `data check`."""
    if order is not None and order not in get_args(Order):
        raise ConfigError(f"--order {order}: expected {' or '.join(get_args(Order))}")
    if order is not None and layout.order is None:
        raise ConfigError(f"--order {order}: {layout.name} files name their channels, there is no order to choose")
    theirs = layout.splits(place)
    if split not in split_names(layout, place):
        raise ConfigError(f"{place}: has no split {split} ({', '.join(split_names(layout, place)) or 'none'})")
    name = theirs.get(split, theirs.get("train", ""))
    with bar(f"{split}: headers"):  # reading those of many files takes some time
        found = list(layout.scan(place, name))
        facts = {"space": layout.space, "fps": layout.fps, "licence": layout.licence, **layout.facts(place, name)}
    listed = enumerate(one for one in found if not isinstance(one, str))
    whole = Dataset(
        layout=layout.name,
        split=split,
        clips=tuple(replace(one, row=row) for row, one in listed if isinstance(one, Clip)),
        # The problem of a file that several clips need counts once.
        problems=tuple(dict.fromkeys(one for one in found if isinstance(one, Problem))),
        notes=tuple(one for one in found if isinstance(one, str)),
        **facts,
    )
    if (order or layout.order) == "pose-first":  # in our order the six channels of the pose come last
        whole = whole.map(
            lambda dyad: replace(
                dyad, speaker=np.roll(dyad.speaker, -6, axis=1), listener=np.roll(dyad.listener, -6, axis=1)
            )
        )
    if "validation" in theirs or not layout.held_out or split not in ("train", "validation"):
        return whole
    rank = np.random.default_rng(_SEED).permutation(len(whole))
    first = rank < max(round(layout.held_out * len(whole)), min(1, len(whole) - 1))
    wanted = first if split == "validation" else ~first
    clips = tuple(clip for clip, use in zip(whole.clips, wanted, strict=True) if use)
    note = f"{layout.name} ships no validation: {layout.held_out:.0%} of train is held out for it"
    return replace(whole, clips=clips, notes=(*whole.notes, note))


# --- order ------------------------------------------------------------------------------------------------------


def wrong_order(dataset: Dataset, declared: Order | None) -> str | None:
    """Return one line with the right option if a sample of the set does not look like `declared`, else None."""
    if declared is None or not dataset.clips:
        return None
    sample = []
    for index in np.unique(np.linspace(0, len(dataset) - 1, _SAMPLE).astype(int)):
        try:
            sample.append(replace(dataset, features=())[int(index)].listener)
        except ClipError:  # counted when all clips are read
            continue
    seen = looks_like(sample, dataset.space, declared)
    if seen is None or seen == declared:
        return None
    return f"the files look {seen}, not {declared}: say --order {seen} (or --order {declared} if you know better)"


def looks_like(motions: Sequence[Floats], space: str, declared: Order) -> Order | None:
    """Return the order that files seem to have; `motions` (T, D) were read in the `declared` one. None: unknown.

    deca56: a jaw hardly turns about y and z while expressions vary, so the last two of the six pose columns are still.
    faceverse58: the rotation about x stays near pi, which no expression does.
    """
    if not motions or space not in ("deca56", "faceverse58"):
        return None
    filed: Doubles = np.concatenate(motions).astype(np.float64)
    if declared == "pose-first":  # undo the reordering of reading
        filed = np.concatenate([filed[:, -6:], filed[:, :-6]], axis=1)
    pose: dict[Order, Doubles] = {"pose-first": filed[:, :6], "exp-first": filed[:, -6:]}
    if space == "faceverse58":
        near = [name for name, columns in pose.items() if abs(float(np.median(columns[:, 0])) - np.pi) < 0.8]
        return near[0] if len(near) == 1 else None
    spread = {name: float(np.sqrt(np.prod(columns[:, 4:6].std(axis=0)))) for name, columns in pose.items()}
    stiller, other = sorted(spread, key=lambda name: spread[name])
    if spread[other] < 1e-6 or spread[stiller] > 0.5 * spread[other]:
        return None
    return stiller
