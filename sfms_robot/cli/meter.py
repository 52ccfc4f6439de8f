"""A level meter on one line of the terminal, while a microphone is checked."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

_QUIETEST_DB: Final = -60.0
_WIDTH: Final = 40
_LOUD_DB: Final = -12.0
_FALLS_DB_S: Final = 20.0  # of the mark at the loudest level, as meters do


class LevelMeter:
    """On stderr, and gone afterwards; nothing is shown where that is no terminal."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._loudest_db, self._since_s = _QUIETEST_DB, 0.0
        self._clipped = False

    def __enter__(self) -> LevelMeter:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def __call__(self, level_db: float, clips: bool) -> None:
        now_s = time.monotonic()
        self._loudest_db = max(level_db, self._loudest_db - _FALLS_DB_S * (now_s - self._since_s))
        self._since_s = now_s
        self._clipped |= clips
        if self._live.is_started:
            self._live.update(meter_line(level_db, self._loudest_db, self._clipped), refresh=True)


def meter_line(level_db: float, loudest_db: float, clipped: bool) -> Text:
    """A bar from -60 to 0 dB of full scale, a mark at the loudest, and whether anything has clipped."""
    full, mark = _cells(level_db), max(_cells(loudest_db) - 1, 0)
    cells = ["█" if cell < full else " " for cell in range(_WIDTH)]
    cells[mark] = "│" if mark >= full else cells[mark]
    colour = "red" if clipped else "yellow" if level_db > _LOUD_DB else "green"
    return Text.assemble(("".join(cells), colour), f" {level_db:6.1f} dBFS", (" clips" if clipped else "", "bold red"))


def _cells(level_db: float) -> int:
    return round(_WIDTH * min(max(1.0 - level_db / _QUIETEST_DB, 0.0), 1.0))
