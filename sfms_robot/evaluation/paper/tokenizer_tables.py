"""Which tokenizer, placed how, is which row of the paper's tables III and IV; and what the paper measured there.

The paper's figures are of other motion (Learning2Listen, 56 FLAME coefficients), other training and unknown units:
what can be compared is how many times one row is better than another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sfms_robot.evaluation.paper.compared_tokenizer import TableModel
from sfms_robot.evaluation.paper.recipes import KEYFRAMES
from sfms_robot.evaluation.paper.restoration import Score, Windows, score
from sfms_robot.listeners.sfms.placement import Strategy

UNEQUAL: Final = "unequal bits"


@dataclass(frozen=True)
class Spec:
    """A row before it is scored.

    Attributes:
        placement, k: where they are not the tokenizer's own; k also where the row should tell it.
        paper_e2: the paper's MSE, times 100.
    """

    name: str
    tokenizer: str
    k: int | None = None
    placement: Strategy | None = None
    paper_e2: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Row:
    """A row that is scored; `bits` per window."""

    spec: Spec
    params: int
    bits: float
    score: Score

    def plain(self) -> dict[str, Any]:
        """As JSON tells it."""
        return {
            "name": self.spec.name,
            "tokenizer": self.spec.tokenizer,
            "k": self.spec.k,
            "params": self.params,
            "bits_per_window": round(self.bits, 1),
            "mse": self.score.mse,
            "median": self.score.median,
            "per_take": self.score.per_take,
            "angle_rmse_rad": self.score.angle_rmse_rad,
            "shape_rmse": self.score.shape_rmse,
            "paper_mse_e2": self.spec.paper_e2,
            "note": self.spec.note,
        }


def _table_3() -> Iterable[Spec]:
    yield Spec("VQ-only (no keyframe)", "dense-vq-1024", paper_e2=0.26)
    static, dynamic = {3: 0.89, 7: 0.64, 10: 0.33}, {3: 0.15, 7: 0.13, 10: 0.12}
    for k in KEYFRAMES:
        own = f"sparse-all-k{k}"
        yield Spec("Static (every N/k-th)", f"{own}-static_paper", k, paper_e2=static[k])
        yield Spec("Static, centred", f"{own}-static", k)
        yield Spec("Dynamic (learned)", own, k, paper_e2=dynamic[k])
        yield Spec("Exact", own, k, "exact")
    own, one_set = "sparse-one-k10", "G = 1"
    yield Spec("Static (every N/k-th)", f"{own}-static_paper", 10, note=one_set)
    yield Spec("Dynamic (learned)", own, 10, note=one_set)
    yield Spec("Exact", own, 10, "exact", note=one_set)


TABLE_3: Final = tuple(_table_3())
TABLE_4: Final = (
    Spec("L2L (VQ-256)", "l2l-vq-256", paper_e2=1.44),
    Spec("Dense-FSQ-1024", "dense-fsq-1024", paper_e2=0.73),
    Spec("Sparse-VQ-256", "sparse-all-k10-vq-256", 10, paper_e2=0.05, note=UNEQUAL),
    Spec("Sparse-FSQ-256", "sparse-all-k10", 10, paper_e2=0.03, note=UNEQUAL),
)


def scored(specs: Sequence[Spec], models: Mapping[str, TableModel], seen: Windows) -> list[Row]:
    """Score every row."""
    rows = []
    for spec in specs:
        model = models[spec.tokenizer]
        k = spec.k if spec.placement is not None else None
        bits = model.bits(spec.placement, k)
        rows.append(Row(spec, model.parameters_count, bits, score(model, seen, spec.placement, k)))
    return rows


def ratios_3(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Dynamic over the others, by k; with one keyframe set per channel."""
    mse = {(row.spec.name, row.spec.k): row.score.mse for row in rows if not row.spec.note}
    paper = {(row.spec.name, row.spec.k): row.spec.paper_e2 for row in rows if row.spec.paper_e2 is not None}
    dynamic, static = "Dynamic (learned)", "Static (every N/k-th)"
    others = {"static": static, "static_centred": "Static, centred", "exact": "Exact"}
    found = {
        f"dynamic_to_{key}": {str(k): mse[dynamic, k] / mse[name, k] for k in KEYFRAMES} for key, name in others.items()
    }
    found["paper_dynamic_to_static"] = {
        str(k): round((paper[dynamic, k] or 0.0) / (paper[static, k] or 1.0), 2) for k in KEYFRAMES
    }
    return found


def ratios_4(rows: Sequence[Row]) -> dict[str, float]:
    """Sparse-FSQ-256 over the dense and the grouped tokenizer."""
    mse = {row.spec.name: row.score.mse for row in rows}
    sparse = mse["Sparse-FSQ-256"]
    return {
        "sparse_fsq_to_dense": sparse / mse["Dense-FSQ-1024"],
        "sparse_fsq_to_l2l": sparse / mse["L2L (VQ-256)"],
        "paper_sparse_fsq_to_dense": round(0.03 / 0.73, 3),
        "paper_sparse_fsq_to_l2l": round(0.03 / 1.44, 3),
    }


Ratios = Mapping[str, Any]
_TABLES: Final[Mapping[str, tuple[Sequence[Spec], Callable[[Sequence[Row]], Ratios]]]] = {
    "3": (TABLE_3, ratios_3),
    "4": (TABLE_4, ratios_4),
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
    found = scored(specs, models, seen)
    return Table(name, found, ratios(found))
