"""`sfms-robot evaluate`: the quality of listeners on held-out dyads, and of heads on recorded faces."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from typer import BadParameter, Option, Typer

from sfms_robot.cli.run_command import MAX_SEED
from sfms_robot.cli.show import JSON, Result, aside, print_report, print_rows, say, show
from sfms_robot.cli.train_command import ORDER, Order, interruptible

app = Typer(help="Evaluate listeners on held-out dyads, and heads on recorded faces.", no_args_is_help=True)


Part = Literal["train", "validation", "test"]  # parts of meetings and voices (`corpora.clips`)
Unseen = Literal["validation", "test"]
LISTENER = Option("sfms-small", help="Shipped listener, or a folder with config.yaml and weights.")
SPLIT = Option("test", help="Dyads: test to report, validation to choose.")
JOBS = Option(None, min=1, help="Processes. Default: one for each core.")
SEED = Option(1, min=0, max=MAX_SEED, help="Seed of all random numbers.")
ENGINE_HELP = "Engine of the listener; its precision is that of its config.yaml."
_INTERVALS = "in brackets: 95 % intervals over people. Rows of the paper are from other data: compare ratios."
_ANSWERS = "{participants} people, {answers} answers"
_TABLES = {  # tables of the SFMS paper, and the tables that their figures come from
    3: "Table 3: where keyframes go",
    4: "Table 4: kinds of codes",
    "3-placements": "Every placement with both inpainters",
    "4-codes": "Kinds of codes, alike",
}
HOP = Option(None, min=1, help="Frames between plans. Default: those of its config.yaml.")


@app.command()
def tokenizer(
    listener: str = LISTENER,
    table: str | None = Option(
        None, metavar="3|4|all|3-placements|4-codes", help="Table of the SFMS paper, both, or details of one of them."
    ),
    data: Path | None = Option(
        None, help="Composed dyads; with --table any folder of face tracks (CSV), or the held-out recordings."
    ),
    models: Path | None = Option(
        None, help="Folder of the table's tokenizers, trained if missing. Default: the shipped ones."
    ),
    train: bool = Option(False, "--train", help="Train the table's tokenizers again, into --models."),
    size: Literal["small", "paper"] = Option("small", help="Size of trained tokenizers; paper: for a GPU."),
    steps: int | None = Option(None, min=1, help="Training steps. Default: those of the size."),
    seeds: int = Option(1, min=1, help="Trainings of each tokenizer, kept in --models."),
    only: str = Option("*", metavar="PATTERN", help="Tokenizers of the table, as in 'sparse-all-k7,*-static'."),
    jobs: int = Option(1, min=1, help="Tokenizers trained at once."),
    plots: Path | None = Option(None, metavar="DIR", help="Draw the pictures of --table as PNG files."),
    order: Order | None = ORDER,
    split: Unseen = SPLIT,
    json: bool = JSON,
) -> None:
    """Evaluate reconstruction: of a listener by keyframe placement, or a table of the SFMS paper."""
    if table is None:
        from sfms_robot.lab.evaluation.listener_tables import evaluate_tokenizer

        if data is None:
            raise BadParameter("--data is needed without --table")
        show(evaluate_tokenizer(listener, data, order, split), json)
        return
    if split != "test":
        raise BadParameter("--split validation: dyads have parts, tracks of --table are all held out")
    from sfms_robot.lab.evaluation.tokenizer_tables import evaluate_table

    found = interruptible(
        lambda: evaluate_table(
            table,
            data,
            models,
            train=train,
            size=size,
            steps=steps,
            seeds=seeds,
            only=only,
            jobs=jobs,
            plots=plots,
        )
    )
    show(found, json, _print_tokenizers)


@app.command("listener")
def listener_(
    listener: list[str] = Option(
        [], metavar="NAME|DIR", help="May be repeated. Default: sfms-small, for the tables of ARIG arig-small."
    ),
    data: Path = Option(..., help="Composed dyads, or with --table any data set (see `sfms-robot data check`)."),
    table: Literal["1", "2", "arig-1", "arig-2", "arig-4", "arig-readings"] | None = Option(
        None, help="SFMS paper: 1 as on L2L, 2 as on REACT. ARIG paper: 2, ablations 1 and 4, readings."
    ),
    samples: int = Option(10, min=1, help="Answers to every clip, for --table 1 and 2."),
    clips: int | None = Option(None, min=1, help="Most dyads, for --table. Default: all."),
    models: Path | None = Option(
        None, help="Folder of the papers' listeners as written and of ablations; missing ones are trained."
    ),
    config: Path | None = Option(
        None, help="Training file of the ablations. Default: configs/training/arig-as-written.yaml."
    ),
    steps: int | None = Option(None, min=1, help="Training steps. Default: those of the file."),
    seeds: int = Option(
        1, min=1, help="Trainings of each row of ARIG's tables, except arig-2; three and more say what holds."
    ),
    split: Unseen = SPLIT,
    seed: int = SEED,
    hop: int | None = HOP,
    order: Order | None = ORDER,
    json: bool = JSON,
) -> None:
    """Compare nods, blinks, smiles and smoothness of listeners with those of the dyads, or make a table of a paper."""
    from sfms_robot.lab.evaluation.listener_tables import evaluate_listener

    of_arig = table is not None and table.startswith("arig")
    listener = listener or ["arig-small" if of_arig else "sfms-small"]
    if table is None:
        show(evaluate_listener(listener, data, seed, order, hop, split), json)
        return
    if of_arig and (order is not None or hop is not None):
        raise BadParameter("--order and --hop are for --table 1 and 2, or none")
    from sfms_robot.lab.evaluation.arig_tables import TableOptions, arig_table, sfms_table

    options = TableOptions(
        data=data, models=models, clips=clips, samples=samples, steps=steps, seed=seed, seeds=seeds, split=split,
        training=config, order=order, hop=hop,
    )  # fmt: skip
    found = interruptible(
        lambda: arig_table(table, listener, options) if of_arig else sfms_table(int(table), listener, options)
    )
    show(found, json, note=_INTERVALS)


@app.command()
def papers(
    data: Path = Option(..., help="Composed dyads."),
    models: Path | None = Option(
        None, help="Folder of listeners and tokenizers for tables; missing ones are trained (hours)."
    ),
    table: list[str] = Option(
        [], metavar="1|2|3|4|arig-1|arig-2|arig-4|arig-readings", help="May be repeated. Default: all."
    ),
    clips: int | None = Option(None, min=1, help="Most dyads per table. Default: all."),
    samples: int = Option(10, min=1, help="Answers to every clip of tables 1 and 2."),
    steps: int | None = Option(None, min=1, help="Training steps. Default: those of the training files."),
    seeds: int = Option(1, min=1, help="Trainings of each row of ARIG's tables, except arig-2."),
    split: Unseen = SPLIT,
    seed: int = SEED,
    json: bool = JSON,
) -> None:
    """Make every table of both papers: the papers as written, the shipped listeners and the printed figures."""
    from sfms_robot.lab.evaluation.arig_tables import EVERY, TableOptions, evaluate_papers

    options = TableOptions(
        data=data, models=models, clips=clips, samples=samples, steps=steps, seed=seed, seeds=seeds, split=split
    )
    each = _quiet if json else _print_paper
    show(interruptible(lambda: evaluate_papers(options, table or EVERY, each)), json, _quiet)


@app.command()
def timing(
    listener: str = LISTENER,
    data: Path = Option(..., help="Folder of AMI tables (words, head_gestures, ...; CSV or CSV.gz)."),
    split: Part = Option("test", help="People of the meetings: test to report, validation to choose."),
    allow_training: bool = Option(False, "--allow-training", help="Allow people that listeners learned from."),
    meetings: int | None = Option(None, min=1, help="Most meetings, spread over the people. Default: all."),
    minutes: float = Option(
        5.0, min=0.0, help="Minutes of motion, from the middle of each meeting; 0: only hazards and decisions."
    ),
    seeds: int = Option(8, min=1, help="Number of times that each meeting is played."),
    seed: int = SEED,
    jobs: int | None = JOBS,
    hop: int | None = HOP,
    engine: str = Option("torch", metavar="auto|onnx|torch", help=ENGINE_HELP),
    own_voice: bool = Option(False, "--own-voice", help="Let it speak when the person did. Default: it never speaks."),
    json: bool = JSON,
) -> None:
    """Compare nods, blinks, smiles and gaze shifts of a listener in real meetings with those of the people."""
    from sfms_robot.app.options import engine_named
    from sfms_robot.lab.evaluation.meetings import TimingOptions, evaluate_timing

    options = TimingOptions(
        listener=listener,
        data=data,
        split=split,
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
    show(
        evaluate_timing(options),
        json,
        heading="{people} people of {split}, {meetings} meetings, {minutes} minutes, {seeds} seeds",
        keys=("rows", "detector", "asked_and_seen", "notes"),
        note="in brackets: 95 % intervals over people. detector: known events, found in motion",
    )


@app.command()
def robustness(
    listener: str = LISTENER,
    data: Path | None = Option(
        None, metavar="DIR", help="Folder with more voices (speech_audio, ...). Default: the bundled ones."
    ),
    split: Part = Option("test", help="People of the voices: test to report, validation to choose."),
    speakers: int | None = Option(None, min=1, help="Most speakers. Default: all of the part."),
    minutes: float = Option(1.0, min=0.1, help="Minutes of each speaker in each condition."),
    seeds: int = Option(8, min=1, help="Number of times that each speaker is played."),
    seed: int = SEED,
    jobs: int | None = JOBS,
    json: bool = JSON,
) -> None:
    """Count events a minute with unseen speakers: voice, face and both, in noise, rooms and bad pictures."""
    from sfms_robot.lab.evaluation.robustness import evaluate_robustness

    found = evaluate_robustness(
        listener, data, split=split, speakers=speakers, minutes=minutes, seeds=seeds, seed=seed, jobs=jobs
    )
    show(found, json, heading="{listener}: events a minute beside those of people, {people}")


@app.command()
def naturalness(
    listener: str = LISTENER,
    data: Path = Option(..., help="Composed dyads (`sfms-robot data compose`)."),
    split: str = Option("test", metavar="validation|test", help="People whose motion is compared with it."),
    clips: int | None = Option(None, min=1, help="Most dyads, spread evenly. Default: all."),
    drift: float = Option(600.0, min=30.0, metavar="S", help="Length of the run that is checked for drift."),
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
    frames: int | None = Option(None, min=2, help="Length of clips. Default: that of the shortest."),
    seed: int = SEED,
    json: bool = JSON,
) -> None:
    """Compute the papers' metrics of motion from files, such as your own system's, against recorded motion."""
    from sfms_robot.lab.evaluation.motion_metrics import evaluate_metrics

    show(
        evaluate_metrics(truth, prediction, speaker, space=space, frames=frames, seed=seed),
        json,
        note="interval: 95 % over clips",
    )


@app.command()
def interaction(
    listener: str = Option("arig-small", help="Shipped listener, or a folder with config.yaml and weights."),
    data: Path = Option(..., help="Composed dyads with interaction/ and speaking/ (`sfms-robot data compose`)."),
    clips: int | None = Option(None, min=1, help="Most dyads of each set. Default: all."),
    split: Unseen = SPLIT,
    seed: int = SEED,
    json: bool = JSON,
) -> None:
    """Score a listener that speaks: its states against labels, its lips, and the borders of its chunks."""
    from sfms_robot.lab.evaluation.interaction import evaluate_interaction

    show(evaluate_interaction(listener, data, clips, seed, split), json, _print_interaction)


@app.command()
def people(
    listener: list[str] = Option(
        [], metavar="NAME|DIR|recorded", help="Two or more listeners; recorded: the people of --data."
    ),
    data: Path | None = Option(
        None,
        help="Composed dyads, or any data set with voices; default: bundled voices that no listener was trained on.",
    ),
    split: Unseen = SPLIT,
    voices: int = Option(8, min=1, help="Voices for each listener."),
    seconds: float = Option(12.0, min=2.0, max=60.0, help="Length of a clip."),
    seed: int = SEED,
    out: Path = Option(
        Path("sfms-people"), metavar="DIR", help="The study: clips and answers; continued if it exists."
    ),
    view: str = Option("auto", metavar="[HOST:]PORT", help="Address of the page. Default: only this machine."),
    results: Path | None = Option(
        None, metavar="FILE.csv", help="Print the table of these answers without serving a page."
    ),
    json: bool = JSON,
) -> None:
    """Serve a blind study: people choose which of two listens more like a person. Ctrl-C prints a table."""
    from sfms_robot.lab.evaluation import people_study

    if results is not None:
        show(people_study.summary(people_study.read_answers(results)), json, heading=_ANSWERS)
        return
    study = people_study.prepare(listener, data, split, voices=voices, seconds=seconds, seed=seed, folder=out)

    def ask(url: str, taken: int | None) -> None:
        aside(f"people answer at {url}{f' (port {taken} is taken)' if taken else ''}; Ctrl-C ends")

    try:
        people_study.serve(study, view, ask)
    finally:
        show(study.results(), json, heading=_ANSWERS)


@app.command()
def fidelity(
    head: list[str] = Option([], metavar="NAME|DIR", help="May be repeated. Default: all shipped heads."),
    data: Path | None = Option(None, metavar="DIR", help="Face tracks (CSV) instead of the bundled ones."),
    json: bool = JSON,
) -> None:
    """Measure the share of recorded faces' motion that a head can show, on the skin of the virtual head."""
    from sfms_robot.app.head.head_check import fidelity as measure

    show(measure(head, data), json)


def _quiet(*_: Any) -> None:
    """Print nothing."""


def _print_paper(name: str, found: Result) -> None:
    """Print one table of `evaluate papers` when it is finished."""
    say(f"ARIG, table {name.removeprefix('arig-')}" if name.startswith("arig") else f"SFMS, table {name}", "bold")
    (_print_tokenizers if name in ("3", "4") else print_report)(found)


def _print_tokenizers(found: Result) -> None:
    """Print table 3 or 4 of the SFMS paper, or both."""
    for table in found.get("tables", [found]):
        print_report(table, _TABLES[table["table"]], ("rows", "ratios", "claims", "truth_silhouette", "not_trained"))
    say(f"{found['windows']} windows of {found['data']}; mse is the {found['unit']}", "dim")
    say("The paper's figures are of other motion: compare ratios.", "dim")


def _print_interaction(result: Result) -> None:
    """Print every figure; then the states, labels down, answers across, in percent of the label."""
    confusion = result.get("confusion") or {"states": [], "label_by_answer": []}
    print_report({key: value for key, value in result.items() if key != "confusion"})
    rows = []
    for name, counts in zip(confusion["states"], confusion["label_by_answer"], strict=True):
        total = sum(counts)
        shares = [f"{100 * count / total:.0f}" if total else "-" for count in counts]
        rows.append({"label": name, **dict(zip(confusion["states"], shares, strict=True)), "frames": total})
    print_rows(rows, "answer, % of the label")
