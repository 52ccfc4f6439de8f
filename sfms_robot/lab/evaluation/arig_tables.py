"""Tables 1, 2 and 4 of the ARIG paper, without those metrics that need rendered video: FD, RPCC, SID and Var.

The paper names its metrics without definitions; these are DIM's, whose rows it takes over (Frechet distance per clip,
RPCC and Var flattened, SID in bits over 40 and 20 clusters of the truth). Its numbers are of 64 expression and 6 pose
coefficients of Deep3DFaceRecon read off rendered video, ours of 52 blendshapes and 6 pose channels as sent: compare
shapes. Tables 1 and 4 of the paper give RPCC, SID and Var of both parts together.

The papers' listeners as written are trained where they are missing, as `configs/training/KIND-as-written.yaml` says:
size, steps and data of the shipped listener, and nothing beyond the paper. Their weights serve the tables alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np

from sfms_robot.app.progress import tracked
from sfms_robot.config import find, load_training
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE, SHAPES, Doubles
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.evaluation import metrics
from sfms_robot.lab.evaluation.intervals import LEAST_SEEDS, Chosen, bootstrap, intervals, people_of, verdict
from sfms_robot.lab.evaluation.listener_tables import collect, shared_space, spread_clips, table
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
ARIG_TABLES: Final = ("arig-1", "arig-2", "arig-4")
CLIP_FRAMES: Final = 250
PARTS: Final[Mapping[str, slice]] = {"exp": SHAPES, "pose": POSE}
_CLUSTERS: Final = {"exp": 40, "pose": 20}  # DIM's; the paper names none
_NAMES: Final = tuple(f"{column} {part}" for column in ("FD", "RPCC", "SID", "Var") for part in PARTS)

_PAPER_2: Final[Mapping[str, tuple[float | None, ...]]] = {  # table 2, on ViCo
    "RLHG": (39.02, 0.07, 0.08, 0.02, 3.62, 3.17, 1.52, 0.02),
    "L2L": (33.93, 0.06, 0.06, 0.08, 2.77, 2.66, 0.83, 0.02),
    "DIM": (23.88, 0.06, 0.06, 0.03, 3.71, 2.35, 1.53, 0.02),
    "INFP": (18.63, 0.07, None, None, 4.78, 3.92, 2.83, 0.18),
    "ARIG": (18.39, 0.06, 0.05, 0.01, 4.82, 3.94, 2.91, 0.17),
}
_PAPER: Final[Mapping[int, Mapping[str, tuple[float, ...]]]] = {  # tables 1 (on RealTalk) and 4: RPCC, SID, Var
    1: {
        "DIM": (0.186, 1.083, 1.206),
        "GT": (0.0, 2.902, 2.514),
        "ARIG": (0.125, 2.428, 2.397),
        "w/o long-range context": (0.140, 2.381, 2.326),
        "w/o conversational state guidance": (0.127, 2.263, 2.174),
        "w/o visual modality in IBU": (0.155, 2.115, 2.032),
    },
    4: {
        "w/o continuous AR modeling": (0.129, 2.261, 2.154),
        "w/o bidirectional-integrated learning": (0.173, 2.138, 2.016),
        "ARIG": (0.125, 2.428, 2.397),
    },
}
# Other readings of what the paper leaves open, trained beside table 1: changes of the training, of the listener.
READINGS: Final[Mapping[str, Mapping[str, Mapping[str, Any]]]] = {
    "ARIG, states fed back": {"phase_changes": {"own_states": True}},
    "ARIG, fine noise levels": {"changes": {"diffusion": {"schedule": "logarithmic"}}},
    "ARIG, both": {"phase_changes": {"own_states": True}, "changes": {"diffusion": {"schedule": "logarithmic"}}},
}
_LEAST_ALIKE: Final = 0.5  # variance of faces that can be compared, over people's; at most its inverse
# Changes to the listener's configuration behind the ablations' rows.
ABLATIONS: Final[Mapping[int, Mapping[str, Mapping[str, Any]]]] = {
    1: {
        "w/o long-range context": {"context_chunks": 4},
        "w/o conversational state guidance": {"state_guidance": False},
        "w/o visual modality in IBU": {"visual": False},
    },
    4: {
        "w/o continuous AR modeling": {"discrete": True, "draws": "motion"},
        "w/o bidirectional-integrated learning": {"interaction": "linear"},
    },
}


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Options of the papers' tables.

    Attributes:
        data: Composed dyads; tables of ARIG need speaking/ and interaction/ in it.
        models: Folder of listeners and tokenizers that only tables need, trained if missing; with it each table
            includes the paper as written.
        clips: Most dyads for a table.
        samples: Answers to every clip of tables 1 and 2 of SFMS.
        steps: Of every training, in place of its file's.
        seed: Of the listeners.
        seeds: Trainings of each row of `arig-1` and `arig-4`.
        split: Part of the dyads; of tables 3 and 4 the held-out recordings.
        training: Training file of ARIG's ablations; None: the paper as written.
        order, hop: Of tables 1 and 2 of SFMS; see `load_at_hop`.
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
    """Return FD, RPCC, SID and Var of expression and pose; clips (M, T, 58), an unseen speaker's face being NaN.

    RPCC is over the clips in which the speaker's face is visible throughout; NaN without any, or if one of the three
    motions is constant.
    """
    seen = np.isfinite(speaker).all(axis=(1, 2))
    found: dict[str, float] = {}
    for part, where in PARTS.items():
        real, ours, other = truth[..., where], made[..., where], speaker[..., where]
        moves = seen.any() and all(np.ptp(each[seen]) > 0 for each in (real, ours, other))
        found |= {
            f"FD {part}": metrics.frechet_distance(real, ours),
            f"RPCC {part}": metrics.rpcc_flat(real[seen], ours[seen], other[seen]) if moves else float("nan"),
            f"SID {part}": metrics.shannon_index(ours, centres[part], "bits"),
            f"Var {part}": metrics.variance(ours),
        }
    return {name: found[name] for name in _NAMES}


def rows_of(
    number: int, truth: Doubles, speaker: Doubles, answers: Mapping[str, Doubles], people: Sequence[str] = ()
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the rows of table 1, 2 or 4 (truth, ours by name, the paper's), and what holds of the paper's statements.

    Rows of tables 1 and 4 have the paper's RPCC, SID and Var beside ours. Answers hold the clips of one training after
    another. `people`: the listener of each clip of the truth, for intervals over them and over trainings.
    """

    def row(name: str, source: str, values: Mapping[str, float | None]) -> dict[str, Any]:
        return {"name": name, "source": source, "trainings": None} | {
            key: None if value is None or not np.isfinite(value) else round(float(value), 5)
            for key, value in values.items()
        }

    centres, rows = metrics.centres_of(truth, PARTS, _CLUSTERS), []
    draws, count = dict[str, dict[str, Doubles]](), len(truth)
    for name, made in {"Ground truth" if number == 2 else "GT": truth, **answers}.items():

        def score(clips: Chosen, made: Doubles = made) -> dict[str, float]:
            return scores(truth[clips % count], made[clips], speaker[clips % count], centres)

        trainings = len(made) // count
        draws[name] = bootstrap(score, [*people] * trainings, np.repeat(range(trainings), count).tolist())
        found = {key: [round(end, 5) for end in ends] for key, ends in intervals(draws[name]).items()}
        all_clips = row(name, "here", score(np.arange(len(made))))
        rows.append({**all_clips, "trainings": trainings, "interval": found})
    if number == 2:
        paper_rows = [row(name, "paper", dict(zip(_NAMES, each, strict=True))) for name, each in _PAPER_2.items()]
        return rows + paper_rows, []
    said = claims(number, {each["name"]: each for each in rows}, draws, truth)
    paper, columns = _PAPER[number], ("paper RPCC", "paper SID", "paper Var")
    rows += [row(name, "paper", dict.fromkeys(_NAMES)) for name in paper.keys() - {each["name"] for each in rows}]
    return [each | dict(zip(columns, paper.get(each["name"], (None,) * 3), strict=True)) for each in rows], said


def claims(
    number: int, rows: Mapping[str, Mapping[str, Any]], draws: Mapping[str, Mapping[str, Doubles]], truth: Doubles
) -> list[dict[str, Any]]:
    """Return what holds of: with all parts more kinds of motion, an RPCC and a variance nearer to people's.

    Differences are of the same people, over people and trainings (`intervals.verdict`). Fewer than three trainings
    leave it open; so does, of kinds of motion, a face that does not vary as people's do or lies far from them: noise
    has every kind.
    """

    def alike(name: str, part: str) -> bool:
        own, people = (rows[one][f"Var {part}"] for one in (name, "GT"))
        near = rows[name][f"FD {part}"] <= metrics.variance(truth[..., PARTS[part]], "sum")
        return bool(near and _LEAST_ALIKE * people <= own <= people / _LEAST_ALIKE)

    found = []
    for name in (each for each in ABLATIONS[number] if draws.get("ARIG") and draws.get(each)):
        enough = min(rows[each]["trainings"] for each in ("ARIG", name)) >= LEAST_SEEDS
        for part in PARTS:
            for metric in ("SID", "RPCC", "Var"):
                whole, less = (_merit(metric, draws[each], draws["GT"], part) for each in ("ARIG", name))
                interval = intervals({"": whole - less}).get("") if enough else None
                comparable = metric != "SID" or (alike("ARIG", part) and alike(name, part))
                found.append({
                    "name": name, "figure": f"{metric} {part}",
                    "with all parts better by": round(float(np.mean(whole - less)), 5),
                    "interval": interval and [round(end, 5) for end in interval],
                    "verdict": verdict(interval, comparable=comparable),
                })  # fmt: skip
    return found


def _merit(metric: str, row: Mapping[str, Doubles], people: Mapping[str, Doubles], part: str) -> Doubles:
    """Return a figure of each draw as a number of which more is better."""
    values = row[f"{metric} {part}"]
    return values if metric == "SID" else -values if metric == "RPCC" else -np.abs(values - people[f"Var {part}"])


# --- listeners that are played --------------------------------------------------------------------------------------


def arig_table(name: str, names: Sequence[str], options: TableOptions, train: bool = True) -> dict[str, Any]:
    """Return `arig-2`: `names` side by side on the listening set; or `arig-1`, `arig-4`: ablations, on interaction.

    Args:
        name: Of `ARIG_TABLES`.
        names: Listeners, by name or folder.
        options: Of the tables.
        train: Train missing ablations; else their rows are left out.

    Raises ConfigError.
    """
    data, models, split = options.data, options.models, options.split
    scenes = open_scenes(data, split)
    number = int(name.removeprefix("arig-"))
    scene = "listening" if number == 2 else "interaction"
    if scene not in scenes:
        raise ConfigError(f"{data / scene}: no {split} dyads, which --table {name} needs")
    held_out = [dyad for dyad in spread_clips(scenes[scene], options.clips) if len(dyad.listener) >= CLIP_FRAMES]
    if not held_out:
        raise ConfigError(f"{data}: no {split} dyad is as long as a clip of {CLIP_FRAMES} frames")
    folders = {one: [find("listeners", one, "config.yaml")] for one in names}
    if number != 2 and train:
        if models is None:
            raise ConfigError(f"--table {name}: needs --models DIR, where its listeners are trained and kept")
        unchanged = "arig-as-written" if options.training is None else "arig"
        rows: dict[str, Mapping[str, Any]] = {"ARIG": {}, **(READINGS if number == 1 else {})}
        rows |= {label: {"changes": changes} for label, changes in ABLATIONS[number].items()}
        folders = {
            label: [
                trained(
                    "arig", models / (_folder(label) if differing else unchanged), data,
                    file=options.training, steps=options.steps, seed=trial, changes=differing.get("changes", {}),
                    phase_changes=differing.get("phase_changes", {}),
                )
                for trial in range(1, options.seeds + 1)
            ]
            for label, differing in rows.items()
        } | folders  # fmt: skip
    elif models is not None:
        folders[LABELS["arig"]] = [trained("arig", models / "arig-as-written", data, steps=options.steps)]
    answers = {}
    for label, each in folders.items():
        rolled = [
            one.motion[0]
            for folder in each
            for one in rollouts(load_listener(folder), tracked(held_out, label), options.seed, CLIP_FRAMES)
        ]
        answers[label] = cut(rolled, CLIP_FRAMES)
    truth, speaker = (cut([getattr(one, who) for one in held_out], CLIP_FRAMES) for who in ("listener", "speaker"))
    people = people_of(held_out, [len(dyad.listener) for dyad in held_out], CLIP_FRAMES)
    scored, said = rows_of(number, truth, speaker, answers, people)
    found = {"table": name, "split": split, "clips": len(truth), "frames": CLIP_FRAMES, "rows": scored}
    return found if number == 2 else {**found, "claims": said}


def _folder(label: str) -> str:
    return label.replace("/", "").replace(",", "").replace(" ", "-").lower()


def training_file(kind: Kind) -> Path:
    """Return the file with the training of a paper's listener as written."""
    return data_dir("configs") / "training" / f"{kind}-as-written.yaml"


def trained(
    kind: Kind,
    out: Path,
    data: Path,
    *,
    file: Path | None = None,
    steps: int | None = None,
    seed: int = 1,
    order: Order | None = None,
    changes: Mapping[str, Any] = MappingProxyType({}),
    phase_changes: Mapping[str, Any] = MappingProxyType({}),
) -> Path:
    """Return a folder with a listener of a paper, which is trained on `data` if it is missing: `out`, or OUT-seedN.

    Training takes half an hour or more of one core; an interrupted one is resumed. `file`: of the training; None: as
    written. `steps`: of every phase, in place of the file's. `changes`: of the listener; `phase_changes`: of ARIG's
    training. Raises ConfigError.
    """
    file, out = file or training_file(kind), out if seed == 1 else out.with_name(f"{out.name}-seed{seed}")
    if load_training(file).listener.kind != kind:
        raise ConfigError(f"{file}: listener.kind is not {kind}")

    def options(job: str) -> TrainOptions:
        begun = checkpoint_file(out, job).is_file()
        return TrainOptions(
            file=file, data=data, out=out, resume=begun, steps=steps, seed=None if seed == 1 else seed,
            tensorboard=False, order=order,
            changes=changes, phase_changes=phase_changes,
        )  # fmt: skip

    if not (out / checkpoint.WEIGHTS).is_file():
        if kind == "sfms" and not (out / TOKENIZER_WEIGHTS).is_file():
            train_tokenizer(options("tokenizer"))
        train_listener(options("listener" if kind == "sfms" else "arig"))
    return out


# --- evaluate papers -------------------------------------------------------------------------------------------------

_SFMS, _ARIG = "sfms-small", "arig-small"
_TRAIN_DYADS: Final = 200  # from which the heuristics take their means
_SFMS_TABLES: Final = ("1", "2")
EVERY: Final = (*_SFMS_TABLES, *TOKENIZER_TABLES, *ARIG_TABLES)


def evaluate_papers(
    options: TableOptions, tables: Sequence[str], each: Callable[[str, dict[str, Any]], None]
) -> dict[str, Any]:
    """Return the `tables` (of `EVERY`); call `each(name, table)` as soon as one is done.

    Without a folder of models their rows are left out, and `not_trained` of a table lists how to make them. Blocks for
    minutes; for hours if listeners have to be trained. An interrupted training is resumed. Raises ConfigError.
    """
    unknown = [name for name in tables if name not in EVERY]
    if unknown:
        raise ConfigError(f"--table {unknown[0]}: is not one of {', '.join(EVERY)}")
    found: dict[str, dict[str, Any]] = {}
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


def sfms_table(number: int, names: Sequence[str], options: TableOptions) -> dict[str, Any]:
    """Return table 1 or 2 of SFMS for listeners by name; with a folder of models also for the paper as written."""
    data, order, samples = options.data, options.order, options.samples
    listeners = {name: load_at_hop(name, options.hop, "auto") for name in names}
    if options.models is not None:
        written = trained("sfms", options.models / "sfms-as-written", data, steps=options.steps, order=order)
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
    """Return the missing rows of a table, and what makes them."""

    def file(kind: Kind) -> str:
        return "/".join(training_file(kind).parts[-3:])

    if name in TOKENIZER_TABLES:
        lacking = set(needed(name)) - set(needed(name, shipped=True))
        return {row: f"evaluate tokenizer --table {name} --models DIR, minutes each" for row in sorted(lacking)}
    if name in _SFMS_TABLES:
        return {LABELS["sfms"]: f"train tokenizer, then train listener, --config {file('sfms')}"}
    rows = [LABELS["arig"]] if name == "arig-2" else ["ARIG", *ABLATIONS[int(name.removeprefix("arig-"))]]
    return {row: f"train listener --config {file('arig')}" for row in rows}
