"""What a run keeps: resident memory of the servo process, hour after hour of virtual time, with a recording.

Nobody listens: a made-up face is played, so that it is the loop, the bus, the log and the recorder that are looked at.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run
from sfms_robot.errors import BusError
from sfms_robot.lab.bench.lead import Waves
from sfms_robot.lab.bench.measure import Row, row
from sfms_robot.ports import Observer, Tick

HEAD: Final = "interbotix_wxxms"  # two servos: hours pass quickly
HOURS: Final = 4.0
_HOUR_S: Final = 3600.0
_LOOKS: Final = 20  # an hour


class ResidentMemory(Observer):
    """An observer that looks at the memory of its own process every so often."""

    def __init__(self, every_s: float = _HOUR_S / _LOOKS) -> None:
        self._every_s = every_s
        self.times_s: list[float] = []
        self.resident_mb: list[float] = []
        self._page_mb = os.sysconf("SC_PAGE_SIZE") / 2**20

    def tick(self, seen: Tick) -> None:
        if seen.time_s >= len(self.times_s) * self._every_s:
            pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
            self.times_s.append(seen.time_s)
            self.resident_mb.append(pages * self._page_mb)


def memory(hours: float = HOURS, head: str = HEAD) -> dict[str, Row]:
    """Growth after the first hour in MB, beside what was resident then; Linux only. `head`: a name or a folder.

    Raises BusError when the run does not come to its end.
    """
    looks = ResidentMemory()
    with TemporaryDirectory() as folder:
        options = RunOptions(head=head, fast=True, audio="none", duration_s=hours * _HOUR_S, record=Path(folder))
        report = run(options, feed=Waves(), observers=[looks], signals=False)
    if report["exit"] != "done":
        raise BusError(f"bench memory: the run ended early ({report['exit']}: {report['error']})")
    settled = _between(looks, min(1.0, hours / 2) * _HOUR_S, float("inf"))
    return {"memory.growth": row([settled[-1] - settled[0]], [settled[0]], "MB", "resident after the first hour")}


def _between(looks: ResidentMemory, first_s: float, last_s: float) -> Sequence[float]:
    return [mb for at_s, mb in zip(looks.times_s, looks.resident_mb, strict=True) if first_s <= at_s <= last_s]
