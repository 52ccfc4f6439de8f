"""`evaluate tokenizer --table`: tables III and IV of the SFMS paper on any folder of faces, and figures 9 and 10.

Two more tables show the causes of the figures of those two: `3-placements` has every placement with the paper's
inpainter and with ours, `4-codes` both kinds of code with the same dimensions, and without rounding. The rows of all
are in `configs/tokenizer_tables.yaml`.

A row is a tokenizer, perhaps with another placement of keyframes, with the paper's figure. The paper's figures are of
other motion (Learning2Listen, 56 FLAME coefficients), other training and unknown units, so only ratios of rows can be
compared.

Figures 9 and 10 plot pairs of clusters before and after coding; here they become numbers. Windows are clustered by
dynamic time warping, as in figure 10, around medoids as far from one another as possible ("highly distinctive"). Each
tokenizer has two figures. Silhouette: whether a coded window is still closer to its own medoid than to the next one.
Separation: the distance of the medoids from one another, relative to before; below 1 they moved together.

W windows of T frames and C channels, K clusters.
"""

from __future__ import annotations

import fnmatch
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter
from torch import Tensor

from sfms_robot.app.progress import tracked
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import SHAPES, Doubles
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.clips import read_takes
from sfms_robot.lab.evaluation.intervals import LEAST_SEEDS, verdict
from sfms_robot.lab.evaluation.metrics import dtw
from sfms_robot.lab.evaluation.table_tokenizers import (
    COMPARED,
    SizeName,
    TableModel,
    load_tokenizer,
    seeded,
)
from sfms_robot.lab.evaluation.table_training import draw, train_all
from sfms_robot.lab.learning.corpus import first_frames, windows
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import ScoreNetwork, Strategy, place_learned
from sfms_robot.signals.tracks import Take, folder_takes

ALL: Final = "all"
DYNAMIC: Final = "Dynamic (learned, ours)"
DYNAMIC_AS_WRITTEN: Final = "Dynamic (Algorithm 1, as written)"
_STATIC, _CENTRED, _EXACT = "Static (every N/k-th)", "Static, centred", "Exact"
_BESIDE: Final = {"static": _STATIC, "static_centred": _CENTRED}
_KEYFRAMES: Final = (3, 7, 10)  # of table III
_ANGLES: Final = slice(0, 3)  # roll, pitch, yaw
_ROUNDS: Final = 20

log = logging.getLogger(__name__)


# --- rows -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Spec:
    """A row before scoring.

    Attributes:
        k: Keyframes of a window, if the row shows them.
        placement: Placement of keyframes, if it differs from the tokenizer's.
        rounded: True: restored from codes; False: from the values before a code was chosen.
        paper_e2: The paper's MSE, times 100.
    """

    name: str
    tokenizer: str
    k: int | None = None
    placement: Strategy | None = None
    rounded: bool = True
    paper_e2: float | None = None
    note: str = ""


TABLES: Final = TypeAdapter(dict[str, tuple[Spec, ...]]).validate_python(COMPARED["tables"])
PAPER_TABLES: Final = ("3", "4")


def needed(name: str, shipped: bool = False) -> list[str]:
    """Return the names of the tokenizers that a table compares; with `shipped` only those in the checkout."""
    found = dict.fromkeys(spec.tokenizer for spec in TABLES[name])
    return [one for one in found if one in COMPARED["shipped"] or not shipped]


def build(
    name: str, models: Mapping[str, TableModel], seen: Windows, seeds: int = 1
) -> tuple[Figures, dict[str, Doubles]]:
    """Score those tokenizers of a table that are present; return its JSON, and the errors (W,) of its rows by label.

    With several seeds a row is that of the first seed, except that `mse` is the mean and `mse_by_seed` has all.
    """
    truth = _doubles(next(iter(models.values())).standardise(seen.motion))
    clusters = cluster(truth) if len(truth) >= 4 else None
    rows, errors = list[Figures](), {}
    for spec in tracked([*TABLES[name]], f"scoring table {name}"):
        each = [_scored(spec, models[one], seen, clusters) for one in seeded(spec.tokenizer, seeds) if one in models]
        if each:
            row, wrong = each[0]
            if seeds > 1:
                mse = [one["mse"] for one, _ in each]
                row |= {"mse": float(np.mean(mse)), "mse_by_seed": mse}
            rows.append(row)
            errors[f"{spec.name}, {row['bits_per_window']:,.0f} bits"] = wrong
    wanted = {spec.name for spec in TABLES[name] if spec.tokenizer in COMPARED["shipped"]}
    whole = name in PAPER_TABLES and wanted <= {row["name"] for row in rows}  # else some ratios would lack a row
    table = {
        "table": int(name) if name in PAPER_TABLES else name,
        "rows": rows,
        **({"ratios": ratios_3(rows) if name == "3" else ratios_4(rows)} if whole else {}),
        **({"claims": claims(rows)} if name == "3-placements" else {}),
        "truth_silhouette": clusters and round(integrity(truth, truth, clusters)[0], 3),
    }
    return table, errors


def _scored(spec: Spec, model: TableModel, seen: Windows, clusters: Clusters | None) -> tuple[Figures, Doubles]:
    """Return a row as in JSON, and the squared errors (W,) of the windows."""
    motion = model.standardise(seen.motion)
    sparse = isinstance(model.tokenizer, Tokenizer)
    mask = model.mask(motion, spec.placement) if sparse else None
    restored = model.restore(motion, mask, rounded=spec.rounded)
    errors, angle_rmse_rad, shape_rmse = restoration_errors(model, motion, restored)
    shape = (None, None) if clusters is None else integrity(_doubles(restored), _doubles(motion), clusters)
    silhouette, separation = (value and round(value, 3) for value in shape)
    counts = [] if mask is None else mask.sum(1).mean(0).round().int().tolist()  # keyframes of each group
    names = np.array(seen.takes)
    return {
        "name": spec.name,
        "tokenizer": spec.tokenizer,
        "k": spec.k,
        "params": sum(p.numel() for p in model.tokenizer.parameters()),
        "steps": model.recipe.training.steps,
        "bits_per_window": round(model.bits(spec.placement, counts), 1),
        "mse": float(errors.mean()),
        "median": float(np.median(errors)),
        "per_take": {take: float(errors[names == take].mean()) for take in dict.fromkeys(seen.takes)},
        "angle_rmse_rad": angle_rmse_rad,
        "shape_rmse": shape_rmse,
        "silhouette": silhouette,
        "separation": separation,
        "paper_mse_e2": spec.paper_e2,
        "note": spec.note,
        **({} if mask is None else placed(model, motion, mask)),
    }, errors


def placed(model: TableModel, motion: Tensor, mask: Tensor) -> dict[str, float]:
    """Return figures of the keyframes of a mask (W, T, G), and of the influence of Algorithm 1's scores on them.

    keyframes: number in a track of a window; neighbours: share of keyframes with another one in the frame before or
    after; score_deviation: deviation of the scores of a window, where Gumbel noise has 1.28; draw_overlap: share of the
    keyframes that two masks drawn at the end of training have in common.
    """
    key = mask > 0.5
    beside = torch.zeros_like(key)
    beside[:, 1:] |= key[:, :-1]
    beside[:, :-1] |= key[:, 1:]
    found = {"keyframes": float(mask.sum(1).mean()), "neighbours": float((key & beside).sum() / key.sum())}
    tokenizer, phase = model.sparse(), model.recipe.training
    if tokenizer.strategy == "learned_paper" and isinstance(tokenizer.score, ScoreNetwork):
        scores, generator = tokenizer.score(motion), torch.Generator().manual_seed(0)
        first, second = (
            place_learned(scores, tokenizer.keyframes, phase.temperature[1], generator, tempered=phase.tempered_draws)[
                0
            ]
            > 0.5
            for _ in range(2)
        )
        found["score_deviation"] = float(scores.std(1).mean())
        found["draw_overlap"] = float((first & second).sum() / first.sum())
    return {name: round(value, 3) for name, value in found.items()}


def claims(rows: Sequence[Figures]) -> list[Figures]:
    """Return, by inpainter and k, the error of learned over even keyframes, and the verdict on the paper's statement.

    The paper states that learned keyframes have less error. The interval of `verdict` is the range over three seeds or
    more.
    """
    found = []
    mse = {(row["name"], row["note"], row["k"]): row.get("mse_by_seed", [row["mse"]]) for row in rows}
    for (name, note, k), ours in mse.items():
        for beside, other in _BESIDE.items():
            theirs = mse.get((other, note, k), [])
            if name not in _BESIDE.values() and theirs:
                ratios = [one / two for one, two in zip(ours, theirs, strict=False)]
                less = [1 - ratio for ratio in ratios]
                interval = (min(less), max(less)) if len(ratios) >= LEAST_SEEDS else None
                found.append({
                    "name": name, "note": note, "k": k, "over": beside, "ratio": round(float(np.mean(ratios)), 3),
                    "seeds": len(ratios), "verdict": verdict(interval),
                })  # fmt: skip
    return found


def restoration_errors(model: TableModel, motion: Tensor, restored: Tensor) -> tuple[Doubles, float, float]:
    """Return squared errors of standardised windows (W,), and the RMS errors of angles [rad] and of shapes (of 0..1).

    The squared errors are in deviations of the training motion, over all channels: the tables' MSE is their mean.
    """
    wrong = (restored - motion).double()
    plain = (wrong * model.motion_std).square().mean((0, 1))
    errors = np.asarray(wrong.square().mean(1).numpy().mean(axis=1))
    return errors, float(plain[_ANGLES].mean().sqrt()), float(plain[SHAPES].mean().sqrt())


def _doubles(motion: Tensor) -> Doubles:
    return np.asarray(motion.double().numpy(), np.float64)


def ratios_3(rows: Sequence[Figures]) -> dict[str, dict[str, float]]:
    """Return the MSE of dynamic over other placements by k, one keyframe set per channel, here and in the paper."""
    mse = {(row["name"], row["k"]): row["mse"] for row in rows if not row["note"]}
    paper_e2 = {(spec.name, spec.k): spec.paper_e2 or np.nan for spec in TABLES["3"] if not spec.note}
    pairs = {f"dynamic_to_{key}": (DYNAMIC, other) for key, other in {**_BESIDE, "exact": _EXACT}.items()}
    pairs["as_written_to_static"] = (DYNAMIC_AS_WRITTEN, _STATIC)
    found = {
        key: {str(k): mse[ours, k] / mse[other, k] for k in _KEYFRAMES}
        for key, (ours, other) in pairs.items()
        if all((ours, k) in mse for k in _KEYFRAMES)
    }
    paper = {str(k): round(paper_e2[DYNAMIC, k] / paper_e2[_STATIC, k], 2) for k in _KEYFRAMES}
    return {**found, "paper_dynamic_to_static": paper}


def ratios_4(rows: Sequence[Figures]) -> dict[str, float]:
    """Return the MSE of Sparse-FSQ-256, ours and as written, over the dense and the grouped tokenizer."""
    mse = {row["name"]: row["mse"] for row in rows}
    paper_e2 = {spec.name: spec.paper_e2 or np.nan for spec in TABLES["4"]}
    ours = {"sparse_fsq": "Sparse-FSQ-256", "sparse_fsq_as_written": "Sparse-FSQ-256, as written"}
    others = {"dense": "Dense-FSQ-1024", "l2l": "L2L (VQ-256)"}
    found = {
        f"{key}_to_{beside}": mse[name] / mse[other]
        for key, name in ours.items()
        if name in mse
        for beside, other in others.items()
    }
    for beside, other in others.items():
        found[f"paper_sparse_fsq_to_{beside}"] = round(paper_e2["Sparse-FSQ-256"] / paper_e2[other], 3)
    return found


# --- clusters -------------------------------------------------------------------------------------------------------


Clusters = tuple[NDArray[np.intp], NDArray[np.intp]]  # the window that is each medoid (K,); each window's cluster (W,)


def cluster(motion: Doubles, count: int = 8) -> Clusters:
    """Cluster windows (W, T, C): start with medoids far apart, then move each to the centre of its cluster.

    At most half as many clusters as windows.
    """
    between = warped(motion, motion)
    chosen = [int(between.sum(1).argmin())]
    while len(chosen) < min(count, len(motion) // 2):
        chosen.append(int(between[:, chosen].min(1).argmax()))
    medoids = np.array(chosen)
    for _ in range(_ROUNDS):
        labels = between[:, medoids].argmin(1)
        own = [np.flatnonzero(labels == cluster) for cluster in range(len(medoids))]
        central = np.array([rows[between[np.ix_(rows, rows)].sum(1).argmin()] for rows in own])
        if (central == medoids).all():
            break
        medoids = central
    return medoids, between[:, medoids].argmin(1)


def integrity(restored: Doubles, motion: Doubles, clusters: Clusters) -> tuple[float, float]:
    """Return silhouette and separation of coded windows `restored` (W, T, C), medoids included, of `motion`.

    Silhouette: mean of (b - a) / max(a, b), a the distance to the own medoid, b to the nearest other, -1..1.
    Separation: mean distance between medoids, over that before coding.
    """
    medoids, labels = clusters
    after, rows = warped(restored, restored[medoids]), np.arange(len(restored))  # (W, K)
    own, other = after[rows, labels], after.copy()
    other[rows, labels] = np.inf
    nearest = other.min(1)
    widths = (nearest - own) / np.maximum(np.maximum(nearest, own), 1e-12)
    apart = ~np.eye(len(medoids), dtype=bool)
    before = warped(motion[medoids], motion[medoids])[apart].mean()
    # The distance of a medoid to itself is always 0.
    return float(np.delete(widths, medoids).mean()), float(after[medoids][apart].mean() / before)


def warped(a: Doubles, b: Doubles) -> Doubles:
    """Return the warped distance (`metrics.dtw`) of every window of a (W, T, C) to every one of b (V, T, C): (W, V)."""
    return np.stack([dtw(one, b) for one in a])


# --- the command ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Windows:
    """Windows to score: `motion` (W, T, 58) in our units, and the take of each."""

    motion: Tensor
    takes: tuple[str, ...]

    @classmethod
    def of(cls, takes: Sequence[Take], window: int) -> Windows:
        """Cut all takes into consecutive windows. Raises ConfigError when no take is as long as one."""
        usable = [take for take in takes if len(take.motion) >= window]
        if not usable:
            raise ConfigError(f"none of {len(takes)} stretches with a face is as long as a window of {window} frames")
        lengths = [len(take.motion) for take in usable]
        motion = torch.cat([torch.from_numpy(take.motion) for take in usable])
        names = tuple(take.name for take in usable for _ in range(len(take.motion) // window))
        return cls(windows(motion, first_frames(lengths, window, window), window), names)


def evaluate_table(
    table: str,
    data: Path | None = None,
    models: Path | None = None,
    *,
    train: bool = False,
    size: SizeName = "small",
    steps: int | None = None,
    seeds: int = 1,
    only: str = "*",
    jobs: int = 1,
    plots: Path | None = None,
) -> Figures:
    """Score one table, or all; return the JSON object. Raises ConfigError, ModelError.

    Args:
        table: A key of `TABLES`, or `ALL` of them.
        data: Face tracks to score on, all held out; None: the held-out takes of the bundled motion.
        models: Folder of trained tokenizers; None: those of the checkout, without the papers' as written.
        train: Train all of them again, not only the missing ones.
        size: Size of the trained tokenizers.
        steps: Steps of training, in place of those of the size.
        seeds: Trainings of each tokenizer, with seeds from 1 on.
        only: Patterns of the names of tokenizers that are compared, with commas between them.
        jobs: Processes that train.
        plots: Folder for pictures.
    """
    if table not in (*TABLES, ALL):
        raise ConfigError(f"--table {table!r} is not one of {', '.join((*TABLES, ALL))}")
    if train and models is None:
        raise ConfigError("--train needs --models DIR, a folder to keep the tokenizers in")
    if seeds > 1 and models is None:
        raise ConfigError(f"--seeds {seeds}: needs --models DIR, where tokenizers of other seeds are trained and kept")
    chosen = PAPER_TABLES if table == ALL else (table,)
    folder = models or data_dir("configs") / "tokenizers"
    recorded = read_takes(data_dir("sim") / "listeners" / "takes.npz")
    held_out = recorded["held_out"] if data is None else folder_takes(data)
    names = dict.fromkeys(name for each in chosen for name in needed(each, models is None))
    compared = [fnmatch.filter(names, pattern) for pattern in only.split(",")]
    if not all(compared):
        raise ConfigError(f"--only {only}: expected patterns of tokenizers of this table (valid: {', '.join(names)})")
    wanted = [*dict.fromkeys(one for each in compared for name in each for one in seeded(name, seeds))]
    if missing := wanted if train else missing_in(folder, wanted, may_train=models is not None):
        examples = Windows.of(recorded["held_out"], 48).motion  # the length of every recipe, as in the paper
        train_all(missing, folder, recorded["train"], examples, size=size, steps=steps, jobs=jobs, again=train)
    loaded = {name: load_tokenizer(folder / name) for name in wanted}
    first_name, first = next(iter(loaded.items()))
    for name, model in loaded.items():  # one table cannot have errors in different units
        if not torch.allclose(model.motion_std, first.motion_std, rtol=1e-2) or model.window != first.window:
            raise ConfigError(f"{folder}: {name} and {first_name} were trained on different motion: add --train")
    seen = Windows.of(held_out, first.window)
    short = [take.name for take in held_out if len(take.motion) < first.window]
    if data is not None and short:
        log.warning(
            "%d of %d stretches with a face are shorter than a window of %d frames and left out: %s",
            len(short), len(held_out), first.window, ", ".join(dict.fromkeys(short)),
        )  # fmt: skip
    with torch.inference_mode():
        tables = {name: build(name, loaded, seen, seeds) for name in chosen}
    if plots is not None:
        draw(plots, loaded, folder, seen.motion, seen.takes, tables["4"][1] if "4" in tables else {})
    shared = {
        "data": "held-out takes of the bundled motion" if data is None else str(data),
        "windows": len(seen.motion),
        "unit": "mean squared error in standard deviations of the training motion",
    }
    found = [each for each, _ in tables.values()]
    return {"table": ALL, **shared, "tables": found} if table == ALL else {**found[0], **shared}


def missing_in(folder: Path, wanted: Sequence[str], may_train: bool) -> list[str]:
    """Return the tokenizers of `wanted` that `folder` lacks. Raises ConfigError if they must not be trained there."""
    files = (checkpoint.CONFIG, checkpoint.WEIGHTS)
    missing = [name for name in wanted if not all((folder / name / file).is_file() for file in files)]
    if missing and not may_train:
        raise ConfigError(
            f"{folder}: {len(missing)} tokenizers of this table are not there ({missing[0]}, ...): add --models DIR, "
            "which trains what is missing, one to two minutes each, and keeps it in DIR"
        )
    return missing
