"""Tables III and IV: which tokenizers each needs, its rows, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sfms_robot.evaluation.paper import rows
from sfms_robot.evaluation.paper.model import TableModel
from sfms_robot.evaluation.paper.rows import Row, Spec
from sfms_robot.evaluation.paper.score import Windows

Ratios = Mapping[str, Any]
_TABLES: Final[Mapping[str, tuple[Sequence[Spec], Callable[[Sequence[Row]], Ratios]]]] = {
    "3": (rows.TABLE_3, rows.ratios_3),
    "4": (rows.TABLE_4, rows.ratios_4),
}
TABLES: Final = tuple(_TABLES)


@dataclass(frozen=True)
class Table:
    """Rows, and figures that compare them, as plain data."""

    name: str
    rows: Sequence[Row]
    ratios: Ratios

    def plain(self) -> dict[str, Any]:
        """As JSON tells it."""
        return {"table": int(self.name), "rows": [row.plain() for row in self.rows], "ratios": self.ratios}


def needed(name: str) -> list[str]:
    """Names of the tokenizers that a table compares."""
    return list(dict.fromkeys(spec.tokenizer for spec in _TABLES[name][0]))


def build(name: str, models: Mapping[str, TableModel], seen: Windows) -> Table:
    """Score every tokenizer of a table on these windows."""
    specs, ratios = _TABLES[name]
    found = rows.scored(specs, models, seen)
    return Table(name, found, ratios(found))
