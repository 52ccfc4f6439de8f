"""`sfms-robot demo`: a bundled person talks, an emulated head listens, and two pictures show what it did."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.app import session
from sfms_robot.config import load_head
from sfms_robot.errors import MissingExtra
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.sources.speakers import DEFAULT_SPEAKER

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

    def run(self, seed: int, record: Path | None) -> session.RunOptions:
        """The person's voice alone: it is what any microphone gives."""
        return session.RunOptions(
            self.head, listener=self.listener, audio=DEFAULT_SPEAKER, face="none", duration_s=self.duration_s,
            fast=self.fast, seed=seed, record=record,
        )  # fmt: skip


def demo(options: DemoOptions, panel: session.Panel | None = None) -> dict[str, Any]:
    """Run once, record it, draw it. Blocks for the length of the run and some seconds. Raises RobotError.

    Where the pictures' packages are not installed the run is as good as any; `"missing"` names the pip install.
    """
    folder = options.folder if options.folder is not None else free_folder(Path(FOLDER))
    report = session.run(options.run(options.seed, folder), panel)
    told = {**_summary(options, report), "folder": str(folder), "pictures": [], "missing": None, "report": report}
    if report["exit"] == "failed" or not report["ticks"]:  # interrupted before it began: nothing to draw
        return told
    from sfms_robot.app.replay import replay_run  # scipy: not while servos move

    try:
        replay_run(folder, folder / PLOT, folder / SHEET)
        told["pictures"] = [str(folder / name) for name in (PLOT, SHEET)]
    except MissingExtra as error:
        told["missing"] = str(error)
    return told


def compare_seeds(options: DemoOptions, seeds: int, each: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Seeds 0 to `seeds` - 1 one after the other, nothing recorded; `each` hears of every one. Raises RobotError."""
    rows = []
    for seed in range(seeds):
        rows.append(_summary(options, session.run(options.run(seed, None))) | {"seed": seed})
        each(rows[-1])
        if rows[-1]["exit"] != "done":
            break
    return {"version": 1, "exit": rows[-1]["exit"], "exit_code": rows[-1]["exit_code"], "runs": rows}


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
