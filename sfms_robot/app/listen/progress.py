"""A bar while a head listens: time, and what the face is doing. An observer: it is told, the loop never waits."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from sfms_robot.frames import CHANNEL_INDEX, Plan, SpeakerFrame
from sfms_robot.ports import Tick

_EVERY_TICKS = 20  # five looks a second at 100 Hz
_SIGNS = (("blinks", "eyeBlinkLeft", 0.5), ("smiles", "mouthSmileLeft", 0.3), ("raises the brows", "browInnerUp", 0.3))


class RunProgress:
    """ports.Observer that moves a rich progress bar on stderr."""

    def __init__(self, duration_s: float | None) -> None:
        console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("listening"), BarColumn(), TextColumn("{task.completed:.0f} s  {task.description}"),
            console=console, transient=True, refresh_per_second=4, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("", total=duration_s)
        self._ticks = 0
        self._bar.start()

    def tick(self, seen: Tick) -> None:
        self._ticks += 1
        if self._ticks % _EVERY_TICKS == 0:
            doing = [name for name, channel, least in _SIGNS if seen.motion[CHANNEL_INDEX[channel]] > least]
            self._bar.update(self._task, completed=seen.time_s, description=", ".join(doing))

    def heard(self, frame: SpeakerFrame) -> None: ...

    def planned(self, plan: Plan) -> None: ...

    def close(self) -> None:
        self._bar.stop()
