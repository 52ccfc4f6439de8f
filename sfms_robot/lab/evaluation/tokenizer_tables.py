"""`evaluate tokenizer --table`: tables III and IV of the SFMS paper on any folder of faces, and figures 9 and 10.

A row is a tokenizer, perhaps with another placement of keyframes, beside the paper's figure. The paper's figures are of
other motion (Learning2Listen, 56 FLAME coefficients), other training and unknown units: only how many times one row is
better than another can be compared.

Figures 9 and 10 plot pairs of clusters before and after coding; here they become numbers. Windows are clustered by
dynamic time warping, as in figure 10, around medoids as far from one another as possible ("highly distinctive"). For
each tokenizer: is a coded window still nearer to its own medoid than to the next one (silhouette), and how far are the
medoids from one another, relative to before (separation: below 1 they moved together)?

W windows of T frames and C channels, K clusters.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, SHAPES, Doubles
from sfms_robot.lab.corpora.clips import read_takes
from sfms_robot.lab.evaluation.metrics import dtw
from sfms_robot.lab.evaluation.table_tokenizers import (
    AS_WRITTEN,
    KEYFRAMES,
    SIZES,
    SizeName,
    TableModel,
    is_there,
    read,
)
from sfms_robot.lab.learning.corpus import first_frames, windows
from sfms_robot.listeners.sfms.placement import Strategy
from sfms_robot.signals.tracks import Take, folder_takes

ALL: Final = "all"
DYNAMIC: Final = "Dynamic (learned, ours)"
DYNAMIC_AS_WRITTEN: Final = "Dynamic (Algorithm 1, as written)"
_STATIC, _CENTRED, _EXACT = "Static (every N/k-th)", "Static, centred", "Exact"
_UNEQUAL: Final = "unequal bits"
_WINDOW_FRAMES: Final = 48  # of every recipe, as in the paper
_ANGLES: Final = slice(CHANNEL_INDEX["roll"], CHANNEL_INDEX["yaw"] + 1)
_CLUSTERS: Final = 8
_ROUNDS: Final = 20

log = logging.getLogger(__name__)


# --- rows -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Spec:
    """A row before scoring.

    Attributes:
        placement, k: Where they differ from the tokenizer's; k also where the row should show it.
        paper_e2: The paper's MSE, times 100.
        shipped: The tokenizer is in the checkout; others are trained if there is a folder for them.
    """

    name: str
    tokenizer: str
    k: int | None = None
    placement: Strategy | None = None
    paper_e2: float | None = None
    note: str = ""
    shipped: bool = True


def _table_3() -> Iterable[Spec]:
    yield Spec(name="VQ-only (no keyframe)", tokenizer="dense-vq-1024", paper_e2=0.26)
    for k, static, dynamic in zip(KEYFRAMES, (0.89, 0.64, 0.33), (0.15, 0.13, 0.12), strict=True):
        own = f"sparse-all-k{k}"
        yield Spec(name=_STATIC, tokenizer=f"{own}-static_paper", k=k, paper_e2=static)
        yield Spec(name=_CENTRED, tokenizer=f"{own}-static", k=k)
        yield Spec(name=DYNAMIC_AS_WRITTEN, tokenizer=f"{own}-{AS_WRITTEN}", k=k, paper_e2=dynamic, shipped=False)
        yield Spec(name=DYNAMIC, tokenizer=own, k=k, paper_e2=dynamic)
        yield Spec(name=_EXACT, tokenizer=own, k=k, placement="exact")
    own, one_set = "sparse-one-k10", "G = 1"
    yield Spec(name=_STATIC, tokenizer=f"{own}-static_paper", k=10, note=one_set)
    yield Spec(name=DYNAMIC, tokenizer=own, k=10, note=one_set)
    yield Spec(name=_EXACT, tokenizer=own, k=10, placement="exact", note=one_set)


def _table_4() -> Iterable[Spec]:
    yield Spec(name="L2L (VQ-256)", tokenizer="l2l-vq-256", paper_e2=1.44)
    yield Spec(name="Dense-FSQ-1024", tokenizer="dense-fsq-1024", paper_e2=0.73)
    for name, own, paper_e2 in (
        ("Sparse-VQ-256", "sparse-all-k10-vq-256", 0.05),
        ("Sparse-FSQ-256", "sparse-all-k10", 0.03),
    ):
        for ending, suffix in ((", as written", f"-{AS_WRITTEN}"), ("", "")):
            yield Spec(
                name=name + ending, tokenizer=own + suffix, k=10, paper_e2=paper_e2, note=_UNEQUAL, shipped=not ending
            )


TABLES: Final = {"3": tuple(_table_3()), "4": tuple(_table_4())}


def needed(name: str, shipped: bool = False) -> list[str]:
    """Return the names of the tokenizers that a table compares; with `shipped` only those in the checkout."""
    return list(dict.fromkeys(spec.tokenizer for spec in TABLES[name] if spec.shipped or not shipped))


@dataclass(frozen=True)
class TableRow:
    """A scored row; `values`: as in JSON; `errors` (W,) of the windows."""

    spec: Spec
    values: dict[str, Any]
    errors: Doubles

    @property
    def mse(self) -> float:
        return float(self.values["mse"])


@dataclass(frozen=True)
class TokenizerTable:
    """A scored table; `plain`: as in JSON."""

    name: str
    rows: Sequence[TableRow]
    plain: dict[str, Any]


def build(name: str, models: Mapping[str, TableModel], seen: Windows) -> TokenizerTable:
    """Score those tokenizers of a table that are present on these windows."""
    first = next(iter(models.values()))
    truth, clusters = _doubles(first.standardise(seen.motion)), None
    if len(truth) >= 4:
        clusters = Clusters.of(truth)
    rows = []
    for spec in TABLES[name]:
        if spec.tokenizer in models:
            rows.append(_scored(spec, models[spec.tokenizer], seen, clusters))
    plain = {
        "table": int(name),
        "rows": [row.values for row in rows],
        "ratios": ratios_3(rows) if name == "3" else ratios_4(rows),
        "truth_silhouette": None if clusters is None else round(integrity(truth, truth, clusters)[0], 3),
    }
    return TokenizerTable(name, rows, plain)


def _scored(spec: Spec, model: TableModel, seen: Windows, clusters: Clusters | None) -> TableRow:
    k = spec.k if spec.placement is not None else None
    motion = model.standardise(seen.motion)
    restored = model.restore(motion, spec.placement, k)
    errors, angle_rmse_rad, shape_rmse = restoration_errors(model, motion, restored)
    silhouette = separation = None
    if clusters is not None:
        silhouette, separation = (
            round(value, 3) for value in integrity(_doubles(restored), _doubles(motion), clusters)
        )
    names = np.array(seen.takes)
    values = {
        "name": spec.name,
        "tokenizer": spec.tokenizer,
        "k": spec.k,
        "params": sum(p.numel() for p in model.tokenizer.parameters()),
        "bits_per_window": round(model.bits(spec.placement, k), 1),
        "mse": float(errors.mean()),
        "median": float(np.median(errors)),
        "per_take": {take: float(errors[names == take].mean()) for take in dict.fromkeys(seen.takes)},
        "angle_rmse_rad": angle_rmse_rad,
        "shape_rmse": shape_rmse,
        "silhouette": silhouette,
        "separation": separation,
        "paper_mse_e2": spec.paper_e2,
        "note": spec.note,
    }
    return TableRow(spec, values, errors)


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


def ratios_3(rows: Sequence[TableRow]) -> dict[str, dict[str, float]]:
    """Return the MSE of dynamic over other placements by k, one keyframe set per channel, here and in the paper."""
    mse = {(row.spec.name, row.spec.k): row.mse for row in rows if not row.spec.note}
    others = {"static": _STATIC, "static_centred": _CENTRED, "exact": _EXACT}
    found = {
        f"dynamic_to_{key}": {str(k): mse[DYNAMIC, k] / mse[name, k] for k in KEYFRAMES} for key, name in others.items()
    }
    if all((DYNAMIC_AS_WRITTEN, k) in mse for k in KEYFRAMES):
        found["as_written_to_static"] = {str(k): mse[DYNAMIC_AS_WRITTEN, k] / mse[_STATIC, k] for k in KEYFRAMES}
    paper = {(spec.name, spec.k): spec.paper_e2 or 1.0 for spec in TABLES["3"] if spec.paper_e2}
    found["paper_dynamic_to_static"] = {str(k): round(paper[DYNAMIC, k] / paper[_STATIC, k], 2) for k in KEYFRAMES}
    return found


def ratios_4(rows: Sequence[TableRow]) -> dict[str, float]:
    """Return the MSE of Sparse-FSQ-256, ours and as written, over the dense and the grouped tokenizer."""
    mse = {row.spec.name: row.mse for row in rows}
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


# --- clusters -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Clusters:
    """Clusters of windows: the window that is each medoid (K,), and the cluster of each window (W,)."""

    medoids: NDArray[np.intp]
    labels: NDArray[np.intp]

    @classmethod
    def of(cls, motion: Doubles, count: int = _CLUSTERS) -> Clusters:
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
        return cls(medoids, between[:, medoids].argmin(1))


def integrity(restored: Doubles, motion: Doubles, clusters: Clusters) -> tuple[float, float]:
    """Return silhouette and separation of coded windows `restored` (W, T, C), medoids included, of `motion`.

    Silhouette: mean of (b - a) / max(a, b), a the distance to the own medoid, b to the nearest other, -1..1.
    Separation: mean distance between medoids, over that before coding.
    """
    after = warped(restored, restored[clusters.medoids])  # (W, K)
    rows = np.arange(len(after))
    own = after[rows, clusters.labels]
    other = after.copy()
    other[rows, clusters.labels] = np.inf
    nearest = other.min(1)
    others = ~np.isin(rows, clusters.medoids)  # the distance of a medoid to itself is always 0
    widths = (nearest - own) / np.maximum(np.maximum(nearest, own), 1e-12)
    apart = ~np.eye(len(clusters.medoids), dtype=bool)
    before = warped(motion[clusters.medoids], motion[clusters.medoids])[apart].mean()
    return float(widths[others].mean()), float(after[clusters.medoids][apart].mean() / before)


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


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Options of the command.

    Attributes:
        table: A key of `TABLES`, or all of them.
        data: Face tracks to score on, all held out; None: the held-out takes of the bundled motion.
        models: Folder of trained tokenizers; None: those of the checkout, without the papers' as written.
        train: Train all of them again, not only the missing ones.
        steps: Of training, in place of the size's.
        plots: Folder for pictures.
    """

    table: str
    data: Path | None = None
    models: Path | None = None
    train: bool = False
    size: SizeName = "small"
    steps: int | None = None
    jobs: int = 1
    device: Literal["auto", "cpu", "cuda"] = "auto"
    plots: Path | None = None


def evaluate_table(options: TableOptions) -> dict[str, Any]:
    """Score one table, or all; return the JSON object. Raises ConfigError, ModelError."""
    chosen = _chosen(options)
    folder = options.models or data_dir("configs") / "tokenizers"
    recorded = read_takes(data_dir("sim") / "listeners" / "takes.npz")
    held_out = recorded["held_out"] if options.data is None else folder_takes(options.data)
    wanted = list(dict.fromkeys(name for table in chosen for name in needed(table, options.models is None)))
    train_missing(options, wanted, folder, recorded)
    loaded = {name: read(folder / name) for name in wanted}
    first_name, first = next(iter(loaded.items()))
    for name, model in loaded.items():  # errors in different units cannot stand in one table
        if not torch.allclose(model.motion_std, first.motion_std, rtol=1e-2) or model.window != first.window:
            raise ConfigError(f"{folder}: {name} and {first_name} were trained on different motion: add --train")
    seen = Windows.of(held_out, first.window)
    short = [take.name for take in held_out if len(take.motion) < first.window]
    if options.data is not None and short:
        log.warning(
            "%d of %d stretches with a face are shorter than a window of %d frames and left out: %s",
            len(short), len(held_out), first.window, ", ".join(dict.fromkeys(short)),
        )  # fmt: skip
    with Console(stderr=True).status("scoring"), torch.inference_mode():
        tables = [build(name, loaded, seen) for name in chosen]
    if options.plots is not None:
        from sfms_robot.lab.evaluation.table_plots import draw

        errors = {
            f"{row.spec.name}, {row.values['bits_per_window']:,.0f} bits": row.errors
            for table in tables
            for row in table.rows
            if table.name == "4"
        }
        draw(options.plots, loaded, folder, seen.motion, seen.takes, errors)
    shared = {
        "data": "held-out takes of the bundled motion" if options.data is None else str(options.data),
        "windows": len(seen.motion),
        "unit": "mean squared error in standard deviations of the training motion",
    }
    if options.table == ALL:
        return {"table": ALL, **shared, "tables": [table.plain for table in tables]}
    return {**tables[0].plain, **shared}


def _chosen(options: TableOptions) -> Sequence[str]:
    if options.table not in (*TABLES, ALL):
        raise ConfigError(f"--table {options.table!r} is not one of {', '.join((*TABLES, ALL))}")
    if options.size not in SIZES:
        raise ConfigError(f"--size {options.size!r} is not one of {', '.join(SIZES)}")
    if options.train and options.models is None:
        raise ConfigError("--train needs --models DIR, a folder to keep the tokenizers in")
    return list(TABLES) if options.table == ALL else (options.table,)


def train_missing(options: TableOptions, wanted: Sequence[str], folder: Path, recorded: dict[str, list[Take]]) -> None:
    """Train the tokenizers of `wanted` that `folder` lacks. Raises ConfigError if that is the package's folder."""
    missing = [name for name in wanted if options.train or not is_there(folder / name)]
    if not missing:
        return
    if options.models is None:
        raise ConfigError(
            f"{folder}: {len(missing)} tokenizers of this table are not there ({missing[0]}, ...): add --models DIR, "
            "which trains what is missing, one to two minutes each, and keeps it in DIR"
        )
    from sfms_robot.lab.evaluation.table_training import train_all

    train_all(
        missing, folder, recorded["train"], Windows.of(recorded["held_out"], _WINDOW_FRAMES).motion,
        size=options.size, steps=options.steps, jobs=options.jobs, device=options.device, anew=options.train,
    )  # fmt: skip
