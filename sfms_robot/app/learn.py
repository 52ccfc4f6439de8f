"""Data and evaluation behind `data` and `evaluate`: files in, figures out."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from sfms_robot.config import find
from sfms_robot.learning.datasets import clips, composed
from sfms_robot.listeners.sfms.placement import Strategy

PLACEMENTS: tuple[Strategy, ...] = ("exact", "static", "static_paper", "learned")


def _stderr() -> Console:
    return Console(stderr=True)


def compose_dyads(data: Path, out: Path, minutes: float, seed: int) -> dict[str, Any]:
    """Compose into out/train and out/validation. Returns the minutes written per split."""
    with _stderr().status(f"composing {minutes:g} minutes of dyads"):
        return dict(composed.compose_folder(data, out, seed, minutes))


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
