"""`sfms-robot demo`: a bundled person talks, an emulated head listens, and a page or two pictures show the run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.app import session
from sfms_robot.app.listen.page_session import page_session
from sfms_robot.app.options import RunOptions, open_browser
from sfms_robot.config import load_head
from sfms_robot.data import Report, speaker_names
from sfms_robot.errors import MissingExtra
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.sources.registry import DEFAULT_SPEAKER
from sfms_robot.viewer.page_process import PageProcess

FOLDER: Final = Path("runs", "demo")
FACE: Final = "none"  # face of the person, of whom there is only the voice, as with a microphone
PLOT, SHEET = "run.png", "head.png"
_KEPT: Final = ("version", "exit", "exit_code", "error", "head", "listener", "seed", "duration_s")


def demo(
    options: RunOptions, folder: Path | None, panel: session.Panel | None = None, page: PageProcess | None = None
) -> Report:
    """Run once, record it, show it on a page or draw it. Raises RobotError.

    Blocks for the length of the run and some seconds. With a page it blocks until the last visitor leaves, while one
    bundled person talks after another. Further runs are not recorded. A picture whose packages are not installed is
    left out, and `"missing"` has the pip command. `folder` None: a new one, `FOLDER` or the next free number.
    """
    folder = folder or free_folder(FOLDER)
    options = replace(options, audio=DEFAULT_SPEAKER, face=FACE, record=folder)
    seen = False
    if page is None:
        report = session.run(options, panel)
    else:
        with page_session(page, options, choices=True) as pages:
            open_browser(page.url)
            report = pages.run(panel)
            with suppress(KeyboardInterrupt):  # Ctrl-C ends the page; the head is at rest
                while pages.next(
                    stay=report["exit"] == "done" or pages.released,
                    speaker=next_speaker(pages.options.audio) if report["exit"] == "done" else None,
                ):
                    report = pages.run(panel)
            seen = page.visited.is_set()
    pictures: list[str] = []
    shown = {
        **_summary(options, report),
        "folder": str(folder),
        "pictures": pictures,
        "missing": None,
        "report": report,
    }
    if seen or report["exit"] == "failed" or not report["ticks"]:  # interrupted before it began: nothing to draw
        return shown
    from sfms_robot.app.replay.pictures import replay_run  # imports scipy: not while servos move

    try:
        for plot, sheet in ((folder / PLOT, None), (None, folder / SHEET)):
            replay_run(folder, plot, sheet)
            pictures.append(str(plot or sheet))
    except MissingExtra as error:
        shown["missing"] = str(error)
    return shown


def next_speaker(speaker: str) -> str:
    """Return the bundled person after `speaker`, in turn."""
    names = speaker_names()
    return names[(names.index(speaker) + 1) % len(names) if speaker in names else 0]


def compare_seeds(options: RunOptions, seeds: int, each: Callable[[Report], None]) -> Report:
    """Run seeds 0 to `seeds` - 1 in turn, without recording; call `each` with each summary. Raises RobotError."""
    rows = []
    for seed in range(seeds):
        seeded = replace(options, audio=DEFAULT_SPEAKER, face=FACE, seed=seed)
        rows.append(_summary(seeded, session.run(seeded)))
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
    """Return mean, variance over mean (1: Poisson; None for one seed or no nod), and number of seeds without a nod."""
    mean = float(np.mean(counts))
    scatter = round(float(np.var(counts, ddof=1)) / mean, 2) if len(counts) > 1 and mean > 0 else None
    return {"mean": round(mean, 2), "variance_over_mean": scatter, "seeds_without": sum(one == 0 for one in counts)}


def free_folder(folder: Path) -> Path:
    """Return `folder`, or the first of folder-2, folder-3, ... that does not exist yet."""
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in count(2))
    return next(each for each in chain([folder], numbered) if not each.exists())


def _summary(options: RunOptions, report: Report) -> Report:
    """Return what a person in front of the head would have seen."""
    retargeter = HeadRetargeter(load_head(options.head, servos=False))
    neck = [retargeter.joints[int(column)] for column in retargeter.neck_columns]
    travel_rad = sum(report["joints"][joint]["travel_rad"] for joint in neck if joint in report["joints"])
    return {
        **{key: report[key] for key in _KEPT},
        **report["motion"],
        "neck_travel_deg": round(float(np.degrees(travel_rad)), 1),
    }
