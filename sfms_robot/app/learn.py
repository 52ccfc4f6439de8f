"""Data, training and evaluation behind `data`, `train` and `evaluate`: files in, figures out."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from sfms_robot import config
from sfms_robot.config import find, load
from sfms_robot.learning.datasets import clips, composed
from sfms_robot.listeners.sfms.placement import Strategy

PLACEMENTS: tuple[Strategy, ...] = ("exact", "static", "static_paper", "learned")


def _stderr() -> Console:
    return Console(stderr=True)


def compose_dyads(data: Path, out: Path, minutes: float, seed: int) -> dict[str, Any]:
    """Compose into out/train and out/validation. Returns the minutes written per split."""
    with _stderr().status(f"composing {minutes:g} minutes of dyads"):
        return dict(composed.compose_folder(data, out, seed, minutes))


def train_tokenizer(
    file: Path, data: Path, out: Path, placement: str | None = None, steps: int | None = None
) -> dict[str, Any]:
    """Phase 1, with another placement or number of steps than the file's if given. Returns its figures and minutes."""
    from sfms_robot.learning import tokenizer

    settings = load(config.Training, file)
    if placement is not None:
        settings = settings.model_copy(
            update={"listener": settings.listener.model_copy(update={"placement": placement})}
        )
    if steps is not None:
        settings = settings.model_copy(update={"tokenizer": settings.tokenizer.model_copy(update={"steps": steps})})
    began_s = time.monotonic()
    figures = tokenizer.train_tokenizer(settings, data, out)
    return {**figures, "minutes": round((time.monotonic() - began_s) / 60, 2)}


def train_listener(file: Path, data: Path, out: Path) -> dict[str, Any]:
    """Phase 2, on the tokenizer in `out`. Returns its figures and the minutes it took."""
    from sfms_robot.learning import listener

    settings = load(config.Training, file)
    began_s = time.monotonic()
    figures = listener.train_listener(settings, data, out)
    return {**figures, "minutes": round((time.monotonic() - began_s) / 60, 2)}


def evaluate_tokenizer(name: str, data: Path) -> dict[str, Any]:
    """Held-out reconstruction error of a listener's tokenizer, by keyframe placement."""
    from sfms_robot.learning.corpus import gather
    from sfms_robot.learning.tokenizer import reconstruction_error
    from sfms_robot.listeners.sfms import load as load_sfms

    listener = load_sfms(find("listeners", name, "config.yaml"))
    model = listener.model
    window = model.tokenizer.window
    corpus = gather(clips.load(data / "validation"), window, listener.space)
    usable = [p for p in PLACEMENTS if p != "learned" or model.tokenizer.score is not None]
    return {
        "listener": name,
        "window": window,
        "rows": [{"name": p, "mse": reconstruction_error(model, corpus, p)} for p in usable],
    }


def evaluate_listener(name: str, data: Path, seed: int) -> dict[str, Any]:
    """Stream the held-out speakers of `data` through a listener: its behaviour beside that of the dyads."""
    from sfms_robot.learning.rollout import evaluate_rollout
    from sfms_robot.listeners.registry import load_listener

    listener = load_listener(find("listeners", name, "config.yaml"))
    dyads = clips.load(data / "validation")
    with Progress(console=_stderr()) as progress:
        task = progress.add_task("listening", total=len(dyads))
        ours, theirs, _ = evaluate_rollout(
            listener, dyads, seed, lambda done, of: progress.update(task, completed=done)
        )
    return {
        "listener": name,
        "dyads": len(dyads),
        "rows": [{"name": name, **asdict(ours)}, {"name": "dyads", **asdict(theirs)}],
    }
