"""`sfms-robot demo`: a bundled person talks, an emulated head listens, and a page or two pictures show what it did."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.app import session
from sfms_robot.app.listen.page_session import page_session
from sfms_robot.app.listen.preflight import open_browser
from sfms_robot.config import load_head
from sfms_robot.errors import MissingExtra
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.sources.registry import DEFAULT_SPEAKER
from sfms_robot.viewer.page_process import PageProcess

FOLDER: Final = "sfms-demo"
PLOT, SHEET = "run.png", "head.png"


@dataclass(frozen=True)
class DemoOptions:
    """The flags of `sfms-robot demo`. `duration_s` None: the whole of what the person says, 47.7 s."""

    head: str = "face28"
    listener: str = "sfms-small"
    seed: int = 0
    duration_s: float | None = None
    fast: bool = False
    folder: Path | None = None
    overwrite: bool = False

    def run(self, seed: int, record: Path | None) -> session.RunOptions:
        """The person's voice alone: it is what any microphone gives."""
        return session.RunOptions(
            self.head, listener=self.listener, audio=DEFAULT_SPEAKER, face="none", duration_s=self.duration_s,
            fast=self.fast, seed=seed, record=record, overwrite=self.overwrite,
        )  # fmt: skip


def demo(options: DemoOptions, panel: session.Panel | None = None, page: PageProcess | None = None) -> dict[str, Any]:
    """Run once, record it, show it on a page or draw it. Raises RobotError.

    Blocks for the length of the run and some seconds; with a page for as long as somebody looks at it. What visitors
    choose there is run behind it, unrecorded. Without the packages that a picture needs, it is left out and `"missing"`
    names the pip install.
    """
    folder = options.folder if options.folder is not None else free_folder(Path(FOLDER))
    seen = False
    if page is None:
        report = session.run(options.run(options.seed, folder), panel)
    else:
        report, seen = _watched(options.run(options.seed, folder), panel, page)
    told = {**_summary(options, report), "folder": str(folder), "pictures": [], "missing": None, "report": report}
    if seen or report["exit"] == "failed" or not report["ticks"]:  # interrupted before it began: nothing to draw
        return told
    from sfms_robot.app.replay import replay_run  # scipy: not while servos move

    try:
        for plot, sheet in ((folder / PLOT, None), (None, folder / SHEET)):
            replay_run(folder, plot, sheet)
            told["pictures"].append(str(plot or sheet))
    except MissingExtra as error:
        told["missing"] = str(error)
    return told


def _watched(
    options: session.RunOptions, panel: session.Panel | None, page: PageProcess
) -> tuple[dict[str, Any], bool]:
    """Report of the last run behind a page, and whether anybody looked."""
    with page_session(page, options, choices=True) as pages:
        opened = open_browser(page.url)
        report = pages.run(panel)
        with suppress(KeyboardInterrupt):  # which ends the page; the head rests
            while pages.next(stay=report["exit"] == "done" or pages.released):
                report = pages.run(panel)
        return report, opened or page.visited.is_set()


def compare_seeds(options: DemoOptions, seeds: int, each: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Seeds 0 to `seeds` - 1 one after the other, nothing recorded; `each` hears of every one. Raises RobotError."""
    rows = []
    for seed in range(seeds):
        rows.append(_summary(options, session.run(options.run(seed, None))) | {"seed": seed})
        each(rows[-1])
        if rows[-1]["exit"] != "done":
            break
    return {
        "version": 1,
        "exit": rows[-1]["exit"],
        "exit_code": rows[-1]["exit_code"],
        "nods": nods_over_seeds([row["nods"] for row in rows]),
        "runs": rows,
    }


def nods_over_seeds(counts: Sequence[int]) -> dict[str, float | int | None]:
    """Mean, variance over mean (1 is Poisson's; None of one seed, or of no nod), and how many seeds have none."""
    mean = float(np.mean(counts))
    told = len(counts) > 1 and mean > 0
    scatter = round(float(np.var(counts, ddof=1)) / mean, 2) if told else None
    return {"mean": round(mean, 2), "variance_over_mean": scatter, "seeds_without": sum(one == 0 for one in counts)}


def free_folder(folder: Path) -> Path:
    """`folder`, or the first of folder-2, folder-3, ... that is not there yet."""
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in count(2))
    return next(each for each in chain([folder], numbered) if not each.exists())


def _summary(options: DemoOptions, report: dict[str, Any]) -> dict[str, Any]:
    """What a person in front of the head would have seen."""
    head = load_head(options.head)
    retargeter = HeadRetargeter(head)
    neck = [retargeter.joints[int(column)] for column in retargeter.neck_columns]
    travel_rad = sum(report["joints"][joint]["travel_rad"] for joint in neck if joint in report["joints"])
    return {
        "version": 1,
        "exit": report["exit"],
        "exit_code": report["exit_code"],
        "error": report.get("error"),
        "head": report["head"],
        "listener": report["listener"],
        "seed": options.seed,
        "duration_s": report["duration_s"],
        **report["motion"],
        "neck_travel_deg": round(float(np.degrees(travel_rad)), 1),
    }
