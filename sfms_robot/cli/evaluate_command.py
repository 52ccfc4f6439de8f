"""`sfms-robot evaluate`: the quality of listeners on held-out dyads, and of heads on recorded faces."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

from typer import BadParameter, Option, Typer

from sfms_robot.cli.run_command import MAX_SEED
from sfms_robot.cli.show import JSON, print_report, print_rows, say, show
from sfms_robot.cli.train_command import ORDER, Order, interruptible

app = Typer(help="Evaluate listeners on held-out dyads, and heads on recorded faces.", no_args_is_help=True)


class Size(StrEnum):
    small = "small"
    paper = "paper"


class TableName(StrEnum):
    """1 and 2 of SFMS; those of ARIG."""

    one = "1"
    two = "2"
    arig_1 = "arig-1"
    arig_2 = "arig-2"
    arig_4 = "arig-4"


class Part(StrEnum):
    """Of meetings and voices (`corpora.clips`)."""

    train = "train"
    validation = "validation"
    test = "test"


LISTENER = Option("sfms-small", help="Shipped listener, or a folder with config.yaml and weights.")
SEED = Option(1, min=0, max=MAX_SEED, help="Seed of everything that is random.")
ENGINE_HELP = "Engine of the listener; its precision is that of its config.yaml."
HOP = Option(None, min=1, help="Frames between plans, as a run chooses them; default: that of its config.yaml.")


@app.command()
def tokenizer(
    listener: str = LISTENER,
    table: str | None = Option(None, metavar="3|4|all", help="A table of the SFMS paper, or both."),
    data: Path | None = Option(
        None, help="Composed dyads; with --table any folder of face tracks (CSV), or the held-out recordings."
    ),
    models: Path | None = Option(None, help="Folder of the table's tokenizers, trained if missing; the shipped."),
    train: bool = Option(False, "--train", help="Train the table's tokenizers again, into --models."),
    size: Size = Option(Size.small, help="Of what is trained; paper: for a GPU."),
    steps: int | None = Option(None, min=1, help="Another number of training steps than the size's."),
    jobs: int = Option(1, min=1, help="Tokenizers trained at once."),
    plots: Path | None = Option(None, metavar="DIR", help="Draw the pictures of --table as PNG files."),
    order: Order | None = ORDER,
    json: bool = JSON,
) -> None:
    """Reconstruction error: a listener's by keyframe placement, or a table of the SFMS paper."""
    if table is None:
        from sfms_robot.lab.evaluation.listener_tables import evaluate_tokenizer

        if data is None:
            raise BadParameter("--data is needed without --table")
        show(evaluate_tokenizer(listener, data, order.value if order else None), json)
        return
    from sfms_robot.lab.evaluation.tokenizer_tables import evaluate_table

    options: dict[str, Any] = {"train": train, "size": size.value, "steps": steps, "jobs": jobs, "plots": plots}
    show(interruptible(lambda: evaluate_table(table, data, models, **options)), json)


@app.command("listener")
def listener_(
    listener: list[str] = Option(
        [], metavar="NAME|DIR", help="May be given often. sfms-small; arig-small for the tables of ARIG."
    ),
    data: Path = Option(..., help="Composed dyads, or with --table any data set (see `sfms-robot data check`)."),
    table: TableName | None = Option(
        None, help="Of the SFMS paper: 1 as on L2L, 2 as on REACT. Of the ARIG paper: 2, and ablations 1 and 4."
    ),
    samples: int = Option(10, min=1, help="Answers to every clip, for --table 1 and 2."),
    clips: int | None = Option(None, min=1, help="At most this many dyads, for --table; all of them."),
    models: Path | None = Option(
        None, help="Folder of the papers' listeners as written, and of ablations; those missing are trained."
    ),
    config: Path | None = Option(None, help="Training of the ablations; configs/training/arig-as-written.yaml."),
    steps: int | None = Option(None, min=1, help="Another number of training steps than the file's."),
    seed: int = SEED,
    hop: int | None = HOP,
    order: Order | None = ORDER,
    json: bool = JSON,
) -> None:
    """Nods, blinks, smiles and smoothness of listeners beside those of the dyads' own; or a table of a paper."""
    from sfms_robot.lab.evaluation.listener_tables import evaluate_listener

    of_arig = table is not None and table.value.startswith("arig")
    listener = listener or ["arig-small" if of_arig else "sfms-small"]
    if table is None:
        show(evaluate_listener(listener, data, seed, order.value if order else None, hop), json)
        return
    if of_arig:
        if order is not None or hop is not None:
            raise BadParameter("--order and --hop are for --table 1 and 2, or none")
        from sfms_robot.lab.evaluation.arig_tables import arig_table

        trained: dict[str, Any] = {"models": models, "training": config, "steps": steps}
        show(interruptible(lambda: arig_table(table.value, listener, data, clips=clips, seed=seed, **trained)), json)
        return
    from sfms_robot.lab.evaluation.arig_tables import sfms_table

    options: dict[str, Any] = {
        "samples": samples, "limit": clips, "seed": seed, "order": order.value if order else None, "hop": hop,
        "models": models, "steps": steps,
    }  # fmt: skip
    show(interruptible(lambda: sfms_table(int(table.value), listener, data, **options)), json)


@app.command()
def papers(
    data: Path = Option(..., help="Composed dyads."),
    models: Path | None = Option(
        None, help="Folder of what only tables need; what is missing is trained: hours. Without it: said to be missing."
    ),
    table: list[str] = Option(
        [], metavar="1|2|3|4|arig-1|arig-2|arig-4", help="May be given often; all of them if not."
    ),
    clips: int | None = Option(None, min=1, help="At most this many dyads a table; all of them."),
    samples: int = Option(10, min=1, help="Answers to every clip of tables 1 and 2."),
    steps: int | None = Option(None, min=1, help="Another number of steps than the training files'."),
    seed: int = SEED,
    json: bool = JSON,
) -> None:
    """Every table of both papers: the papers as written beside the shipped listeners, and what they report."""
    from sfms_robot.lab.evaluation.arig_tables import EVERY, evaluate_papers

    options: dict[str, Any] = {"clips": clips, "samples": samples, "steps": steps, "seed": seed}
    each = _quiet if json else _print_paper
    show(interruptible(lambda: evaluate_papers(data, models, table or EVERY, each, **options)), json, _quiet)


@app.command()
def timing(
    listener: str = LISTENER,
    data: Path = Option(..., help="Folder of AMI tables (words, head_gestures, ...; CSV or CSV.gz)."),
    split: Part = Option(Part.test, help="People of the meetings: test to report, validation to choose."),
    allow_training: bool = Option(False, "--allow-training", help="Play people that listeners learned from."),
    meetings: int | None = Option(None, min=1, help="At most this many, spread over the people; all of them."),
    minutes: float = Option(
        5.0, min=0.0, help="Of motion, from the middle of each meeting; 0: hazards and decisions alone, in minutes."
    ),
    seeds: int = Option(8, min=1, help="Number of times that each meeting is played."),
    seed: int = SEED,
    jobs: int | None = Option(None, min=1, help="Processes; as many as there are cores."),
    hop: int | None = HOP,
    engine: str = Option("torch", metavar="auto|onnx|torch", help=ENGINE_HELP),
    own_voice: bool = Option(False, "--own-voice", help="It speaks when the person did; else it never does."),
    json: bool = JSON,
) -> None:
    """Nods, blinks, smiles and gaze shifts of the listener in real meetings, beside those of the people."""
    from sfms_robot.app.options import engine_named
    from sfms_robot.lab.evaluation.meetings import TimingOptions, evaluate_timing

    options = TimingOptions(
        listener=listener,
        data=data,
        split=split.value,
        allow_training=allow_training,
        meetings=meetings,
        minutes=minutes,
        seeds=seeds,
        seed=seed,
        jobs=jobs,
        hop=hop,
        engine=engine_named(engine),
        own_voice=own_voice,
    )
    show(evaluate_timing(options), json)


@app.command()
def robustness(
    listener: str = LISTENER,
    data: Path | None = Option(
        None, metavar="DIR", help="Folder with more voices (speech_audio, conversation_audio, ...); the bundled ones."
    ),
    split: Part = Option(Part.test, help="People of the voices: test to report, validation to choose."),
    speakers: int | None = Option(None, min=1, help="At most this many; all of the part."),
    minutes: float = Option(1.0, min=0.1, help="Of each, in each way."),
    seeds: int = Option(8, min=1, help="Number of times that each is played."),
    seed: int = SEED,
    jobs: int | None = Option(None, min=1, help="Processes; as many as there are cores."),
    json: bool = JSON,
) -> None:
    """Events a minute with unseen speakers: voice, face and both, in noise, rooms and bad pictures."""
    from sfms_robot.lab.evaluation.robustness import evaluate_robustness

    found = evaluate_robustness(
        listener, data, split=split.value, speakers=speakers, minutes=minutes, seeds=seeds, seed=seed, jobs=jobs
    )
    show(found, json)


@app.command()
def naturalness(
    listener: str = LISTENER,
    data: Path = Option(..., help="Composed dyads (`sfms-robot data compose`)."),
    split: str = Option("test", metavar="validation|test", help="People whose motion it is compared with."),
    clips: int | None = Option(None, min=1, help="At most this many dyads, spread evenly; all of them."),
    drift: float = Option(600.0, min=30.0, metavar="S", help="Length of the run that is looked at for drift."),
    seed: int = SEED,
    engine: str = Option("auto", metavar="auto|onnx|torch", help=ENGINE_HELP),
    json: bool = JSON,
) -> None:
    """Compare a listener's motion with that of unseen people: nods, smiles, gaze, sway, and a network's guess."""
    from sfms_robot.app.options import engine_named
    from sfms_robot.lab.evaluation.naturalness import evaluate_naturalness

    show(evaluate_naturalness(listener, data, split, clips, drift, seed, engine_named(engine)), json)


@app.command("metrics")
def metrics_(
    truth: Path = Option(..., help="Recorded motion: array (.npy), face track (CSV), or a folder of tracks."),
    prediction: Path = Option(
        ..., help="Motion to score, in the same form; an array may hold K answers, (N, K, T, D)."
    ),
    speaker: Path | None = Option(None, help="The speakers' motion: for P-FD, RPCC and FRSyn."),
    space: str | None = Option(None, metavar="SPACE", help="arkit58, faceverse58, deca56, attributes25."),
    frames: int | None = Option(None, min=2, help="Cut clips to so many; default: to the shortest."),
    seed: int = SEED,
    json: bool = JSON,
) -> None:
    """The papers' metrics of any motion beside recorded motion: of your own system, from files."""
    from sfms_robot.lab.evaluation.motion_metrics import evaluate_metrics

    show(evaluate_metrics(truth, prediction, speaker, space=space, frames=frames, seed=seed), json)


@app.command()
def interaction(
    listener: str = Option("arig-small", help="Shipped listener, or a folder with config.yaml and weights."),
    data: Path = Option(..., help="Composed dyads with interaction/ and speaking/ (`sfms-robot data compose`)."),
    clips: int | None = Option(None, min=1, help="At most this many dyads of each set; all of them."),
    seed: int = SEED,
    json: bool = JSON,
) -> None:
    """Score a listener that speaks: its states against labels, its lips, and the borders of its chunks."""
    from sfms_robot.lab.evaluation.interaction import evaluate_interaction

    show(evaluate_interaction(listener, data, clips, seed), json, _print_interaction)


@app.command()
def people(
    listener: list[str] = Option(
        [], metavar="NAME|DIR|recorded", help="Two or more: listeners, and what the people of --data did."
    ),
    data: Path | None = Option(
        None,
        help="Composed dyads, or any data set with voices; default: bundled voices that no listener was trained on.",
    ),
    voices: int = Option(8, min=1, help="Voices that each listens to."),
    seconds: float = Option(12.0, min=2.0, max=60.0, help="Length of a clip."),
    seed: int = SEED,
    out: Path = Option(
        Path("sfms-people"), metavar="DIR", help="The study: clips and answers; continued if it exists."
    ),
    view: str = Option("auto", metavar="[HOST:]PORT", help="Where the page is; default: this machine alone."),
    results: Path | None = Option(None, metavar="FILE.csv", help="Serve no page: the table of these answers."),
    json: bool = JSON,
) -> None:
    """A page that asks people, blind, which of two listens more like a person; Ctrl-C ends it, with a table."""
    from sfms_robot.lab.evaluation import people_study

    if results is not None:
        show(people_study.summary(people_study.read_answers(results)), json)
        return
    study = people_study.prepare(listener, data, voices=voices, seconds=seconds, seed=seed, folder=out)

    def ask(url: str, taken: int | None) -> None:
        note = "" if taken is None else f" (port {taken} is taken)"
        print(f"people answer at {url}{note}; Ctrl-C ends", file=sys.stderr, flush=True)

    try:
        people_study.serve(study, view, ask)
    finally:
        show(study.results(), json)


@app.command()
def fidelity(
    head: list[str] = Option([], "--head", metavar="NAME|DIR", help="May be given often; all shipped heads."),
    data: Path | None = Option(None, "--data", metavar="DIR", help="Face tracks (CSV) in place of the bundled."),
    json: bool = JSON,
) -> None:
    """The share of each recorded face's motion that a head can show, on the skin of the virtual head."""
    from sfms_robot.app.head.head_check import fidelity as measure

    show(measure(head, data), json)


def _quiet(*_: Any) -> None:
    """Print nothing."""


def _print_paper(name: str, found: Mapping[str, Any]) -> None:
    """Print one table of `evaluate papers` when it is finished."""
    say(f"ARIG, table {name.removeprefix('arig-')}" if name.startswith("arig") else f"SFMS, table {name}", "bold")
    print_report(found)


def _print_interaction(result: Mapping[str, Any]) -> None:
    """Print every figure; then the states, labels down, answers across, in percent of the label."""
    confusion = result.get("confusion") or {"states": [], "label_by_answer": []}
    print_report({key: value for key, value in result.items() if key != "confusion"})
    rows = []
    for name, counts in zip(confusion["states"], confusion["label_by_answer"], strict=True):
        total = sum(counts)
        shares = [f"{100 * count / total:.0f}" if total else "-" for count in counts]
        rows.append({"label": name, **dict(zip(confusion["states"], shares, strict=True)), "frames": total})
    print_rows(rows, "answer, % of the label")
