"""All firmware maps together: a list, and a check that the files agree with one another.

Mistakes within a map are found when it is loaded (`config.firmware`); this check compares several maps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from sfms_robot.config import FirmwareMap, load, map_files
from sfms_robot.data import Report
from sfms_robot.errors import ConfigError


class MapProblem(NamedTuple):
    """One mistake of a firmware map."""

    file: str
    problem: str


Loaded = dict[Path, FirmwareMap]


def check_maps(more: Iterable[Path]) -> list[MapProblem]:
    """Return the mistakes of the shipped maps, and of the files and folders of `more`."""
    loaded: Loaded = {}
    findings = []
    for file in [*map_files(), *_expand(more)]:
        try:
            loaded[file] = load(FirmwareMap, file)
        except ConfigError as error:
            findings.append(MapProblem(str(file), str(error).removeprefix(f"{file}: ")))
    return [*findings, *_names(loaded), *_references(loaded), *_collisions(loaded)]


def list_maps(more: Iterable[Path] = ()) -> list[Report]:
    """Return one row per model for `servo maps`. Raises ConfigError for a map that does not load."""
    rows = []
    for each in (load(FirmwareMap, file) for file in [*map_files(), *_expand(more)]):
        low, high = each.firmware.min, each.firmware.max
        rows.append(
            {
                **each.model_dump(include={"model", "vendor", "family", "protocol"}),
                "number": each.model_number,
                "firmware": "any" if (low, high) == (0, 255) else f"{low or ''}..{'' if high == 255 else high}",
                "registers": len(each.registers) or None,
                "channels": each.channels,
                "ticks_per_turn": each.ticks_per_revolution,
                "watchdog": each.watchdog,
            }
        )
    return rows


def _expand(more: Iterable[Path]) -> list[Path]:
    """Return the files, and all maps in the folders. Raises ConfigError for a folder without maps."""
    files = []
    for path in more:
        found = sorted(path.glob("**/*.yaml")) if path.is_dir() else [path]
        if not found:
            raise ConfigError(f"{path}: holds no firmware map (*.yaml)")
        files += found
    return files


def _names(loaded: Loaded) -> Iterator[MapProblem]:
    """Yield maps whose model differs from the file's name, by which maps are found, or is also that of another map."""
    first: dict[str, Path] = {}
    for file, each in loaded.items():
        if each.model != file.stem:
            yield MapProblem(str(file), f"model = {each.model!r} is not the file's name ({file.stem})")
        if each.model in first:
            yield MapProblem(str(file), f"model = {each.model!r} is also {first[each.model]}")
        first.setdefault(each.model, file)


def _references(loaded: Loaded) -> Iterator[MapProblem]:
    by_name = {each.model: each for each in loaded.values()}
    for file, each in loaded.items():
        for key, name in (("variant_of", each.variant_of), ("same_number_as", each.same_number_as)):
            other = by_name.get(name) if name else None
            if name and other is None:
                yield MapProblem(str(file), f"{key} = {name!r} has no map")
            elif other and _identity(other) != _identity(each):
                yield MapProblem(str(file), f"{key} = {name!r} has another family, protocol or model number")


def _collisions(loaded: Loaded) -> Iterator[MapProblem]:
    """Yield maps that share number and firmware, by which a servo is recognised."""
    for (_, one), (file, two) in combinations(loaded.items(), 2):
        if one.model_number is None or _identity(one) != _identity(two) or not one.firmware.overlaps(two.firmware):
            continue
        if one.model not in (two.same_number_as, two.model) and two.model != one.same_number_as:
            problem = f"model_number = {two.model_number} is also {one.model}, for some of the same firmware"
            yield MapProblem(str(file), problem)


def _identity(each: FirmwareMap) -> tuple[str, int | None, int | None]:
    return each.family, each.protocol, each.model_number
