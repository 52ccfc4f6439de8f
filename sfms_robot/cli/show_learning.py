"""What `train`, `evaluate` and `data` show a person, and the one JSON object they print instead when asked for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sfms_robot.cli.json_line import print_json
from sfms_robot.cli.show import cell, print_rows, screen

_SHOWN = 3  # names of a problem; --json has them all

TITLES = {
    "3": "Table III: where keyframes go",
    "4": "Table IV: kinds of codes",
}


def show(figures: Mapping[str, Any], json: bool, printed: Callable[[Mapping[str, Any]], None] | None = None) -> None:
    """One JSON object, or what `printed` makes of the figures; without it, one of them a line."""
    if json:
        print_json(figures)
    elif printed is not None:
        printed(figures)
    else:
        for key, value in figures.items():
            print(f"{key}: {value}")


def print_figures(result: Mapping[str, Any]) -> None:
    """The rows of a result."""
    print_rows(result["rows"])


# --- evaluate listener ------------------------------------------------------------------------------------------


def print_listener_table(result: Mapping[str, Any]) -> None:
    """Table 1 of the SFMS paper, a part of the face at a time, or its table 2."""
    _print_parts(result["rows"])
    _print_intervals(result["rows"])
    screen().print(
        f"{result['clips']} clips of {result['frames']} frames, {result['samples']} samples; {result['features']}. "
        "The paper's rows are from other data; FRRea, a distance between rendered pictures, is out of scope.",
        soft_wrap=True,
    )


def print_paper_table(name: str, found: Mapping[str, Any]) -> None:
    """One table of `evaluate papers`."""
    screen().rule(f"ARIG, table {name.removeprefix('arig-')}" if name.startswith("arig") else f"SFMS, table {name}")
    if name in ("1", "2"):
        print_listener_table(found)
    elif name in ("3", "4"):
        print_tokenizer_tables(found)
    else:
        print_arig_table(found)
    for row, recipe in found.get("not_trained", {}).items():
        screen().print(f"{row}: not trained ({recipe})", soft_wrap=True, markup=False)


def print_arig_table(found: Mapping[str, Any]) -> None:
    """Table 1, 2 or 4 of the ARIG paper."""
    print_rows([{key: value for key, value in row.items() if key != "interval"} for row in found["rows"]])
    _print_intervals(found["rows"])


def _print_intervals(rows: Sequence[Mapping[str, Any]]) -> None:
    for row in rows:
        if row.get("interval"):
            ends = ", ".join(f"{key} [{low:.3g}, {high:.3g}]" for key, (low, high) in row["interval"].items())
            screen().print(f"{row['name']}, 95 % over people: {ends}", soft_wrap=True, markup=False)


def _print_parts(rows: Sequence[Mapping[str, Any]]) -> None:
    for part in ("expression", "rotation", ""):
        keys = (
            [key for key in rows[0] if key.startswith(part + " ")]
            if part
            else [key for key in rows[0] if key[0] == "F"]
        )
        if keys:
            table = Table("", "from", *(key.removeprefix(part).strip() for key in keys), title=part or None)
            for row in rows:
                table.add_row(row["name"], row["source"], *(cell(row.get(key)) for key in keys))
            screen().print(table)


# --- evaluate timing, evaluate robustness -----------------------------------------------------------------------


def print_timing(result: Mapping[str, Any]) -> None:
    """Figures with their intervals; how well events are seen in motion; what has to be said with it."""
    print_rows(result["rows"])
    console = screen()
    for title, told in (("known events", result["detector"]), ("events asked for", result["asked_and_seen"])):
        for kind, one in told.items():
            shares = ", ".join(f"{name} {cell(one[name])}" for name in ("recall", "precision"))
            console.print(
                f"{title}: of {one['asked']} {kind}s {one['seen']} seen, {shares}, late by {cell(one['offset_s'])} s"
            )
    console.print(
        f"{result['people']} people of {result['split']}, {result['meetings']} meetings, "
        f"{result['minutes']:g} minutes, {result['seeds']} seeds; in brackets 95 % intervals over people. "
        f"{'; '.join(result['notes'])}.",
        soft_wrap=True,
    )


def print_robustness(result: Mapping[str, Any]) -> None:
    """A row for every speaker in every way; then what is not as people do."""
    print_rows(result["rows"])
    ranges = ", ".join(
        f"{name.replace('_', ' ')} {low:g} to {high:g}" for name, (low, high) in result["people"].items()
    )
    screen().print(
        f"people: {ranges}; {len(result['outside'])} of {len(result['rows'])} rows are outside. Variance over mean of "
        f"nods, median: {cell(result['nods_variance_over_mean'])}.",
        soft_wrap=True,
    )


# --- train --dry-run ---------------------------------------------------------------------------------------------


def print_dry_run(result: Mapping[str, Any]) -> None:
    """What a step of every stage does, and hours of all of them on GPUs."""
    print_rows(result["rows"])
    hours = ", ".join(f"{gpu} {hours:g} h" for gpu, hours in result["hours"].items())
    screen().print(f"all stages, computed: {hours}; {result['assumed']}.", soft_wrap=True)


# --- evaluate interaction ---------------------------------------------------------------------------------------


def print_interaction(result: Mapping[str, Any]) -> None:
    """Every figure on a line; then the states, labels down, answers across, in percent of the label."""
    print_rows([{"figure": key.replace("_", " "), "value": value} for key, value in result.items()
                if not isinstance(value, dict)])  # fmt: skip
    confusion = result.get("confusion")
    if confusion is None:
        return
    table = Table("label \\ answer, %", *(name.replace("_", " ") for name in confusion["states"]), "frames")
    for name, row in zip(confusion["states"], confusion["label_by_answer"], strict=True):
        total = sum(row)
        shares = (f"{100 * count / total:.0f}" if total else "-" for count in row)
        table.add_row(name.replace("_", " "), *shares, str(total))
    screen().print(table)


# --- evaluate tokenizer -----------------------------------------------------------------------------------------


def print_tokenizer_tables(result: Mapping[str, Any]) -> None:
    """What `evaluate tokenizer --table` found."""
    console = screen()
    for table in result.get("tables", [result]):
        _print_table(console, table)
    console.print(f"{result['windows']} windows of {result['data']}; MSE is the {result['unit']}. "
                  "The paper's figures are of other motion: compare ratios.", style="dim")  # fmt: skip


def _print_table(console: Console, found: Mapping[str, Any]) -> None:
    name = str(found["table"])
    table = Table(title=TITLES[name])
    table.add_column("")
    for heading in (
        "k",
        "params",
        "bits/window",
        "MSE",
        "median",
        "angles rad",
        "shapes",
        "silhouette",
        "separation",
        "paper MSE",
    ):
        table.add_column(heading, justify="right")
    for row in found["rows"]:
        paper = row["paper_mse_e2"]
        table.add_row(
            row["name"] + (f"  [dim]{row['note']}[/dim]" if row["note"] else ""),
            "" if row["k"] is None else str(row["k"]),
            f"{row['params'] / 1e6:.2f} M",
            f"{row['bits_per_window']:,.0f}",
            f"{row['mse']:.4f}",
            f"{row['median']:.4f}",
            f"{row['angle_rmse_rad']:.4f}",
            f"{row['shape_rmse']:.4f}",
            cell(row["silhouette"]),
            cell(row["separation"]),
            "" if paper is None else f"{paper:.2f}e-2",
        )
    console.print(table)
    console.print(f"silhouette of the windows as they are: {cell(found['truth_silhouette'])}")
    for line in _lines(found):
        console.print(line)


def _lines(found: Mapping[str, Any]) -> Iterator[str]:
    for name, ratio in found.get("ratios", {}).items():
        shown = (
            ", ".join(f"k = {k}: {value:.2f}" for k, value in ratio.items())
            if isinstance(ratio, Mapping)
            else f"{ratio:.3f} (1/{1 / ratio:.1f})"
        )
        yield f"{name.replace('_', ' ')}: {shown}"


# --- data check -------------------------------------------------------------------------------------------------


def print_check(report: Mapping[str, Any], channels: bool) -> None:
    """Splits, what is wrong with them, and on request the range of every channel."""
    console = screen()
    order = f", {report['order']}" if report["order"] else ""
    first = report["splits"][0]
    table = Table(title=f"{report['layout']}{order}: {first['space']} at {first['fps']:g} fps")
    for name in ("split", "clips", "minutes", "frames", "listening", "sound", "features"):
        table.add_column(name, overflow="fold")
    for split in report["splits"]:
        table.add_row(
            split["split"], str(split["clips"]), f"{split['minutes']:.1f}", _span(split["frames"]),
            "-" if split["listening_share"] is None else f"{split['listening_share']:.0%}",
            _counts(split["sound"]), _counts(split["features"]),
        )  # fmt: skip
    console.print(report["folder"], soft_wrap=True)
    if report["licence"]:
        console.print(f"licence: {report['licence']}", soft_wrap=True)
    console.print(table)
    if channels:
        for split in report["splits"]:
            _print_channels(console, split)
    _print_problems(console, report)


def _print_channels(console: Console, split: Mapping[str, Any]) -> None:
    table = Table("channel", "min", "max", "mean", "std", title=f"{split['split']}: the listeners' motion")
    for row in split["channels"]:
        table.add_row(row["name"], *(f"{row[key]:.3f}" for key in ("min", "max", "mean", "std")))
    console.print(table)


def _print_problems(console: Console, report: Mapping[str, Any]) -> None:
    table = Table("split", "problem", "count", "where", "first", title="left out, or wrong")
    for split in report["splits"]:
        for problem in split["problems"]:
            more = "" if problem["count"] <= _SHOWN else f" and {problem['count'] - _SHOWN} more"
            names = "\n".join(problem["names"][:_SHOWN]) + more
            table.add_row(split["split"], problem["kind"], str(problem["count"]), names, problem["first"])
    if table.row_count:
        console.print(table)
    for note in dict.fromkeys(note for split in report["splits"] for note in split["notes"]):
        console.print(escape(note), style="dim", soft_wrap=True)
    for split in report["splits"]:
        if split["speaker_unknown_frames"]:
            console.print(
                f"{split['split']}: the speaker's face is unknown in {split['speaker_unknown_frames']} frames",
                style="dim",
            )
    console.print("usable" if report["usable"] else "not usable as it is")


def _span(frames: Mapping[str, float] | None) -> str:
    if frames is None:
        return "-"
    return f"{frames['min']:g}" if frames["min"] == frames["max"] else f"{frames['min']:g}-{frames['max']:g}"


def _counts(counts: Mapping[str, int]) -> str:
    return "\n".join(f"{name} {count}" for name, count in counts.items()) or "-"


def print_conversion(report: Mapping[str, Any]) -> None:
    """Splits that were written, what was left out of them, and what the conversion lost."""
    console = screen()
    console.print(f"{report['layout']}: {report['folder']} -> {report['out']}", soft_wrap=True)
    if report["licence"]:
        console.print(f"licence: {report['licence']}", soft_wrap=True)
    print_rows([{key: split[key] for key in ("split", "clips", "minutes")} for split in report["splits"]])
    for split in report["splits"]:
        for problem in split["left_out"]:
            told = f"{split['split']}: {problem['count']} left out, {problem['kind']}: {problem['first']}"
            console.print(escape(told), soft_wrap=True)
    for key, meaning in report["residual_names"].items():
        if report["residual"][key] is not None:
            console.print(f"{meaning}: {cell(report['residual'][key])}", soft_wrap=True)
    for note in dict.fromkeys([*report["notes"], *(note for split in report["splits"] for note in split["notes"])]):
        console.print(escape(note), style="dim", soft_wrap=True)


# --- evaluate people --------------------------------------------------------------------------------------------


def print_preferences(result: Mapping[str, Any]) -> None:
    """Per question and pair who was chosen how often; of three and more, Bradley and Terry's strengths."""
    console = screen(highlight=False)
    if not result["answers"]:
        console.print("nobody has answered yet")
        return
    table = Table("question", "first", "second", "first : second : neither", "first chosen, 95 %", "p")
    for row in result["rows"]:
        share = "-"
        if row["share"] is not None:
            low, high = row["interval"]
            share = f"{row['share']:.0%}  [{low:.0%}, {high:.0%}]"
        counts = f"{row['first_chosen']} : {row['second_chosen']} : {row['neither']}"
        p = "-" if row["p"] is None else f"{row['p']:.3f}"
        table.add_row(row["question"], row["first"], row["second"], counts, escape(share), p)
    console.print(table)
    for question, strengths in result["bradley_terry"].items():
        told = []
        for name, each in sorted(strengths.items(), key=lambda item: -item[1]["strength"]):
            interval = "" if each["interval"] is None else " [{:+.2f}, {:+.2f}]".format(*each["interval"])
            told.append(f"{name} {each['strength']:+.2f}{interval}")
        console.print(escape(f"{question}, Bradley-Terry: {', '.join(told)}"))
    left, right = result["sides"]["left"], result["sides"]["right"]
    console.print(f"{result['participants']} people, {result['answers']} answers; left {left} times, right {right}")
