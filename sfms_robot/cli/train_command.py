"""`sfms-robot data`, `train` and `export`: training data, the phases of a listener, and its networks without torch."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from typer import Argument, Exit, Option, Typer

from sfms_robot.cli.show import JSON, Later, Result, aside, cell, print_rows, say, show, with_shared_options
from sfms_robot.data import Report, listener_names
from sfms_robot.errors import INTERRUPTED, ConfigError

if TYPE_CHECKING:
    from sfms_robot.lab.corpora import data_commands
    from sfms_robot.lab.learning import train_runs
else:
    data_commands = Later("sfms_robot.lab.corpora.data_commands")
    train_runs = Later("sfms_robot.lab.learning.train_runs")

app = Typer(
    help="Train a listener: its tokenizer, its predictor, its hazards and its motion at rest.", no_args_is_help=True
)
data_app = Typer(help="Training data: compose dyads, check and convert data sets.", no_args_is_help=True)

_SHOWN = 3  # names shown for a problem; --json has them all


Order = Literal["exp-first", "pose-first"]
CONFIG = Option(..., help="A configs/training/*.yaml, or your own.")
ORDER = Option(None, help="Order of the channels in the files; default: the layout's own.")
LAYOUT = Option(
    "auto",
    help="composed, l2l, lm_listener, react, react2025, dualtalk, dualtalk_arkit, dim, vico, seamless; "
    "default: found automatically.",
)


# --- train ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class PhaseFlags:
    """Options of both phases of training. Each field is an option of both."""

    config: Path = CONFIG
    data: Path | None = Option(
        None, help="Folder with train/ and validation/ (see `sfms-robot data compose`), or a `train pack`."
    )
    out: Path | None = Option(None, help="Folder for config.yaml, weights and checkpoints, for `run --listener`.")
    resume: bool = Option(
        False, "--resume", help="Continue from the checkpoint in --out, with the same settings and data."
    )
    overwrite: bool = Option(False, "--overwrite", help="Replace an earlier training in --out.")
    device: Literal["auto", "cpu", "cuda"] = Option("auto", help="auto: the GPU if there is one.")
    steps: int | None = Option(None, min=1, help="Training steps. Default: those of the file.")
    tensorboard: bool | None = Option(
        None, help="Write curves to OUT/tensorboard. Default: if tensorboard is installed."
    )
    order: Order | None = ORDER
    accumulate: int | None = Option(
        None, min=1, help="Pieces of a step's batch that each process computes one after the other; saves memory."
    )
    scratch: Path | None = Option(None, help="Folder for frames, which are then read from disk instead of memory.")
    dry_run: bool = Option(
        False,
        "--dry-run",
        help="Run one step of every stage on made-up frames, and estimate the whole training; needs no data.",
    )
    json: bool = JSON


@app.command()
@with_shared_options
def tokenizer(
    flags: PhaseFlags,
    placement: Literal["exact", "static", "static_paper", "learned"] | None = Option(
        None, help="Keyframe placement, to compare. Default: that of the file."
    ),
) -> None:
    """Phase 1: keyframes, codes and inpainting (reconstruction of listener motion)."""
    _train(train_runs.train_tokenizer, flags, {"placement": placement} if placement else {})


@app.command()
@with_shared_options
def listener(flags: PhaseFlags) -> None:
    """Phase 2: the next-token predictor, on the tokenizer found in --out."""
    _train(train_runs.train_listener, flags, {})


def _train(work: Callable[[train_runs.TrainOptions], Report], flags: PhaseFlags, changes: Mapping[str, str]) -> None:
    """Run a phase of training, or one step of every phase, and print its figures."""
    if flags.dry_run:
        from sfms_robot.config import load_training
        from sfms_robot.lab.learning.train_runs import dry_run

        note = "hours of all stages, computed; {assumed}"
        show(dry_run(load_training(flags.config)), flags.json, keys=("rows", "hours"), note=note)
        return
    if flags.data is None or flags.out is None:
        raise ConfigError(f"{'--data' if flags.data is None else '--out'} is missing; only --dry-run goes without")
    options = train_runs.TrainOptions(
        file=flags.config,
        data=flags.data,
        out=flags.out,
        resume=flags.resume,
        device=flags.device,
        steps=flags.steps,
        changes=changes,
        tensorboard=flags.tensorboard,
        order=flags.order,
        overwrite=flags.overwrite,
        accumulate=flags.accumulate,
        scratch=flags.scratch,
    )
    figures = interruptible(lambda: work(options))
    if not figures:  # in a process that is not the first of its group
        return
    if figures["resumed_at"] == figures["steps"]:
        aside(f"sfms-robot: had already finished at step {figures['steps']}")
    show(figures, flags.json)


def interruptible(train: Callable[[], Report]) -> Report:
    """Return the figures of a training; Ctrl-C ends the process, and prints how to continue if it can be continued."""
    try:
        return train()
    except KeyboardInterrupt as stopped:
        aside(f"sfms-robot: {stopped if stopped.args else 'interrupted'}")
        sys.exit(INTERRUPTED)


@app.command()
def pack(
    config: Path = CONFIG,
    data: Path = Option(..., help="Folder with train/ and validation/ (see `sfms-robot data compose`)."),
    out: Path = Option(..., metavar="FILE", help="Pack to write, for --data of a training with the same file."),
    order: Order | None = ORDER,
    json: bool = JSON,
) -> None:
    """Write the data of a training to one file, with which a trainer on another machine begins at once."""
    show(train_runs.pack_data(config, data, out, order), json)


@app.command()
def events(
    data: Path = Option(..., help="Folder of AMI tables (words, head_gestures, ...; CSV or CSV.gz)."),
    out: Path | None = Option(None, metavar="FILE", help="YAML file for the hazards."),
    all_series: bool = Option(
        False, "--all-series", help="Learn from all people, to compare; the result has seen the test set."
    ),
    seed: int = Option(1, min=0, help="Seed of the kept steps and of the roll-outs."),
    json: bool = JSON,
) -> None:
    """Train the hazards of nods, smiles, laughs and looks on listening people, in about a minute."""
    from sfms_robot.lab.learning.events.event_training import train_events

    show(interruptible(lambda: train_events(data, out, all_series, seed)), json)


@app.command()
def idle(
    listener: str = Option(..., metavar="NAME|DIR", help="Trained listener that follows events."),
    data: Path = Option(..., help="Folder with train/ and validation/ (see `sfms-robot data compose`)."),
    clips: int = Option(12, min=1, help="Training dyads that it listens to."),
    seed: int = Option(1, min=0, help="Seed of its draws."),
    json: bool = JSON,
) -> None:
    """Train the small motion of a resting face that a listener lacks, into its folder, in about a minute."""
    from sfms_robot.lab.learning.idle_fit import train_idle

    show(interruptible(lambda: train_idle(listener, data, clips, seed)), json)


# --- data -------------------------------------------------------------------------------------------------------------


@data_app.command()
def compose(
    data: Path = Option(..., help="Folder with ami_listener_annotations/ and, if available, more voices."),
    out: Path = Option(..., help="Folder to write train/, validation/ and test/ into."),
    minutes: float = Option(240.0, min=1.0, help="Minutes of training dyads, or all that the tables allow if fewer."),
    seed: int = Option(1, min=0, help="Seed; the same seed composes the same dyads."),
    overwrite: bool = Option(False, "--overwrite", help="Replace earlier dyads in --out."),
    jobs: int = Option(1, min=1, max=64, help="Processes, up to 9; the files are the same with any number."),
    json: bool = JSON,
) -> None:
    """Compose dyads from real listening events (AMI), real motion and real voices."""
    composed = data_commands.compose_dyads(data, out, minutes, seed, overwrite, jobs)
    show(composed, json, heading=f"minutes of dyads written to {out}")


@data_app.command()
def check(
    folder: Path = Argument(..., metavar="DIR", help="Data set, in the layout of its authors."),
    layout: str = LAYOUT,
    order: Order | None = ORDER,
    window: int = Option(0, min=0, help="Fewest frames of a clip."),
    channels: bool = Option(False, "--channels", help="Show the range of every channel."),
    json: bool = JSON,
) -> None:
    """Read a whole data set once, and report its contents and all its problems."""
    report = data_commands.check_data(folder, layout, order, window)
    show(report, json, partial(_print_data, channels=channels))
    if not report["usable"]:
        raise Exit(2)


@data_app.command()
def convert(
    folder: Path = Argument(..., metavar="IN", help="Data set, in the layout of its authors."),
    out: Path = Argument(..., metavar="OUT", help="Folder to write dyads into; must be empty or missing."),
    layout: str = LAYOUT,
    order: Order | None = ORDER,
    flame_matrix: Path | None = Option(
        None, help="FLAME coefficients of every ARKit blendshape (.npy, .csv): shows the expression of deca56 data."
    ),
    flame_order: str = Option("alphabetical", help="Order of the matrix's rows: alphabetical, apple, ..."),
    json: bool = JSON,
) -> None:
    """Convert a data set to dyads at 25 fps in this project's space, and report the loss."""
    show(data_commands.convert_data(folder, out, layout, order, flame_matrix, flame_order), json, _print_conversion)


def _print_conversion(report: Result) -> None:
    """Print the splits that were written, the clips left out of them, and the loss."""
    say(f"{report['layout']}: {report['folder']} -> {report['out']}")
    if report["licence"]:
        say(f"licence: {report['licence']}")
    print_rows([{key: split[key] for key in ("split", "clips", "minutes")} for split in report["splits"]])
    for split in report["splits"]:
        for each in split["left_out"]:
            say(f"{split['split']}: {each['count']} left out, {each['kind']}: {each['first']}")
    for key, meaning in report["residual_names"].items():
        if report["residual"][key] is not None:
            say(f"{meaning}: {cell(report['residual'][key])}")
    for note in dict.fromkeys([*report["notes"], *(note for split in report["splits"] for note in split["notes"])]):
        say(note, "dim")


def _print_data(report: Result, channels: bool) -> None:
    """Print splits, their problems, and with `channels` the range of every channel."""
    order = f", {report['order']}" if report["order"] else ""
    splits, first = report["splits"], report["splits"][0]
    say(f"{'usable' if report['usable'] else 'not usable'}: {report['folder']}", "bold")
    if report["licence"]:
        say(f"licence: {report['licence']}")
    rows = [
        {
            **{name: split[name] for name in ("split", "clips", "minutes")},
            "frames": _span(split["frames"]),
            "listening": None if split["listening_share"] is None else f"{split['listening_share']:.0%}",
            **{name: split[name] for name in ("sound", "features")},
        }
        for split in splits
    ]
    print_rows(rows, f"{report['layout']}{order}: {first['space']} at {first['fps']:g} fps")
    for split in splits if channels else ():
        figures = ("min", "max", "mean", "std")
        rows = [{"channel": row["name"], **{key: row[key] for key in figures}} for row in split["channels"]]
        print_rows(rows, f"{split['split']}: the listeners' motion")
    problems = [
        {
            "split": split["split"],
            "problem": problem["kind"],
            "count": problem["count"],
            "where": cell(problem["names"][:_SHOWN])
            + (f" and {problem['count'] - _SHOWN} more" if problem["count"] > _SHOWN else ""),
            "first": problem["first"],
        }
        for split in splits
        for problem in split["problems"]
    ]
    print_rows(problems, "left out, or wrong" if problems else "")
    for note in dict.fromkeys(note for split in splits for note in split["notes"]):
        say(note, "dim")
    for split in splits:
        if split["speaker_unknown_frames"]:
            say(f"{split['split']}: the speaker's face is unknown in {split['speaker_unknown_frames']} frames", "dim")


def _span(frames: Mapping[str, float] | None) -> str:
    if frames is None:
        return "-"
    return f"{frames['min']:g}" if frames["min"] == frames["max"] else f"{frames['min']:g}-{frames['max']:g}"


# --- export -----------------------------------------------------------------------------------------------------------


def export(
    listener: str = Argument(
        ..., autocompletion=listener_names, help="Shipped listener, or a folder with config.yaml."
    ),
    out: Path | None = Option(None, metavar="DIR", help="Write below this folder. Default: the listener's own."),
    int8: bool = Option(False, "--int8", help="Also with large layers in 8 bits (kind: arig), for large models."),
    weight_bits: int | None = Option(
        None, metavar="8|16|32", help="Also write the weights, in this many bits. Default: leave them."
    ),
    json: bool = JSON,
) -> None:
    """Write a listener's networks as ONNX graphs, which run without torch. Takes a minute.

    Graphs hold no weights, so training again with the same configuration needs no new ones. Weights in 8 bits take
    a quarter of the room; every engine computes with them as real numbers.
    """
    from sfms_robot.app.catalogue import export_listener

    files = export_listener(listener, out, int8, weight_bits)

    def printed(_: Result) -> None:
        for file in files:
            print(f"{file.stat().st_size / 1000:8.1f} kB  {file}")

    show({"listener": listener, "int8": int8, "files": [str(file) for file in files]}, json, printed)
