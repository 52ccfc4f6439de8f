"""Behind `train idle`: what a trained listener leaves out of the small motion of resting faces, into its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.progress import Progress

from sfms_robot.config import find
from sfms_robot.config.listener import LISTENER_KINDS
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES
from sfms_robot.lab.corpora.collection import usable
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.corpora.resampling import at_frame_rate
from sfms_robot.lab.evaluation.rollout import rollouts
from sfms_robot.lab.learning.idle_fit import explained, fit_idle, resting
from sfms_robot.listeners.checkpoint import load_config
from sfms_robot.listeners.idle import FILE, IdleMotion
from sfms_robot.listeners.registry import one_thread

TOLD: Final = 8  # channels that move most, in the figures


def train_idle(name: str, data: Path, clips: int, seed: int) -> dict[str, Any]:
    """Roll the listener out over `clips` dyads of training, told their events, and write what its resting face lacks.

    Without the idle motion of an earlier run. Raises ConfigError for a listener that is told of no events, data that
    do not say them, or faces that never rest. Blocks for about a minute.
    """
    one_thread()
    folder = find("listeners", name, "config.yaml")
    settings = load_config(folder)
    if not settings.events:
        raise ConfigError(f"{folder}: is told of no events; what it draws at rest cannot be told from them")
    every = open_for("arkit58", data, "train")
    rows = np.linspace(0, len(every) - 1, min(clips, len(every))).round().astype(int).tolist()
    chosen = [at_frame_rate(dyad) for dyad in usable(replace(every, clips=tuple(every.clips[row] for row in rows)))]
    if not chosen or any(dyad.events is None for dyad in chosen):
        raise ConfigError(f"{data}: its dyads do not say when listeners blink and smile; what rests cannot be told")
    how = LISTENER_KINDS[settings.kind].load_folder(folder)
    with Progress(console=Console(stderr=True)) as progress:
        playing = progress.add_task(f"{name} listens", total=len(chosen))
        shown = rollouts(how, chosen, seed, lambda: progress.advance(playing))
    theirs = [resting(dyad.listener, dyad.events or (), dyad.agent_audio) for dyad in chosen]
    ours = [
        resting(one.motion[0], dyad.events or (), dyad.agent_audio) for one, dyad in zip(shown, chosen, strict=True)
    ]
    try:
        idle = fit_idle(theirs, ours)
    except ValueError as error:
        raise ConfigError(f"{data}: {error}") from None
    idle.save(folder / FILE)
    return {"out": str(folder / FILE), "dyads": len(chosen), **figures(idle)}


def figures(idle: IdleMotion) -> dict[str, Any]:
    """How many patterns, how much people differ, and the deviation that it adds to those that move most."""
    added = explained(idle)
    most = np.argsort(-added)[:TOLD]
    return {
        "patterns": len(idle.loadings),
        "spread": round(idle.spread, 3),
        "deviation": {BLENDSHAPES[at]: round(float(added[at]), 4) for at in most},
    }
