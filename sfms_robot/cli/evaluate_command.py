"""`sfms-robot evaluate`: what a listener's parts are worth on held-out dyads, and a head's joints on faces."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path

import typer

from sfms_robot.cli.data_command import Order
from sfms_robot.cli.run_command import MAX_SEED
from sfms_robot.cli.train_command import ORDER, interruptible

app = typer.Typer(help="Evaluate listeners on held-out dyads, and heads on recorded faces.", no_args_is_help=True)


class Size(StrEnum):
    small = "small"
    paper = "paper"


class Table(StrEnum):
    """1 and 2 of SFMS; those of ARIG."""

    one = "1"
    two = "2"
    arig_1 = "arig-1"
    arig_2 = "arig-2"
    arig_4 = "arig-4"


class Part(StrEnum):
    """Of meetings and voices (`corpora.splits`)."""

    train = "train"
    validation = "validation"
    test = "test"


LISTENER = typer.Option("sfms-small", help="Shipped listener, or a folder with config.yaml and weights.")
JSON = typer.Option(False, "--json", help="Print one JSON object.")
ENGINES, ENGINE_HELP = "auto|onnx|torch", "What computes the listener; its precision is as its config.yaml says."
HOP = typer.Option(None, min=1, help="Frames between plans, as a run chooses them; default: what its config.yaml says.")


@app.command()
def tokenizer(
    listener: str = LISTENER,
    table: str | None = typer.Option(None, metavar="3|4|all", help="A table of the SFMS paper, or both."),
    data: Path | None = typer.Option(
        None, help="Composed dyads; with --table any folder of face tracks (CSV), or the held-out recordings."
    ),
    models: Path | None = typer.Option(None, help="Folder of the table's tokenizers, trained if missing; the shipped."),
    train: bool = typer.Option(False, "--train", help="Train the table's tokenizers anew, into --models."),
    size: Size = typer.Option(Size.small, help="Of what is trained; paper: for a GPU."),
    steps: int | None = typer.Option(None, min=1, help="Another number of training steps than the size's."),
    jobs: int = typer.Option(1, min=1, help="Tokenizers trained at once."),
    plots: Path | None = typer.Option(None, metavar="DIR", help="Draw the pictures of --table as PNG files."),
    order: Order | None = ORDER,
    json: bool = JSON,
) -> None:
    """Reconstruction error: a listener's by keyframe placement, or a table of the SFMS paper."""
    from sfms_robot.cli.show_learning import print_figures, print_tokenizer_tables, show

    if table is None:
        from sfms_robot.lab.evaluation.listener_evaluation import evaluate_tokenizer

        if data is None:
            raise typer.BadParameter("--data is needed without --table")
        show(evaluate_tokenizer(listener, data, order.value if order else None), json, print_figures)
        return
    from sfms_robot.lab.evaluation.tokenizer_tables import TableOptions, evaluate_table

    options = TableOptions(
        table=table, data=data, models=models, train=train, size=size.value, steps=steps, jobs=jobs, plots=plots
    )
    show(interruptible(lambda: evaluate_table(options)), json, print_tokenizer_tables)


@app.command("listener")
def listener_(
    listener: list[str] = typer.Option(
        [], metavar="NAME|DIR", help="May be given often. sfms-small; arig-small for the tables of ARIG."
    ),
    data: Path = typer.Option(..., help="Composed dyads, or with --table any data set (see `sfms-robot data check`)."),
    table: Table | None = typer.Option(
        None, help="Of the SFMS paper: 1 as on L2L, 2 as on REACT. Of the ARIG paper: 2, and ablations 1 and 4."
    ),
    samples: int = typer.Option(10, min=1, help="Answers to every clip, for --table 1 and 2."),
    clips: int | None = typer.Option(None, min=1, help="At most this many dyads, for --table; all of them."),
    models: Path | None = typer.Option(
        None, help="Folder of the papers' listeners as written, and of ablations; those missing are trained."
    ),
    config: Path | None = typer.Option(None, help="How ablations are trained; configs/training/arig-as-written.yaml."),
    steps: int | None = typer.Option(None, min=1, help="Another number of training steps than the file's."),
    seed: int = typer.Option(1, min=0, max=MAX_SEED, help="Of the sampling."),
    hop: int | None = HOP,
    order: Order | None = ORDER,
    json: bool = JSON,
) -> None:
    """Nods, blinks, smiles and smoothness of listeners beside those of the dyads' own; or a table of a paper."""
    from sfms_robot.cli.show_learning import print_arig_table, print_figures, print_listener_table, show

    of_arig = table is not None and table.value.startswith("arig")
    listener = listener or ["arig-small" if of_arig else "sfms-small"]
    if table is None:
        from sfms_robot.lab.evaluation.listener_evaluation import evaluate_listener

        show(evaluate_listener(listener, data, seed, order.value if order else None, hop), json, print_figures)
        return
    if of_arig:
        if order is not None or hop is not None:
            raise typer.BadParameter("--order and --hop are for --table 1 and 2, or none")
        from sfms_robot.lab.evaluation.arig_tables import AblationOptions, arig_table

        ablations = AblationOptions(models, config, steps)
        found = interruptible(lambda: arig_table(table.value, listener, data, clips, seed, ablations))
        show(found, json, print_arig_table)
        return
    from sfms_robot.lab.evaluation.papers import sfms_table

    result = interruptible(
        lambda: sfms_table(
            int(table.value),
            listener,
            data,
            samples=samples,
            limit=clips,
            seed=seed,
            order=order.value if order else None,
            hop=hop,
            models=models,
            steps=steps,
        )
    )
    show(result, json, print_listener_table)


@app.command()
def papers(
    data: Path = typer.Option(..., help="Composed dyads."),
    models: Path | None = typer.Option(
        None, help="Folder of what only tables need; what is missing is trained: hours. Without it: said to be missing."
    ),
    table: list[str] = typer.Option(
        [], metavar="1|2|3|4|arig-1|arig-2|arig-4", help="May be given often; all of them if not."
    ),
    clips: int | None = typer.Option(None, min=1, help="At most this many dyads a table; all of them."),
    samples: int = typer.Option(10, min=1, help="Answers to every clip of tables 1 and 2."),
    steps: int | None = typer.Option(None, min=1, help="Another number of steps than the training files'."),
    seed: int = typer.Option(1, min=0, max=MAX_SEED, help="Of the sampling."),
    json: bool = JSON,
) -> None:
    """Every table of both papers: the papers as written beside the shipped listeners, and what they report."""
    from sfms_robot.cli.show_learning import print_paper_table, show
    from sfms_robot.lab.evaluation.papers import EVERY, PapersOptions, evaluate_papers

    options = PapersOptions(
        data=data, models=models, tables=table or EVERY, clips=clips, samples=samples, steps=steps, seed=seed
    )
    each = (lambda name, found: None) if json else print_paper_table
    show(interruptible(lambda: evaluate_papers(options, each)), json, lambda found: None)


@app.command()
def timing(
    listener: str = LISTENER,
    data: Path = typer.Option(..., help="Folder of AMI tables (words, head_gestures, ...; CSV or CSV.gz)."),
    split: Part = typer.Option(Part.test, help="Whose meetings: test for what is reported, validation to choose by."),
    allow_training: bool = typer.Option(False, "--allow-training", help="Play people that listeners learned from."),
    meetings: int | None = typer.Option(None, min=1, help="At most this many, spread over the people; all of them."),
    minutes: float = typer.Option(
        5.0, min=0.0, help="Of motion, from the middle of each meeting; 0: hazards and decisions alone, in minutes."
    ),
    seeds: int = typer.Option(8, min=1, help="How often each meeting is played."),
    seed: int = typer.Option(1, min=0, max=MAX_SEED, help="Of voices, sampling and intervals."),
    jobs: int | None = typer.Option(None, min=1, help="Processes; as many as there are cores."),
    hop: int | None = HOP,
    engine: str = typer.Option("torch", metavar=ENGINES, help=ENGINE_HELP),
    own_voice: bool = typer.Option(False, "--own-voice", help="It speaks when the person did; else it never does."),
    json: bool = JSON,
) -> None:
    """Nods, blinks, smiles and gaze shifts of the listener in real meetings, beside those of the people."""
    from sfms_robot.app.listen.preflight import engine_named
    from sfms_robot.cli.show_learning import print_timing, show
    from sfms_robot.lab.evaluation.meetings import TimingOptions, evaluate_timing

    runs_on = engine_named(engine)
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
        engine=runs_on,
        own_voice=own_voice,
    )
    show(evaluate_timing(options), json, print_timing)


@app.command()
def robustness(
    listener: str = LISTENER,
    data: Path | None = typer.Option(
        None, metavar="DIR", help="Folder with more voices (speech_audio, conversation_audio, ...); the bundled ones."
    ),
    split: Part = typer.Option(Part.test, help="Whose voices: test for what is reported, validation to choose by."),
    speakers: int | None = typer.Option(None, min=1, help="At most this many; everybody of the part."),
    minutes: float = typer.Option(1.0, min=0.1, help="Of each, in each way."),
    seeds: int = typer.Option(8, min=1, help="How often each is played."),
    seed: int = typer.Option(1, min=0, max=MAX_SEED, help="Of the sampling, and of what is spoilt."),
    jobs: int | None = typer.Option(None, min=1, help="Processes; as many as there are cores."),
    json: bool = JSON,
) -> None:
    """Events a minute with unseen speakers: voice, face and both, in noise, rooms and bad pictures."""
    from sfms_robot.cli.show_learning import print_robustness, show
    from sfms_robot.lab.evaluation.robustness import evaluate_robustness

    found = evaluate_robustness(
        listener, data, split=split.value, speakers=speakers, minutes=minutes, seeds=seeds, seed=seed, jobs=jobs
    )
    show(found, json, print_robustness)


@app.command()
def naturalness(
    listener: str = LISTENER,
    data: Path = typer.Option(..., help="Composed dyads (`sfms-robot data compose`)."),
    split: str = typer.Option("test", metavar="validation|test", help="Whose motion it is held against."),
    clips: int | None = typer.Option(None, min=1, help="At most this many dyads, spread evenly; all of them."),
    drift: float = typer.Option(600.0, min=30.0, metavar="S", help="Length of the run that is looked at for drift."),
    seed: int = typer.Option(1, min=0, max=MAX_SEED, help="Of the sampling."),
    engine: str = typer.Option("auto", metavar=ENGINES, help=ENGINE_HELP),
    json: bool = JSON,
) -> None:
    """How a listener moves beside people whose motion it never saw: nods, smiles, gaze, sway, and a network's guess."""
    from sfms_robot.app.listen.preflight import engine_named
    from sfms_robot.cli.show_learning import show
    from sfms_robot.lab.evaluation.naturalness import evaluate_naturalness

    show(evaluate_naturalness(listener, data, split, clips, drift, seed, engine_named(engine)), json)


@app.command("metrics")
def metrics_(
    truth: Path = typer.Option(..., help="Recorded motion: array (.npy), face track (CSV), or a folder of tracks."),
    prediction: Path = typer.Option(..., help="Motion to score, likewise; an array may hold K answers, (N, K, T, D)."),
    speaker: Path | None = typer.Option(None, help="The speakers' motion: for P-FD, RPCC and FRSyn."),
    space: str | None = typer.Option(None, metavar="SPACE", help="arkit58, faceverse58, deca56, attributes25."),
    frames: int | None = typer.Option(None, min=2, help="Cut clips to so many; default: to the shortest."),
    seed: int = typer.Option(1, min=0, max=MAX_SEED, help="Of the intervals."),
    json: bool = JSON,
) -> None:
    """The papers' metrics of any motion beside recorded motion: of your own system, from files."""
    from sfms_robot.cli.show_learning import print_figures, show
    from sfms_robot.lab.evaluation.motion_metrics import MetricFiles, evaluate_metrics

    files = MetricFiles(truth=truth, prediction=prediction, speaker=speaker, space=space, frames=frames)
    show(evaluate_metrics(files, seed), json, print_figures)


@app.command()
def interaction(
    listener: str = typer.Option("arig-small", help="Shipped listener, or a folder with config.yaml and weights."),
    data: Path = typer.Option(..., help="Composed dyads with interaction/ and speaking/ (`sfms-robot data compose`)."),
    clips: int | None = typer.Option(None, min=1, help="At most this many dyads of each set; all of them."),
    seed: int = typer.Option(1, min=0, max=MAX_SEED, help="Of the sampling."),
    json: bool = JSON,
) -> None:
    """What a listener that speaks is worth: its states against labels, its lips, and the joints of its chunks."""
    from sfms_robot.cli.show_learning import print_interaction, show
    from sfms_robot.lab.evaluation.interaction import evaluate_interaction

    show(evaluate_interaction(listener, data, clips, seed), json, print_interaction)


@app.command()
def people(
    listener: list[str] = typer.Option(
        [], metavar="NAME|DIR|recorded", help="Two or more: listeners, and what the people of --data did."
    ),
    data: Path | None = typer.Option(
        None, help="Composed dyads, or any data set with voices; default: bundled voices nobody was trained on."
    ),
    voices: int = typer.Option(8, min=1, help="Voices that each listens to."),
    seconds: float = typer.Option(12.0, min=2.0, max=60.0, help="Length of a clip."),
    seed: int = typer.Option(1, min=0, max=MAX_SEED, help="Of the sampling, the order and the sides."),
    out: Path = typer.Option(
        Path("sfms-people"), metavar="DIR", help="The study: clips and answers; goes on if there."
    ),
    view: str = typer.Option("auto", metavar="[HOST:]PORT", help="Where the page is; this machine alone unless told."),
    results: Path | None = typer.Option(None, metavar="FILE.csv", help="Ask nobody: what these answers say."),
    json: bool = JSON,
) -> None:
    """A page that asks people, blind, which of two listens more like a person; Ctrl-C ends it, with a table."""
    from sfms_robot.cli.show_learning import print_preferences, show
    from sfms_robot.lab.evaluation import people_study

    if results is not None:
        show(people_study.table(results), json, print_preferences)
        return
    options = people_study.StudyOptions(
        conditions=tuple(listener), data=data, voices=voices, seconds=seconds, seed=seed, folder=out
    )
    study = people_study.prepare(options)
    try:
        people_study.serve(study, view, _ask)
    finally:
        show(study.results(), json, print_preferences)


def _ask(url: str, taken: int | None) -> None:
    note = "" if taken is None else f" (port {taken} is taken)"
    print(f"people answer at {url}{note}; Ctrl-C ends", file=sys.stderr, flush=True)


@app.command()
def fidelity(
    head: list[str] = typer.Option([], "--head", metavar="NAME|DIR", help="May be given often; all shipped heads."),
    data: Path | None = typer.Option(None, "--data", metavar="DIR", help="Face tracks (CSV) in place of the bundled."),
    json: bool = JSON,
) -> None:
    """The share of each recorded face's motion that a head can show, on the skin of the virtual head."""
    from sfms_robot.app.head.fidelity import fidelity as measure
    from sfms_robot.cli.show_learning import print_figures, show

    show(measure(head, data), json, print_figures)
