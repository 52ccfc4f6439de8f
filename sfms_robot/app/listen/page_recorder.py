"""Recordings that a visitor of the page begins and ends while a run goes on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.ports import Tick
from sfms_robot.runtime.recorder import RUN_FILE, Recorder
from sfms_robot.viewer.page_process import PageProcess

LONGEST_S: Final = 300.0  # of one recording; what comes after it is left out


class PageRecorder:
    """`ports.Observer`: hands what happens to a `Recorder` while there is one. `record` is called in the page's thread.

    Args:
        folder: where recordings go, each into one of its own. about: see `Recorder`.
    """

    def __init__(self, page: PageProcess, folder: Path, joints: Sequence[str], about: Mapping[str, str]) -> None:
        self._page, self._folder, self._joints, self._about = page, folder, tuple(joints), dict(about)
        self._recorder: Recorder | None = None
        self._into: Path | None = None
        self._began_s = self._now_s = 0.0
        self._tell(False, None)

    def record(self, on: bool) -> None:
        """Begin one, or end it and let it be downloaded; blocks until it is written. Raises ConfigError."""
        if on and self._recorder is None:
            into = self._folder / f"recording-{len(list(self._folder.iterdir())) + 1}"
            recorder = Recorder(into, self._joints, about=self._about)
            self._into, self._began_s, self._recorder = into, self._now_s, recorder
            self._tell(True, 0.0)
        elif not on:
            self.close()

    def tick(self, seen: Tick) -> None:
        self._now_s = seen.time_s
        recorder = self._recorder
        if recorder is not None and seen.time_s - self._began_s <= LONGEST_S:
            recorder.tick(seen)

    def heard(self, frame: SpeakerFrame) -> None:
        recorder = self._recorder
        if recorder is not None and frame.time_s - self._began_s <= LONGEST_S:
            recorder.heard(frame)

    def planned(self, plan: Plan) -> None:
        recorder = self._recorder
        if recorder is not None and plan.made_at_s - self._began_s <= LONGEST_S:
            recorder.planned(plan)

    def close(self) -> None:
        """End the one that goes on."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.close()
            self._tell(False, min(LONGEST_S, math.ceil(self._now_s - self._began_s)))

    def _tell(self, on: bool, seconds: float | None) -> None:
        file = None if on or self._into is None else str(self._into / RUN_FILE)
        self._page.say("recorded", file=file, record={"on": on, "seconds": seconds})
