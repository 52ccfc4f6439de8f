"""Data sets too big for memory: clips known by name and length, read one at a time, and a list of problems.

Every layout of files on disk is one `Layout`. Its `scan` looks at names and headers only. Clips that cannot be used are
left out by name, as a `Problem`, never silently.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, overload

from sfms_robot.app.progress import tracked
from sfms_robot.errors import ConfigError
from sfms_robot.frames import Floats
from sfms_robot.lab.corpora.clips import UNREADABLE, Dyad

_T = TypeVar("_T")
Order = Literal["exp-first", "pose-first"]
Kind = Literal[
    "missing half", "missing sound", "missing feature", "wrong dims", "lengths differ", "not finite", "too short",
    "unreadable", "swapped order", "time stamps",
]  # fmt: skip

_NAMED: Final = 5  # problems a warning names

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Problem:
    """Something that makes a clip, a file or a feature unusable."""

    kind: Kind
    where: str
    detail: str

    def __str__(self) -> str:
        return f"{self.where}: {self.detail}"


class ClipError(ConfigError):
    """One clip cannot be used; the others can."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(str(problem))
        self.problem = problem

    @classmethod
    def of(cls, kind: Kind, where: Path | str, detail: object) -> ClipError:
        return cls(Problem(kind, str(where), str(detail).splitlines()[0] if str(detail) else type(detail).__name__))


@dataclass(frozen=True, kw_only=True)
class Clip:
    """One listener's clip: its name, frames, and how to read it.

    Attributes:
        read: Returns the dyad without features; raises ClipError or what `UNREADABLE` names.
        features: Readers of the other arrays that the layout ships about the frames, (N, F).
        row: Place in the layout's own list, before anything was left out (REACT's appropriateness matrix counts in
            it). Set by `Layout.dataset`.
    """

    name: str
    frames: int
    read: Callable[[], Dyad]
    features: Mapping[str, Callable[[], Floats]] = field(default_factory=dict)
    row: int = 0


@dataclass(frozen=True, kw_only=True)
class Dataset(Sequence[Dyad]):
    """Dyads of one split, read when asked for.

    Attributes:
        features: Names of the shipped features each dyad carries.
        problems: Clips and files that were left out, and why.
        notes: Lines for a person.
        licence: The licence that the data state; None: they state none.
    """

    layout: str
    split: str
    space: str
    fps: float
    clips: tuple[Clip, ...]
    problems: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()
    features: tuple[str, ...] = ()
    licence: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(clip.name for clip in self.clips)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Frames of each clip."""
        return tuple(clip.frames for clip in self.clips)

    @property
    def minutes(self) -> float:
        return sum(self.lengths) / self.fps / 60

    def __len__(self) -> int:
        return len(self.clips)

    @overload
    def __getitem__(self, index: int) -> Dyad: ...

    @overload
    def __getitem__(self, index: slice) -> Dataset: ...

    def __getitem__(self, index: int | slice) -> Dyad | Dataset:
        """Return one dyad, read now, or a part of the set. Raises ClipError for a clip that cannot be used."""
        if isinstance(index, slice):
            return replace(self, clips=self.clips[index])
        clip = self.clips[index]
        dyad = guarded(clip.name, clip.read)
        if not self.features:
            return dyad
        shipped = {name: guarded(clip.name, clip.features[name]) for name in self.features if name in clip.features}
        if missing := [name for name in self.features if name not in shipped]:
            raise ClipError.of("missing feature", clip.name, f"has no {', '.join(missing)}")
        return guarded(clip.name, lambda: replace(dyad, features={**dyad.features, **shipped}))

    def map(self, change: Callable[[Dyad], Dyad], space: str | None = None) -> Dataset:
        """Return the same set with every dyad changed when it is read (smoothed, in another space, with features)."""

        def changed(clip: Clip) -> Clip:
            return replace(clip, read=lambda: change(guarded(clip.name, clip.read)))

        return replace(self, space=space or self.space, clips=tuple(changed(clip) for clip in self.clips))

    def summary(self) -> str:
        """Return one line: clips and minutes, and the number that was left out."""
        left_out = Counter(problem.kind for problem in self.problems)
        said = ", ".join(f"{count} {kind}" for kind, count in left_out.items())
        return f"{self.layout} {self.split}: {len(self)} clips, {self.minutes:.1f} min" + (
            f"; left out: {said}" if said else ""
        )


def usable(dyads: Sequence[Dyad]) -> Iterator[Dyad]:
    """Yield every dyad that can be read; the others are counted and named in one warning at the end."""
    left_out = []
    for index in tracked(range(len(dyads)), "reading dyads"):
        try:
            dyad = dyads[index]
        except ClipError as error:
            left_out.append(str(error))
        else:
            yield dyad
    if left_out:
        named = "; ".join(left_out[:_NAMED]) + ("; ..." if len(left_out) > _NAMED else "")
        log.warning("%d of %d clips cannot be used: %s", len(left_out), len(dyads), named)


def guarded(where: str, read: Callable[[], _T]) -> _T:
    """Return what `read` returns; an error that a broken file causes becomes a ClipError."""
    try:
        return read()
    except ClipError:
        raise
    except (ConfigError, *UNREADABLE) as error:
        raise ClipError.of("unreadable", where, error) from error


Found = Clip | Problem | str  # str: a note for a person


def attempt(items: Iterable[_T], build: Callable[[_T], Clip]) -> Iterator[Found]:
    """Build the clip of every item; yield it, or the problem of an item that cannot be used."""
    for item in items:
        try:
            yield build(item)
        except ClipError as error:
            yield error.problem


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Layout of one family of data sets on disk.

    Attributes:
        space, fps: Of the motion.
        splits: Names of the splits in a folder, by ours (train, validation, test, ...); empty: another layout.
        scan: (root, their name of a split, whether pose channels stand first) -> clips, problems and notes. Reads
            headers only where the format allows it.
        below: Folders in which the data may lie, relative to the given one.
        order: Order of the channels in the files as they are shipped; None: there is only one.
        held_out: Share of train that serves as validation where the layout ships none.
        facts: (root, their name of a split) -> space, fps or licence where these differ from folder to folder.
    """

    name: str
    about: str
    space: str
    fps: float
    splits: Callable[[Path], Mapping[str, str]]
    scan: Callable[[Path, str, bool], Iterable[Found]]
    below: tuple[str, ...] = ("", "data")
    order: Order | None = None
    held_out: float = 0.0
    licence: str | None = None
    facts: Callable[[Path, str], Mapping[str, Any]] = lambda place, split: {}

    def root(self, folder: Path) -> Path | None:
        """Return the folder in or under the given one in which the data lie; None: another layout."""
        return next((place for name in self.below if self.splits(place := folder / name)), None)

    def dataset(self, place: Path, split: str, theirs: str, order: Order | None) -> Dataset:
        """Scan the split that the files call `theirs`. A file that several clips need is one problem."""
        found = list(self.scan(place, theirs, order == "pose-first"))
        listed = enumerate(one for one in found if not isinstance(one, str))
        facts = {"space": self.space, "fps": self.fps, "licence": self.licence, **self.facts(place, theirs)}
        return Dataset(
            layout=self.name,
            split=split,
            clips=tuple(replace(one, row=row) for row, one in listed if isinstance(one, Clip)),
            problems=tuple(dict.fromkeys(one for one in found if isinstance(one, Problem))),
            notes=tuple(one for one in found if isinstance(one, str)),
            **facts,
        )
