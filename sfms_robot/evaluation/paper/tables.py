"""The four tables: which tokenizers each needs, its rows, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from sfms_robot.evaluation.paper import bits, rows
from sfms_robot.evaluation.paper.model import TableModel
from sfms_robot.evaluation.paper.rows import Row, Spec
from sfms_robot.evaluation.paper.score import Windows

TABLES: Final = ("3", "4", "bits", "adaptive")


@dataclass(frozen=True)
class Table:
    """Rows, and figures that compare them, as plain data."""

    name: str
    rows: Sequence[Row]
    figures: Mapping[str, Any] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """As JSON tells it."""
        number = int(self.name) if self.name.isdigit() else self.name
        return {"table": number, "rows": [row.plain() for row in self.rows], **self.figures}


@dataclass(frozen=True)
class _Kind:
    specs: Sequence[Spec]
    build: Callable[[Mapping[str, TableModel], Windows], tuple[Sequence[Row], dict[str, Any]]]


def needed(name: str) -> list[str]:
    """Names of the tokenizers that a table compares."""
    return list(dict.fromkeys(spec.tokenizer for spec in _KINDS[name].specs))


def build(name: str, models: Mapping[str, TableModel], seen: Windows) -> Table:
    """Score every tokenizer of a table on these windows."""
    return Table(name, *_KINDS[name].build(models, seen))


def _three(models: Mapping[str, TableModel], seen: Windows) -> tuple[Sequence[Row], dict[str, Any]]:
    found = rows.scored(rows.TABLE_3, models, seen)
    return found, {"ratios": rows.ratios_3(found)}


def _four(models: Mapping[str, TableModel], seen: Windows) -> tuple[Sequence[Row], dict[str, Any]]:
    found = rows.scored(rows.TABLE_4, models, seen)
    return found, {"ratios": rows.ratios_4(found)}


def _bits(models: Mapping[str, TableModel], seen: Windows) -> tuple[Sequence[Row], dict[str, Any]]:
    found = bits.at_bits(models, seen)
    return found, {"bought": bits.bought(found)}


def _adaptive(models: Mapping[str, TableModel], seen: Windows) -> tuple[Sequence[Row], dict[str, Any]]:
    found = rows.scored(bits.ADAPTIVE_ROWS, models, seen)
    return found, {"ratios": bits.adaptive_ratios(found), "curve": bits.curve(models[bits.ADAPTIVE], seen)}


_KINDS: Final = {
    "3": _Kind(rows.TABLE_3, _three),
    "4": _Kind(rows.TABLE_4, _four),
    "bits": _Kind(bits.AT_BITS, _bits),
    "adaptive": _Kind(bits.ADAPTIVE_ROWS, _adaptive),
}
