"""`evaluate timing`: meetings are played to a listener, and its nods compared with those of the people.

Processes take one participant each; what is random about a participant hangs on the seed and on his place in the tables
alone, so that the figures do not depend on how many processes there are.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

from sfms_robot.app.evaluate.hop_choice import load_at_hop
from sfms_robot.config import find
from sfms_robot.corpora.compose.ami import Person, read_people, series
from sfms_robot.corpora.compose.motions import Motions
from sfms_robot.corpora.compose.motions import load as load_motions
from sfms_robot.corpora.compose.voices import Voice, find_voices
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.evaluation import nod_table
from sfms_robot.evaluation import timing as evaluation
from sfms_robot.evaluation.rollout import rollout
from sfms_robot.listeners.registry import one_thread
from sfms_robot.ports import Listener

TABLE: Final = "nod_table.yaml"  # in sim/listeners
_COMMENT: Final = """Nods and minutes of listening by speech phase, per series of meetings (`evaluation.nod_table`).
Counted in: The AMI Meeting Corpus, AMI project consortium (Carletta et al. 2005), manual annotations 1.7, CC BY 4.0,
http://groups.inf.ed.ac.uk/ami/corpus/; annotations taken from github Hasetomo2142/ami-corpus-preprocessing, commit
6d845bc07b21c8862afbf38f1b1f9ab3bf40c437. Made by
  sfms-robot evaluate timing --data DIR --fit-table sim/listeners/nod_table.yaml"""


@dataclass(frozen=True)
class _Part:
    """One participant's turn."""

    person: Person
    number: int
    minutes: float | None
    seeds: int
    seed: int
    hop: int | None


def evaluate_timing(
    name: str,
    data: Path,
    seeds: int,
    people: int | None,
    minutes: float | None,
    seed: int,
    jobs: int | None,
    hop: int | None = None,
) -> dict[str, Any]:
    """Figures of design section 4 and more; None where the meetings hold too little to tell.

    `people` and `minutes` (of each) bound what is played; `hop`: see `load_at_hop`. Raises ConfigError or ModelError.
    """
    folder = find("listeners", name, "config.yaml")
    everybody = read_people(tables(data))
    chosen = evaluation.choose_people(everybody, people)
    parts = [_Part(person, everybody.index(person), minutes, seeds, seed, hop) for person in chosen]
    table = nod_table.load(data_dir("sim") / "listeners" / TABLE)
    heard_by = load_at_hop(folder, hop)  # what is wrong with it is said here, not by a process
    played = dict(_play_all(folder, parts, jobs or os.cpu_count() or 1))
    pairs = [played[number] for number in sorted(played)]
    scenes, answers = [scene for scene, _ in pairs], [answer for _, answer in pairs]
    found, ranks = evaluation.summary(scenes, answers, table, seed)
    known = sorted({one.series for one in scenes} & set(table.series))
    return {
        "listener": name,
        "people": len(scenes),
        "minutes": round(sum(scene.minutes for scene in scenes), 2),
        "seeds": seeds,
        "hop": heard_by.hop,
        **found,
        "nod_auc_people": len(ranks),
        "table": f"bundled, without the series of each person ({', '.join(known)})" if known else "bundled",
        "rows": _rows(name, found),
    }


def fit_table(data: Path, out: Path) -> dict[str, Any]:
    """Write the nod table of all people of `data`. Returns what went into it."""
    people = read_people(tables(data))
    table = evaluation.fit_table(people)
    nod_table.save(out, table, _COMMENT)
    total = nod_table.Counts.total(table.series.values())
    return {
        "table": str(out),
        "people": len(people),
        "series": sorted(table.series),
        "nods": int(total.nods.sum()),
        "listening_minutes": round(float(total.minutes.sum()), 1),
        "rows": [
            {"series": key, "people": sum(series(p.meeting) == key for p in people)} for key in sorted(table.series)
        ],
    }


def tables(data: Path) -> Path:
    """The folder of AMI tables: `data`, or its ami_listener_annotations."""
    if not data.is_dir():
        raise ConfigError(f"--data {data}: no such folder")
    inside = data / "ami_listener_annotations"
    return inside if inside.is_dir() else data


def _play_all(
    folder: Path, parts: Sequence[_Part], jobs: int
) -> Iterator[tuple[int, tuple[evaluation.Scene, evaluation.Answer]]]:
    console = Console(stderr=True)
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("people listening", total=len(parts))
        workers = min(jobs, len(parts))
        if workers == 1:
            for part in parts:
                yield part.number, _play(folder, part)
                progress.advance(task)
            return
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=one_thread)
        try:
            waiting = {pool.submit(_play, folder, part): part.number for part in parts}
            for done in as_completed(waiting):
                yield waiting[done], done.result()
                progress.advance(task)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _play(folder: Path, part: _Part) -> tuple[evaluation.Scene, evaluation.Answer]:
    """One participant's stretch through the listener, once per seed; the scene comes back without its frames."""
    voices, motions = _bundled()
    rng = np.random.default_rng([part.seed, part.number])
    scene = evaluation.scene(part.person, part.minutes, voices, motions, rng)
    first = 1000 * (part.seed + part.number)
    played = rollout(_listener(folder, part.hop), scene.speaker, range(first, first + part.seeds)).motion
    return replace(scene, speaker=()), evaluation.observe(played)


@cache
def _listener(folder: Path, hop: int | None) -> Listener:
    return load_at_hop(folder, hop)


@cache
def _bundled() -> tuple[tuple[Voice, ...], Motions]:
    sim = data_dir("sim")
    return tuple(find_voices([sim / "speakers"])), load_motions(sim / "listeners" / "motions.npz")["validation"]


def _rows(name: str, found: dict[str, float | None]) -> list[dict[str, Any]]:
    """One row per figure: the listener's (or the table's), and the people's where they have one."""
    beside = {"smiles_per_minute": "people_laughs_per_minute"}  # nobody annotated smiles
    return [
        {"figure": key.replace("_", " "), name: value, "people": found.get(beside.get(key, f"people_{key}"))}
        for key, value in found.items()
        if not key.startswith("people_")
    ]
