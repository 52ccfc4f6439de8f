"""Tables 1, 2 and 4 of the ARIG paper: FD, RPCC, SID and Var, without the metrics that need rendered video.

The paper names its metrics without definitions; these are DIM's, whose rows it takes over (Frechet distance of the
frames of all clips, RPCC and Var flattened, SID in bits over 40 and 20 clusters of the truth). Its numbers
(`configs/papers.yaml`) are of 64 expression and 6 pose coefficients of Deep3DFaceRecon read off rendered video, ours of
52 blendshapes and 6 pose channels as sent, so only the shapes of the tables can be compared. Tables 1 and 4 of the
paper have RPCC, SID and Var of both parts together.

The papers' listeners as written are trained if they are missing, by `configs/training/KIND-as-written.yaml`: size,
steps and data of the shipped listener, and nothing beyond the paper. Their weights are used only for the tables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from sfms_robot.config import find, load_training
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE, SHAPES, Doubles
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.evaluation import metrics
from sfms_robot.lab.evaluation.intervals import LEAST_SEEDS, Chosen, bootstrap, intervals, people_of, rounded, verdict
from sfms_robot.lab.evaluation.listener_tables import PRINTED, collect, paper_rows, shared_space, spread_clips, table
from sfms_robot.lab.evaluation.metrics import cut
from sfms_robot.lab.evaluation.rollout import load_at_hop, rollouts
from sfms_robot.lab.evaluation.tokenizer_tables import PAPER_TABLES as TOKENIZER_TABLES
from sfms_robot.lab.evaluation.tokenizer_tables import evaluate_table, needed
from sfms_robot.lab.learning.arig.features import open_scenes
from sfms_robot.lab.learning.sfms.tokenizer_trainer import WEIGHTS as TOKENIZER_WEIGHTS
from sfms_robot.lab.learning.train_runs import TrainOptions, train_listener, train_tokenizer
from sfms_robot.lab.learning.training_loop import checkpoint_file
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.registry import load_listener
from sfms_robot.listeners.sfms.stream import SfmsListener

Kind = Literal["sfms", "arig"]
LABELS: Final = {"sfms": "SFMS, as written", "arig": "ARIG, as written"}
ARIG_TABLES: Final = ("arig-1", "arig-2", "arig-4", "arig-readings")
CLIP_FRAMES: Final = 250
PARTS: Final = {"exp": SHAPES, "pose": POSE}
_CLUSTERS: Final = {"exp": 40, "pose": 20}  # DIM's; the paper names none
_NAMES: Final = tuple(f"{column} {part}" for column in ("FD", "RPCC", "SID", "Var") for part in PARTS)
_OF_A_FOLDER: Final = str.maketrans(" ", "-", "/,")  # turns a row's label into the name of a folder
_LEAST_ALIKE: Final = 0.5  # least variance of comparable faces, over people's; the largest is the inverse


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Options of the papers' tables.

    Attributes:
        data: Folder of composed dyads; tables of ARIG need speaking/ and interaction/ in it.
        models: Folder of listeners and tokenizers that only tables need, trained if missing; with it each table
            includes the paper as written.
        clips: Largest number of dyads for a table.
        samples: Answers to every clip of tables 1 and 2 of SFMS.
        steps: Steps of every training, in place of those of its file.
        seed: Seed of the listeners.
        seeds: Trainings of each row of ARIG's tables, except `arig-2`.
        split: Part of the dyads; tables 3 and 4 use the held-out recordings.
        training: Training file of ARIG's ablations; None: the paper as written.
        order, hop: Options of tables 1 and 2 of SFMS; see `load_at_hop`.
    """

    data: Path
    models: Path | None
    clips: int | None
    samples: int
    steps: int | None
    seed: int
    seeds: int
    split: str
    training: Path | None = None
    order: Order | None = None
    hop: int | None = None


def scores(truth: Doubles, made: Doubles, speaker: Doubles, centres: Mapping[str, Doubles]) -> dict[str, float]:
    """Return FD, RPCC, SID and Var of expression and pose of clips (M, T, 58); an unseen speaker's face is NaN.

    RPCC is over the clips in which the speaker's face is visible throughout; it is NaN without such clips, or if one of
    the three motions is constant.
    """
    seen = np.isfinite(speaker).all(axis=(1, 2))
    found = []
    for part, where in PARTS.items():
        real, ours, other = truth[..., where], made[..., where], speaker[..., where]
        moves = seen.any() and all(np.ptp(each[seen]) > 0 for each in (real, ours, other))
        found.append((
            metrics.frechet_distance(real, ours),
            metrics.rpcc_flat(real[seen], ours[seen], other[seen]) if moves else np.nan,
            metrics.shannon_index(ours, centres[part], "bits"),
            metrics.variance(ours),
        ))  # fmt: skip
    return dict(zip(_NAMES, np.transpose(found).ravel().tolist(), strict=True))


def rows_of(
    table: str, truth: Doubles, speaker: Doubles, answers: Mapping[str, Doubles], people: Sequence[str] = ()
) -> tuple[list[Figures], list[Figures]]:
    """Return the rows of a table (truth, ours by name, the paper's), and the verdicts on the paper's statements.

    In all tables but `arig-2`, rows have the paper's RPCC, SID and Var together with ours. Answers hold the clips of
    one training after another. `people`: The listener of each clip of the truth, for intervals over people and
    trainings.
    """

    def row(name: str, source: str, values: Mapping[str, float | None]) -> Figures:
        figures = {key: rounded(value, 5) for key, value in values.items()}
        return {"name": name, "source": source, "trainings": None, **figures}

    centres, rows = metrics.centres_of(truth, PARTS, _CLUSTERS), []
    draws, count = dict[str, dict[str, Doubles]](), len(truth)
    for name, made in {"Ground truth" if table == "arig-2" else "GT": truth, **answers}.items():

        def score(clips: Chosen, made: Doubles = made) -> dict[str, float]:
            return scores(truth[clips % count], made[clips], speaker[clips % count], centres)

        trainings = len(made) // count
        draws[name] = bootstrap(score, [*people] * trainings, np.repeat(range(trainings), count).tolist())
        all_clips = row(name, "here", score(np.arange(len(made))))
        rows.append({**all_clips, "trainings": trainings, "interval": intervals(draws[name])})
    paper = paper_rows(table)
    if table == "arig-2":
        return rows + [row(name, "paper", each) for name, each in paper.items()], []
    said = claims(table, {each["name"]: each for each in rows}, draws, truth)
    rows += [row(name, "paper", dict.fromkeys(_NAMES)) for name in paper if name not in draws]
    unprinted = dict.fromkeys(PRINTED[table]["columns"])
    return [each | paper.get(each["name"], unprinted) for each in rows], said


def claims(
    table: str, rows: Mapping[str, Figures], draws: Mapping[str, Mapping[str, Doubles]], truth: Doubles
) -> list[Figures]:
    """Return verdicts on the claim that all parts make more kinds of motion, and RPCC and variance closer to people's.

    Differences are of the same people, over people and trainings (`intervals.verdict`). With fewer than three trainings
    a verdict is open. For kinds of motion it is also open if a face does not vary as people's do or is far from them,
    because noise has every kind of motion.
    """

    def alike(name: str, part: str) -> bool:
        own, people = (rows[one][f"Var {part}"] for one in (name, "GT"))
        near = rows[name][f"FD {part}"] <= metrics.variance(truth[..., PARTS[part]], "sum")
        return bool(near and _LEAST_ALIKE * people <= own <= people / _LEAST_ALIKE)

    found = []
    for name in (each for each in PRINTED[table]["ablations"] if draws.get("ARIG") and draws.get(each)):
        enough = min(rows[each]["trainings"] for each in ("ARIG", name)) >= LEAST_SEEDS
        for part in PARTS:
            for metric in ("SID", "RPCC", "Var"):
                figure = f"{metric} {part}"
                whole, less = (draws[each][figure] for each in ("ARIG", name))
                if metric == "Var":
                    whole, less = (np.abs(each - draws["GT"][figure]) for each in (whole, less))
                better = whole - less if metric == "SID" else less - whole
                interval = intervals({"": better}).get("") if enough else None
                comparable = metric != "SID" or (alike("ARIG", part) and alike(name, part))
                found.append({
                    "name": name, "figure": figure, "ARIG better by": round(float(np.mean(better)), 5),
                    "interval": interval,
                    "verdict": verdict(interval, comparable=comparable),
                })  # fmt: skip
    return found


# --- listeners that are played --------------------------------------------------------------------------------------


def arig_table(name: str, names: Sequence[str], options: TableOptions, train: bool = True) -> Figures:
    """Return one of ARIG's tables: rows of `names`, and in all tables but `arig-2` rows that are trained for the table.

    `arig-2` uses the listening set. The others use the interaction set: `arig-1` and `arig-4` have ablations, and
    `arig-readings` has readings of points that the paper leaves open.

    Args:
        name: One of `ARIG_TABLES`.
        names: Listeners, by name or folder.
        options: Options of the tables.
        train: Train missing ablations; else their rows are left out.

    Raises ConfigError.
    """
    data, models, split = options.data, options.models, options.split
    scenes = open_scenes(data, split)
    scene = "listening" if name == "arig-2" else "interaction"
    if scene not in scenes:
        raise ConfigError(f"{data / scene}: no {split} dyads, which --table {name} needs")
    held_out = [dyad for dyad in spread_clips(scenes[scene], options.clips) if len(dyad.listener) >= CLIP_FRAMES]
    if not held_out:
        raise ConfigError(f"{data}: no {split} dyad is as long as a clip of {CLIP_FRAMES} frames")
    folders = {one: [find("listeners", one, "config.yaml")] for one in names}
    if name != "arig-2" and train:
        if models is None:
            raise ConfigError(f"--table {name}: needs --models DIR, where its listeners are trained and kept")
        unchanged = "arig-as-written" if options.training is None else "arig"
        rows = {"ARIG": {}, **PRINTED[name]["ablations"]}
        folders = {
            label: [
                trained(
                    "arig",
                    options,
                    models / (label.translate(_OF_A_FOLDER).lower() if differing else unchanged),
                    file=options.training,
                    seed=None if trial == 1 else trial,
                    **differing,
                )
                for trial in range(1, options.seeds + 1)
            ]
            for label, differing in rows.items()
        } | folders
    elif models is not None:
        folders[LABELS["arig"]] = [trained("arig", options, models / "arig-as-written")]
    answers = {}
    for label, each in folders.items():
        made = [motion for one in each for motion, _ in rollouts(load_listener(one), held_out, options.seed, label)]
        answers[label] = cut(made, CLIP_FRAMES)
    truth, speaker = (cut([getattr(one, who) for one in held_out], CLIP_FRAMES) for who in ("listener", "speaker"))
    people = people_of(held_out, [len(dyad.listener) for dyad in held_out], CLIP_FRAMES)
    scored, said = rows_of(name, truth, speaker, answers, people)
    found = {"table": name, "split": split, "clips": len(truth), "frames": CLIP_FRAMES, "rows": scored}
    return found if name == "arig-2" else {**found, "claims": said}


def trained(
    kind: Kind, options: TableOptions, out: Path, file: Path | None = None, seed: int | None = None, **more: Any
) -> Path:
    """Return a folder with a listener of a paper, trained if it is missing: `out`, or OUT-seedN.

    `file`: Training file; None: the paper as written. `more`: Other fields of `TrainOptions`. Training takes half an
    hour or more of one core; an interrupted training is resumed. Raises ConfigError.
    """
    file = file or data_dir("configs") / "training" / f"{kind}-as-written.yaml"
    out = out if seed is None else out.with_name(f"{out.name}-seed{seed}")
    if load_training(file).listener.kind != kind:
        raise ConfigError(f"{file}: listener.kind is not {kind}")
    how = TrainOptions(file=file, data=options.data, out=out, steps=options.steps, seed=seed, **more)

    def begun(job: str) -> TrainOptions:
        return replace(how, resume=checkpoint_file(out, job).is_file(), tensorboard=False)

    if not (out / checkpoint.WEIGHTS).is_file():
        if kind == "sfms" and not (out / TOKENIZER_WEIGHTS).is_file():
            train_tokenizer(begun("tokenizer"))
        train_listener(begun("listener" if kind == "sfms" else "arig"))
    return out


# --- evaluate papers -------------------------------------------------------------------------------------------------

_SFMS, _ARIG = "sfms-small", "arig-small"
_TRAIN_DYADS: Final = 200  # dyads from which the heuristics compute their means
_SFMS_TABLES: Final = ("1", "2")
EVERY: Final = (*_SFMS_TABLES, *TOKENIZER_TABLES, *ARIG_TABLES)


def evaluate_papers(options: TableOptions, tables: Sequence[str], each: Callable[[str, Figures], None]) -> Figures:
    """Return the `tables` (of `EVERY`); call `each(name, table)` as soon as one is done.

    Without a folder of models the rows of trained models are left out, and `not_trained` of a table lists how to make
    them. Blocks for minutes; for hours if listeners have to be trained. An interrupted training is resumed. Raises
    ConfigError.
    """
    unknown = [name for name in tables if name not in EVERY]
    if unknown:
        raise ConfigError(f"--table {unknown[0]}: is not one of {', '.join(EVERY)}")
    found: dict[str, Figures] = {}
    models = options.models
    for name in tables:
        if name in TOKENIZER_TABLES:
            found[name] = evaluate_table(name, models=models and models / "tokenizers", steps=options.steps)
        elif name in _SFMS_TABLES:
            found[name] = sfms_table(int(name), [_SFMS], options)
        else:
            names = [_ARIG, _SFMS] if name == "arig-2" else [_ARIG]
            found[name] = arig_table(name, names, options, train=models is not None)
        if models is None:
            found[name]["not_trained"] = _not_trained(name)
        each(name, found[name])
    return {"tables": found}


def sfms_table(number: int, names: Sequence[str], options: TableOptions) -> Figures:
    """Return table 1 or 2 of SFMS for listeners by name; with a folder of models also for the paper as written."""
    data, order, samples = options.data, options.order, options.samples
    listeners = {name: load_at_hop(name, options.hop, "auto") for name in names}
    if options.models is not None:
        written = trained("sfms", options, options.models / "sfms-as-written", order=order)
        listeners[LABELS["sfms"]] = load_at_hop(str(written))
    space = shared_space(listeners)
    features = {one.frontend.audio for one in listeners.values() if isinstance(one, SfmsListener)}
    train, held_out = (
        spread_clips(open_for(space.name, data, part, order, features), most)
        for part, most in (("train", _TRAIN_DYADS), (options.split, options.clips))
    )
    seeds = range(options.seed, options.seed + samples)
    found, given = collect(number, listeners, space, train, held_out, seeds)
    return {**table(number, found, given, samples, options.seed), "split": options.split}


def _not_trained(name: str) -> dict[str, str]:
    """Return the missing rows of a table, each with the command that makes it."""
    if name in TOKENIZER_TABLES:
        lacking = set(needed(name)) - set(needed(name, shipped=True))
        return dict.fromkeys(sorted(lacking), f"evaluate tokenizer --table {name} --models DIR, minutes each")
    if name in _SFMS_TABLES:
        return {LABELS["sfms"]: "train tokenizer, then train listener, --config configs/training/sfms-as-written.yaml"}
    rows = [LABELS["arig"]] if name == "arig-2" else ["ARIG", *PRINTED[name]["ablations"]]
    return dict.fromkeys(rows, "train listener --config configs/training/arig-as-written.yaml")
