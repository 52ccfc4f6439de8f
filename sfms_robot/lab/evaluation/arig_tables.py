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
from typing import Any, Final, Literal

import numpy as np

from sfms_robot import config
from sfms_robot.config import find, parse_training
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE, SHAPES, Doubles
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.evaluation import metrics
from sfms_robot.lab.evaluation.interaction import played
from sfms_robot.lab.evaluation.intervals import Chosen, jackknife, people_of
from sfms_robot.lab.evaluation.listener_tables import listener_table, spread_clips
from sfms_robot.lab.evaluation.metrics import cut
from sfms_robot.lab.evaluation.rollout import load_at_hop
from sfms_robot.lab.evaluation.tokenizer_tables import ARIG_TABLES as TOKENIZER_TABLES
from sfms_robot.lab.evaluation.tokenizer_tables import TableOptions, evaluate_table, needed
from sfms_robot.lab.learning.arig.features import open_scenes
from sfms_robot.lab.learning.arig.trainer import train_arig
from sfms_robot.lab.learning.sfms.tokenizer_trainer import WEIGHTS as TOKENIZER_WEIGHTS
from sfms_robot.lab.learning.train_runs import TrainOptions, run_of, train_listener, train_settings, train_tokenizer
from sfms_robot.lab.learning.training_loop import checkpoint_file
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.registry import load_listener

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
) -> list[dict[str, Any]]:
    """Return the rows of table 1, 2 or 4: truth, ours by name, the paper's.

    Rows of tables 1 and 4 have the paper's RPCC, SID and Var beside ours. `people`: the listener of each clip, for
    intervals over them.
    """

    def row(name: str, source: str, values: Mapping[str, float | None]) -> dict[str, Any]:
        return {"name": name, "source": source} | {
            key: None if value is None or not np.isfinite(value) else round(float(value), 5)
            for key, value in values.items()
        }

    centres, rows = metrics.centres_of(truth, PARTS, _CLUSTERS), []
    for name, made in {"Ground truth" if number == 2 else "GT": truth, **answers}.items():

        def score(clips: Chosen, made: Doubles = made) -> dict[str, float]:
            return scores(truth[clips], made[clips], speaker[clips], centres)

        found = {key: [round(end, 5) for end in ends] for key, ends in jackknife(score, people).items()}
        rows.append({**row(name, "here", score(np.arange(len(truth)))), "interval": found})
    if number == 2:
        return rows + [row(name, "paper", dict(zip(_NAMES, each, strict=True))) for name, each in _PAPER_2.items()]
    paper, columns = _PAPER[number], ("paper RPCC", "paper SID", "paper Var")
    rows += [row(name, "paper", dict.fromkeys(_NAMES)) for name in paper.keys() - {each["name"] for each in rows}]
    return [each | dict(zip(columns, paper.get(each["name"], (None,) * 3), strict=True)) for each in rows]


# --- listeners that are played --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AblationOptions:
    """Where listeners for the tables are kept, and how missing ones are trained.

    `training`: None is the paper as written. `steps`: in place of the file's. `train`: False leaves out the rows of
    listeners that are missing.
    """

    models: Path | None = None
    training: Path | None = None
    steps: int | None = None
    train: bool = True


def arig_table(
    name: str, names: Sequence[str], data: Path, clips: int | None, seed: int, ablations: AblationOptions
) -> dict[str, Any]:
    """Return `arig-2`: `names` side by side on the listening set; or `arig-1`, `arig-4`: ablations, on interaction.

    With a folder for models each table includes the paper as written. Raises ConfigError.
    """
    if name not in ARIG_TABLES:
        raise ConfigError(f"--table {name}: is not one of {', '.join(ARIG_TABLES)}")
    scenes = open_scenes(data, "validation")
    number = int(name.removeprefix("arig-"))
    scene = "listening" if number == 2 else "interaction"
    if scene not in scenes:
        raise ConfigError(f"{data / scene}: no validation dyads, which --table {name} needs")
    held_out = [dyad for dyad in spread_clips(scenes[scene], clips) if len(dyad.listener) >= CLIP_FRAMES]
    if not held_out:
        raise ConfigError(f"{data}: no validation dyad is as long as a clip of {CLIP_FRAMES} frames")
    folders = {one: find("listeners", one, "config.yaml") for one in names}
    if number != 2 and ablations.train:
        folders = _ablated(number, data, ablations) | folders
    elif ablations.models is not None:
        folders |= as_written("arig", data, ablations.models, ablations.steps)
    answers = {}
    for label, folder in folders.items():
        rolled = played(label, load_listener(folder), {scene: held_out}, seed, CLIP_FRAMES)[scene]
        answers[label] = cut([one.motion[0] for one in rolled], CLIP_FRAMES)
    truth, speaker = (cut([getattr(one, who) for one in held_out], CLIP_FRAMES) for who in ("listener", "speaker"))
    people = people_of(held_out, [len(dyad.listener) for dyad in held_out], CLIP_FRAMES)
    rows = rows_of(number, truth, speaker, answers, people)
    return {"table": name, "clips": len(truth), "frames": CLIP_FRAMES, "rows": rows}


def _ablated(number: int, data: Path, options: AblationOptions) -> dict[str, Path]:
    """Return the folders of the full model and the table's ablations; missing ones are trained in the same way."""
    if options.models is None:
        raise ConfigError(f"--table arig-{number}: needs --models DIR, where its listeners are trained and kept")
    file = options.training or training_file("arig")
    base = train_settings(TrainOptions(file=file, data=data, out=options.models, steps=options.steps))
    if not isinstance(base, config.ArigTraining):
        raise ConfigError(f"{file}: listener.kind is not arig")
    folders = {}
    variants: dict[str, Mapping[str, Any]] = {"ARIG": {}, **ABLATIONS[number]}
    for label, changes in variants.items():
        unchanged = "arig-as-written" if options.training is None else "arig"
        out = options.models / (label.replace("/", "").replace(" ", "-").lower() if changes else unchanged)
        folders[label] = out
        if not (out / checkpoint.WEIGHTS).is_file():
            raw = base.model_dump(mode="json")
            raw["listener"] |= changes
            settings = parse_training(raw, file)
            assert isinstance(settings, config.ArigTraining)
            begun = checkpoint_file(out, "arig").is_file()
            with run_of(TrainOptions(file=file, data=data, out=out, resume=begun, tensorboard=False)) as run:
                train_arig(settings, data, out, run)
    return folders


def training_file(kind: Kind) -> Path:
    """Return the file with the training of a paper's listener as written."""
    return data_dir("configs") / "training" / f"{kind}-as-written.yaml"


def as_written(
    kind: Kind, data: Path, models: Path, steps: int | None = None, order: Order | None = None
) -> dict[str, Path]:
    """Return the label and folder in `models` of a paper's listener, trained on `data` if missing.

    Training takes half an hour or more of one core; an interrupted one is resumed. `steps`: of every phase, in place of
    the file's. Raises ConfigError.
    """
    out = models / f"{kind}-as-written"

    def options(job: str) -> TrainOptions:
        begun = checkpoint_file(out, job).is_file()
        return TrainOptions(
            file=training_file(kind), data=data, out=out, resume=begun, steps=steps, tensorboard=False,
            order=order if kind == "sfms" else None,
        )  # fmt: skip

    if not (out / checkpoint.WEIGHTS).is_file():
        if kind == "sfms" and not (out / TOKENIZER_WEIGHTS).is_file():
            train_tokenizer(options("tokenizer"))
        train_listener(options("listener" if kind == "sfms" else "arig"))
    return {LABELS[kind]: out}


# --- evaluate papers -------------------------------------------------------------------------------------------------

_SFMS, _ARIG = "sfms-small", "arig-small"
_SFMS_TABLES: Final = ("1", "2")
EVERY: Final = (*_SFMS_TABLES, *TOKENIZER_TABLES, *ARIG_TABLES)


@dataclass(frozen=True, kw_only=True)
class PapersOptions:
    """Options of the command.

    Attributes:
        data: Composed dyads, with speaking/ and interaction/.
        models: Folder of listeners and tokenizers for tables alone, trained if missing; None: their rows are left out,
            and `not_trained` of a table lists how to make them.
        tables: Of `EVERY`.
        clips: Most dyads for a table; samples: answers to every clip of tables 1 and 2.
        steps: Of every training, in place of its file's.
    """

    data: Path
    models: Path | None
    tables: Sequence[str] = EVERY
    clips: int | None = None
    samples: int = 10
    steps: int | None = None
    seed: int = 1


def evaluate_papers(options: PapersOptions, each: Callable[[str, dict[str, Any]], None]) -> dict[str, Any]:
    """Return every table; call `each(name, table)` as soon as one is done. Raises ConfigError.

    Blocks for minutes; for hours if listeners have to be trained. An interrupted training is resumed.
    """
    unknown = [name for name in options.tables if name not in EVERY]
    if unknown:
        raise ConfigError(f"--table {unknown[0]}: is not one of {', '.join(EVERY)}")
    tables = {}
    for name in options.tables:
        tables[name] = _table(name, options)
        if options.models is None:
            tables[name] |= {"not_trained": _not_trained(name)}
        each(name, tables[name])
    return {"tables": tables}


def _table(name: str, options: PapersOptions) -> dict[str, Any]:
    models, steps = options.models, options.steps
    if name in TOKENIZER_TABLES:
        return evaluate_table(
            TableOptions(table=name, models=None if models is None else models / "tokenizers", steps=steps)
        )
    if name in _SFMS_TABLES:
        return sfms_table(
            int(name), [_SFMS], options.data, samples=options.samples, limit=options.clips, seed=options.seed,
            models=models, steps=steps,
        )  # fmt: skip
    names = [_ARIG, _SFMS] if name == "arig-2" else [_ARIG]
    ablations = AblationOptions(models, steps=steps, train=models is not None)
    return arig_table(name, names, options.data, options.clips, options.seed, ablations)


def sfms_table(
    number: int,
    names: Sequence[str],
    data: Path,
    *,
    samples: int,
    limit: int | None,
    seed: int,
    order: Order | None = None,
    hop: int | None = None,
    models: Path | None = None,
    steps: int | None = None,
) -> dict[str, Any]:
    """Return table 1 or 2 of SFMS for listeners by name; with a folder `models` also for the paper as written."""
    listeners = {name: load_at_hop(name, hop, "auto") for name in names}
    if models is not None:
        written = as_written("sfms", data, models, steps, order)
        listeners |= {label: load_at_hop(str(folder)) for label, folder in written.items()}
    return listener_table(number, listeners, data, samples=samples, limit=limit, seed=seed, order=order)


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
