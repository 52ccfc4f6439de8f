"""Beyond the paper's tables: error at equal total bits, and one tokenizer for every number of keyframes.

The tables compare codes of very different lengths. Here every kind of tokenizer gets more or fewer codes, sparse ones
pay for the places of their keyframes, and what counts is the least error that a number of bits buys.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from sfms_robot import config
from sfms_robot.evaluation.paper.model import TableModel
from sfms_robot.evaluation.paper.recipes import KEYFRAMES, MOST_KEYFRAMES, SPARSE_AT_BITS
from sfms_robot.evaluation.paper.rows import Row, Spec, scored
from sfms_robot.evaluation.paper.score import Windows
from sfms_robot.evaluation.rate import rate_distortion
from sfms_robot.listeners.sfms.placement import Strategy

FAMILIES: Final = ("sparse", "dense", "grouped")
BUDGETS: Final = (200, 400, 800, 1600, 3200, 6400)  # bits a window
GOAL_FROM_BITS: Final = 200
ADAPTIVE: Final = "sparse-all-adaptive"
TOLERANCES: Final = (0.3, 0.1, 0.03, 0.01)  # mean squared error of a channel, in deviations

_SPARSE = (*(name for name, *_ in SPARSE_AT_BITS), "sparse-one-k10", "sparse-four-k10",
           *(f"sparse-all-k{k}" for k in KEYFRAMES))  # fmt: skip
_DENSE = ("dense-fsq-1024", *(f"dense-fsq-1024x{n}" for n in (2, 4, 8)))
_GROUPED = ("l2l-vq-256", *(f"l2l-vq-256x{n}" for n in (4, 8, 16, 32, 64)))

AT_BITS: Final = tuple(
    Spec(name, name, note=family)
    for family, names in zip(FAMILIES, (_SPARSE, _DENSE, _GROUPED), strict=True)
    for name in names
)


def at_bits(models: Mapping[str, TableModel], seen: Windows) -> list[Row]:
    """Every tokenizer as a point of error over bits, by family.

    Where placement is learned the masks are exact here: an encoder may take its time, and its places are paid for.
    """
    specs = []
    for spec in AT_BITS:
        settings = models[spec.tokenizer].recipe.model
        if isinstance(settings, config.Sfms):
            own = next(iter(settings.groups.values())).keyframes
            spec = replace(spec, k=own, placement="exact" if settings.placement == "learned" else settings.placement)
        specs.append(spec)
    return sorted(scored(specs, models, seen), key=lambda row: (FAMILIES.index(row.spec.note), row.bits))


def bought(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The least error of each family within each of `BUDGETS`, and whether sparse is below both others."""
    found = []
    for budget in BUDGETS:
        least = {family: least_error(rows, family, budget) for family in FAMILIES}
        others = [least[family] for family in FAMILIES[1:]]
        sparse = least["sparse"]
        wins = sparse is not None and all(other is None or sparse < other for other in others)
        found.append({"bits": budget, **least, "sparse_is_least": wins})
    return found


def least_error(rows: Sequence[Row], family: str, bits: float) -> float | None:
    """Of a family's tokenizers that need no more than so many bits; None where there is none."""
    affordable = [row.score.mse for row in rows if row.spec.note == family and row.bits <= bits]
    return min(affordable, default=None)


def _adaptive_specs() -> tuple[Spec, ...]:
    placed: tuple[tuple[str, Strategy], ...] = (("told k", "learned"), ("nested", "nested"), ("exact", "exact"))
    found = []
    for k in KEYFRAMES:
        found.append(Spec("fixed k", f"sparse-all-k{k}", k, "learned"))
        found += [Spec(f"k drawn, {name}", ADAPTIVE, k, placement) for name, placement in placed]
    return tuple(found)


ADAPTIVE_ROWS: Final = _adaptive_specs()


def adaptive_ratios(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """One tokenizer for every k over the one trained for this k, by k."""
    mse = {(row.spec.name, row.spec.k): row.score.mse for row in rows}
    return {
        key: {str(k): mse[name, k] / mse["fixed k", k] for k in KEYFRAMES}
        for key, name in (("told_to_fixed", "k drawn, told k"), ("nested_to_fixed", "k drawn, nested"))
    }


def curve(model: TableModel, seen: Windows) -> list[dict[str, Any]]:
    """Nested prefixes: every fixed k, then every tolerance, as points of error over bits."""
    settings, tokenizer = model.recipe.model, model.sparse()
    codes = [group.codes for group in settings.groups.values()] if isinstance(settings, config.Sfms) else []
    return rate_distortion(tokenizer, model.standardise(seen.motion), codes, TOLERANCES, MOST_KEYFRAMES)
