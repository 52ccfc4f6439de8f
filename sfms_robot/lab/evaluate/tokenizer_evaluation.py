"""Behind `evaluate tokenizer --table`: tokenizers loaded or trained, a table scored, pictures drawn."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import torch
from rich.console import Console

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora import takes
from sfms_robot.lab.evaluate.table_training import train_all
from sfms_robot.lab.evaluation.paper import compared_tokenizer as models
from sfms_robot.lab.evaluation.paper.compared_tokenizer import TableModel
from sfms_robot.lab.evaluation.paper.recipes import SIZES, SizeName
from sfms_robot.lab.evaluation.paper.restoration import Windows
from sfms_robot.lab.evaluation.paper.tokenizer_tables import TABLES, Table, build, needed
from sfms_robot.signals.tracks import Take, folder_takes

ALL: Final = "all"
RECORDED: Final = "takes.npz"
WINDOW_FRAMES: Final = 48  # of every recipe, as in the paper

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TableOptions:
    """What the command line says.

    Attributes:
        table: one of `TABLES`, or all of them.
        data: face tracks to score on, all held out; None: the held-out takes of the bundled motion.
        models: folder of trained tokenizers; None: those of the checkout, without the papers' as written.
        train: train them all anew; otherwise only what `models` has not.
        steps: of training, in place of the size's own.
        plots: folder for pictures.
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
    """Score one table, or all; returns what `--json` prints. Raises ConfigError, ModelError."""
    chosen = _chosen(options)
    folder = options.models or data_dir("configs") / "tokenizers"
    recorded = takes.load(data_dir("sim") / "listeners" / RECORDED)
    held_out = recorded[takes.HELD_OUT] if options.data is None else folder_takes(options.data)
    wanted = list(dict.fromkeys(name for table in chosen for name in needed(table, options.models is None)))
    train_missing(options, wanted, folder, recorded)
    loaded = {name: models.read(folder / name) for name in wanted}
    _same_scales(loaded, folder)
    window = next(iter(loaded.values())).window
    seen = Windows.of(held_out, window)
    if options.data is not None:
        _tell_short(held_out, window)
    with Console(stderr=True).status("scoring"), torch.inference_mode():
        tables = [build(name, loaded, seen) for name in chosen]
    if options.plots is not None:
        from sfms_robot.lab.evaluate.table_plots import draw

        draw(options.plots, tables, loaded, folder, seen)
    return _report(options, tables, seen)


def _chosen(options: TableOptions) -> Sequence[str]:
    if options.table not in (*TABLES, ALL):
        raise ConfigError(f"--table {options.table!r} is not one of {', '.join((*TABLES, ALL))}")
    if options.size not in SIZES:
        raise ConfigError(f"--size {options.size!r} is not one of {', '.join(SIZES)}")
    if options.train and options.models is None:
        raise ConfigError("--train needs --models DIR, a folder to keep the tokenizers in")
    return TABLES if options.table == ALL else (options.table,)


def train_missing(options: TableOptions, wanted: Sequence[str], folder: Path, recorded: dict[str, list[Take]]) -> None:
    """Train what `folder` lacks of `wanted`. Raises ConfigError where that is the package's own folder."""
    missing = [name for name in wanted if options.train or not models.is_there(folder / name)]
    if not missing:
        return
    if options.models is None:
        raise ConfigError(
            f"{folder}: {len(missing)} tokenizers of this table are not there ({missing[0]}, ...): add --models DIR, "
            "which trains what is missing, one to two minutes each, and keeps it in DIR"
        )
    examples = Windows.of(recorded[takes.HELD_OUT], WINDOW_FRAMES).motion
    train_all(
        missing, folder, recorded[takes.TRAIN], examples,
        size=options.size, steps=options.steps, jobs=options.jobs, device=options.device, anew=options.train,
    )  # fmt: skip


def _same_scales(loaded: dict[str, TableModel], folder: Path) -> None:
    """Errors in different units cannot stand in one table."""
    first_name, first = next(iter(loaded.items()))
    for name, model in loaded.items():
        if not torch.allclose(model.motion_std, first.motion_std, rtol=1e-2) or model.window != first.window:
            raise ConfigError(f"{folder}: {name} and {first_name} were trained on different motion: --train anew")


def _tell_short(stretches: Sequence[Take], window: int) -> None:
    """Somebody's own tracks: what is too short for a window is not left out in silence."""
    short = [take.name for take in stretches if len(take.motion) < window]
    if short:
        named = ", ".join(dict.fromkeys(short))
        log.warning(
            "%d of %d stretches with a face are shorter than a window of %d frames and left out: %s",
            len(short), len(stretches), window, named,
        )  # fmt: skip


def _report(options: TableOptions, tables: Sequence[Table], seen: Windows) -> dict[str, Any]:
    shared = {
        "data": "held-out takes of the bundled motion" if options.data is None else str(options.data),
        "windows": len(seen.motion),
        "unit": "mean squared error in standard deviations of the training motion",
    }
    if options.table == ALL:
        return {"table": ALL, **shared, "tables": [table.plain() for table in tables]}
    return {**tables[0].plain(), **shared}
