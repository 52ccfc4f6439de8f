"""Behind `evaluate tokenizer` and `evaluate listener`: weights and dyads in, figures out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from sfms_robot.config import find
from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora import clips
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.listeners.sfms.placement import Strategy
from sfms_robot.ports import Listener

PLACEMENTS: tuple[Strategy, ...] = ("exact", "penalised", "static", "static_paper", "learned")


def _stderr() -> Console:
    return Console(stderr=True)


def evaluate_tokenizer(name: str, data: Path, order: Order | None = None) -> dict[str, Any]:
    """Held-out reconstruction error of a listener's tokenizer, by keyframe placement."""
    from sfms_robot.lab.corpora.formats import open_for
    from sfms_robot.lab.learning.sfms.features import gather
    from sfms_robot.lab.learning.sfms.tokenizer_trainer import reconstruction_error
    from sfms_robot.listeners.sfms import load as load_sfms

    listener = load_sfms(find("listeners", name, "config.yaml"), "torch")
    model = listener.model
    window = model.tokenizer.window
    dyads = open_for(listener.space.name, data, "validation", order)
    corpus = gather(dyads, window, listener.space, None, listener.settings)
    usable = [
        p for p in PLACEMENTS if (p == "penalised") == (listener.settings.placement == "penalised")
        and (p != "learned" or model.tokenizer.score is not None)
    ]  # fmt: skip
    return {
        "listener": name,
        "window": window,
        "rows": [{"name": p, "mse": reconstruction_error(model, corpus, p)} for p in usable],
    }


def evaluate_listener(
    names: Sequence[str], data: Path, seed: int, order: Order | None = None, hop: int | None = None
) -> dict[str, Any]:
    """Stream the held-out speakers of `data` through listeners: their behaviour beside that of the dyads.

    An SFMS listener also says how many keyframes it would have foreseen. `hop`: see `load_at_hop`.
    """
    from sfms_robot.lab.corpora.collection import usable
    from sfms_robot.lab.corpora.conversion import at_frame_rate
    from sfms_robot.lab.corpora.formats import open_for
    from sfms_robot.lab.evaluate.hop_choice import load_at_hop
    from sfms_robot.lab.evaluation.behaviour import behaviour
    from sfms_robot.lab.evaluation.rollout import rollouts

    dyads = [at_frame_rate(dyad) for dyad in usable(open_for("arkit58", data, "validation", order))]
    if not dyads:
        raise ConfigError(f"{data}: no dyad of validation can be read")
    rows: list[dict[str, Any]] = []
    with Progress(console=_stderr()) as progress:
        for name in names:
            listener = load_at_hop(find("listeners", name, "config.yaml"), hop)
            task = progress.add_task(name, total=len(dyads))
            motions = [one.motion[0] for one in rollouts(listener, dyads, seed, partial(progress.advance, task))]
            figures = asdict(behaviour(motions, dyads)) | _keyframe_scores(listener, dyads)
            rows.append({"name": name, "hop": listener.hop, **_nulls_for_nan(figures)})
    rows.append({"name": "dyads", **_nulls_for_nan(asdict(behaviour([dyad.listener for dyad in dyads], dyads)))})
    return {"listeners": list(names), "dyads": len(dyads), "rows": rows}


def _nulls_for_nan(figures: Mapping[str, float]) -> dict[str, float | None]:
    """None for what there was nothing to measure by: NaN is no JSON."""
    return {key: value if math.isfinite(value) else None for key, value in figures.items()}


def _keyframe_scores(listener: Listener, dyads: Sequence[clips.Dyad]) -> dict[str, float]:
    from sfms_robot.lab.learning.sfms.features import gather
    from sfms_robot.lab.learning.sfms.predictor_trainer import keyframe_scores
    from sfms_robot.listeners.sfms.stream import SfmsListener

    if not isinstance(listener, SfmsListener):
        return {}
    corpus = gather(dyads, listener.settings.window_frames, listener.space, listener.frontend, listener.settings)
    return keyframe_scores(listener.model, corpus, listener.settings)


def listener_table(
    number: int,
    names: Sequence[str],
    data: Path,
    samples: int,
    limit: int | None,
    seed: int,
    order: Order | None = None,
    hop: int | None = None,
    models: Path | None = None,
    steps: int | None = None,
) -> dict[str, Any]:
    """Table 1 or 2 of the paper for listeners and heuristics, on the validation split of any data set known.

    At most `limit` dyads, spread evenly; `hop`: see `load_at_hop`. `models`: a folder with the paper's listener as
    written, trained (for so many `steps`) where it is missing; None: without it. Raises ConfigError when the listeners
    do not share a motion space.
    """
    from sfms_robot.lab.corpora.formats import open_for
    from sfms_robot.lab.evaluate.as_written import as_written
    from sfms_robot.lab.evaluate.hop_choice import load_at_hop
    from sfms_robot.lab.evaluation.paper import listener_clips
    from sfms_robot.lab.evaluation.paper.listener_tables import table
    from sfms_robot.listeners.sfms.stream import SfmsListener

    listeners = {name: load_at_hop(find("listeners", name, "config.yaml"), hop, "auto") for name in names}
    if models is not None:
        listeners |= {
            name: load_at_hop(folder, None) for name, folder in as_written("sfms", data, models, steps, order).items()
        }
    space = listener_clips.shared_space(listeners)
    heard = {one.frontend.audio for one in listeners.values() if isinstance(one, SfmsListener)}
    train, held_out = (listener_clips.spread(open_for(space.name, data, split, order, heard), most) for split, most in
                       (("train", listener_clips.TRAIN_DYADS), ("validation", limit)))  # fmt: skip
    with Progress(console=_stderr()) as progress:
        task = progress.add_task("listening", total=len(held_out) * len(listeners))
        found, given = listener_clips.collect(
            number, listeners, space, train, held_out, range(seed, seed + samples), lambda: progress.advance(task)
        )
    return table(number, found, given, samples, seed)
