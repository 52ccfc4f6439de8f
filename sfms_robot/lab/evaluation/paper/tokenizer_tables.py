"""Which tokenizer, placed how, is which row of the paper's tables III and IV; and what the paper measured there.

The paper's figures are of other motion (Learning2Listen, 56 FLAME coefficients), other training and unknown units:
what can be compared is how many times one row is better than another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from torch import Tensor

from sfms_robot.frames import Doubles
from sfms_robot.lab.evaluation.paper.cluster_integrity import Clusters, Integrity, integrity
from sfms_robot.lab.evaluation.paper.compared_tokenizer import TableModel
from sfms_robot.lab.evaluation.paper.recipes import AS_WRITTEN, KEYFRAMES
from sfms_robot.lab.evaluation.paper.restoration import Score, Windows, score
from sfms_robot.listeners.sfms.placement import Strategy

UNEQUAL: Final = "unequal bits"
DYNAMIC: Final = "Dynamic (learned, ours)"
DYNAMIC_AS_WRITTEN: Final = "Dynamic (Algorithm 1, as written)"


@dataclass(frozen=True)
class Spec:
    """A row before it is scored.

    Attributes:
        placement, k: where they are not the tokenizer's own; k also where the row should tell it.
        paper_e2: the paper's MSE, times 100.
        shipped: is its tokenizer in the checkout? Others are trained where there is a folder for them.
    """

    name: str
    tokenizer: str
    k: int | None = None
    placement: Strategy | None = None
    paper_e2: float | None = None
    note: str = ""
    shipped: bool = True


@dataclass(frozen=True)
class Row:
    """A row that is scored; `bits` per window; `kept`: what is left of clusters, None for too few windows."""

    spec: Spec
    params: int
    bits: float
    score: Score
    kept: Integrity | None

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
            "silhouette": None if self.kept is None else round(self.kept.silhouette, 3),
            "separation": None if self.kept is None else round(self.kept.separation, 3),
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
        yield Spec(DYNAMIC_AS_WRITTEN, f"{own}-{AS_WRITTEN}", k, paper_e2=dynamic[k], shipped=False)
        yield Spec(DYNAMIC, own, k, paper_e2=dynamic[k])
        yield Spec("Exact", own, k, "exact")
    own, one_set = "sparse-one-k10", "G = 1"
    yield Spec("Static (every N/k-th)", f"{own}-static_paper", 10, note=one_set)
    yield Spec(DYNAMIC, own, 10, note=one_set)
    yield Spec("Exact", own, 10, "exact", note=one_set)


TABLE_3: Final = tuple(_table_3())
TABLE_4: Final = (
    Spec("L2L (VQ-256)", "l2l-vq-256", paper_e2=1.44),
    Spec("Dense-FSQ-1024", "dense-fsq-1024", paper_e2=0.73),
    Spec(
        "Sparse-VQ-256, as written",
        f"sparse-all-k10-vq-256-{AS_WRITTEN}",
        10,
        paper_e2=0.05,
        note=UNEQUAL,
        shipped=False,
    ),
    Spec("Sparse-VQ-256", "sparse-all-k10-vq-256", 10, paper_e2=0.05, note=UNEQUAL),
    Spec("Sparse-FSQ-256, as written", f"sparse-all-k10-{AS_WRITTEN}", 10, paper_e2=0.03, note=UNEQUAL, shipped=False),
    Spec("Sparse-FSQ-256", "sparse-all-k10", 10, paper_e2=0.03, note=UNEQUAL),
)


def scored(
    specs: Sequence[Spec], models: Mapping[str, TableModel], seen: Windows, clusters: Clusters | None
) -> list[Row]:
    """Score every row."""
    rows = []
    for spec in specs:
        model = models[spec.tokenizer]
        k = spec.k if spec.placement is not None else None
        bits = model.bits(spec.placement, k)
        motion = model.standardise(seen.motion)
        restored = model.restore(motion, spec.placement, k)
        kept = None if clusters is None else integrity(_doubles(restored), _doubles(motion), clusters)
        rows.append(Row(spec, model.parameters_count, bits, score(model, seen, restored), kept))
    return rows


def clusters_of(models: Mapping[str, TableModel], seen: Windows) -> Clusters | None:
    """Of the windows as they are, in the units that all of the models share; None where there are too few."""
    if len(seen.motion) < 4:
        return None
    return Clusters.of(_doubles(next(iter(models.values())).standardise(seen.motion)))


def _doubles(motion: Tensor) -> Doubles:
    return np.asarray(motion.double().numpy(), np.float64)


def ratios_3(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Dynamic over the others, by k, and as written over static; with one keyframe set per channel."""
    mse = {(row.spec.name, row.spec.k): row.score.mse for row in rows if not row.spec.note}
    paper = {(row.spec.name, row.spec.k): row.spec.paper_e2 for row in rows if row.spec.paper_e2 is not None}
    static = "Static (every N/k-th)"
    others = {"static": static, "static_centred": "Static, centred", "exact": "Exact"}
    found = {
        f"dynamic_to_{key}": {str(k): mse[DYNAMIC, k] / mse[name, k] for k in KEYFRAMES} for key, name in others.items()
    }
    if all((DYNAMIC_AS_WRITTEN, k) in mse for k in KEYFRAMES):
        found["as_written_to_static"] = {str(k): mse[DYNAMIC_AS_WRITTEN, k] / mse[static, k] for k in KEYFRAMES}
    found["paper_dynamic_to_static"] = {
        str(k): round((paper[DYNAMIC, k] or 0.0) / (paper[static, k] or 1.0), 2) for k in KEYFRAMES
    }
    return found


def ratios_4(rows: Sequence[Row]) -> dict[str, float]:
    """Sparse-FSQ-256, ours and as written, over the dense and the grouped tokenizer."""
    mse = {row.spec.name: row.score.mse for row in rows}
    ours = {"sparse_fsq": "Sparse-FSQ-256", "sparse_fsq_as_written": "Sparse-FSQ-256, as written"}
    others = {"dense": "Dense-FSQ-1024", "l2l": "L2L (VQ-256)"}
    return {
        **{
            f"{key}_to_{beside}": mse[name] / mse[other]
            for key, name in ours.items()
            if name in mse
            for beside, other in others.items()
        },
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
    silhouette: float | None

    def plain(self) -> dict[str, Any]:
        """As JSON tells it; `truth_silhouette`: of the windows as they are."""
        rows = [row.plain() for row in self.rows]
        return {"table": int(self.name), "rows": rows, "ratios": self.ratios, "truth_silhouette": self.silhouette}


def needed(name: str, shipped: bool = False) -> list[str]:
    """Names of the tokenizers that a table compares; those alone that the checkout has, where `shipped`."""
    return list(dict.fromkeys(spec.tokenizer for spec in _TABLES[name][0] if spec.shipped or not shipped))


def build(name: str, models: Mapping[str, TableModel], seen: Windows) -> Table:
    """Score those tokenizers of a table that are at hand on these windows."""
    specs, ratios = _TABLES[name]
    clusters = clusters_of(models, seen)
    found = scored([spec for spec in specs if spec.tokenizer in models], models, seen, clusters)
    return Table(name, found, ratios(found), _silhouette(models, seen, clusters))


def _silhouette(models: Mapping[str, TableModel], seen: Windows, clusters: Clusters | None) -> float | None:
    """Of the windows as they are."""
    if clusters is None:
        return None
    motion = _doubles(next(iter(models.values())).standardise(seen.motion))
    return round(integrity(motion, motion, clusters).silhouette, 3)
