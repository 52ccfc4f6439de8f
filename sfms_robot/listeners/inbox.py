"""Frames on their way into a listener that may be slower than the person.

A machine that cannot keep up must not answer what was said seconds ago: when more than half a second is waiting, the
listener goes on at the newest frame. What it did not hear is counted.
"""

from __future__ import annotations

import queue
from collections import deque
from typing import Any, Final

from sfms_robot.config.listener import Calmness
from sfms_robot.frames import FRAME_HZ, SpeakerFrame
from sfms_robot.ports import Listener

MOST_WAITING: Final = FRAME_HZ // 2  # frames
CATCH_UP: Final = 0.5  # frames that must be waiting less after each, while it catches up: twice the person's pace


def calmed(listener: Listener, memory: Any, inbox: Inbox) -> Any:
    """The memory after what was asked for since the last frame; a listener that decides nothing takes no notice."""
    calmness, inbox.calmness = inbox.calmness, None
    change = getattr(listener, "calmed", None)
    return memory if calmness is None or change is None else change(memory, calmness)


class Inbox:
    """Frames in the order in which they came, until None does; the newest alone when too many are waiting.

    Those that came before the first one was asked for do not count as too many, as long as they become fewer at the
    pace of somebody who catches up.

    Attributes:
        skipped: frames left out before the last one given.
        calmness: asked for since `calmed` looked; None: none.
    """

    def __init__(self, most: int = MOST_WAITING) -> None:
        self._queue: queue.SimpleQueue[SpeakerFrame | None] = queue.SimpleQueue()
        self._most = most
        self._allowed: float | None = None  # to wait, while it catches up with those of before
        self._waiting: deque[SpeakerFrame | None] = deque()
        self.skipped = 0
        self.calmness: Calmness | None = None

    def put(self, frame: SpeakerFrame | None) -> None:
        self._queue.put(frame)

    def next(self) -> SpeakerFrame | None:
        """Blocks until there is one. None, the end, is neither left out nor waits for what came before it."""
        if not self._waiting:
            self._waiting.append(self._queue.get())
        while not self._queue.empty():
            self._waiting.append(self._queue.get())
        if None in self._waiting:
            return None
        waiting = len(self._waiting)
        self._allowed = waiting + self._most if self._allowed is None else self._allowed - CATCH_UP
        self.skipped = waiting - 1 if waiting > max(self._most, self._allowed) else 0
        for _ in range(self.skipped):
            self._waiting.popleft()
        return self._waiting.popleft()
