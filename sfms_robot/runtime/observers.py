"""Those who look on. One that raises is detached and named once: looking on never ends a run."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.ports import Observer, Tick

log = logging.getLogger(__name__)


class Observers:
    """Hands what happens to every `ports.Observer`, in order.

    Attributes:
        detached: name of each that raised, and what.
    """

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._attached = list(observers)
        self.detached: dict[str, str] = {}

    def tick(self, seen: Tick) -> None:
        self._each(lambda observer: observer.tick(seen))

    def heard(self, frame: SpeakerFrame) -> None:
        self._each(lambda observer: observer.heard(frame))

    def planned(self, plan: Plan) -> None:
        self._each(lambda observer: observer.planned(plan))

    def _each(self, tell: Callable[[Observer], None]) -> None:
        for observer in tuple(self._attached):
            try:
                tell(observer)
            except Exception as error:
                self._attached.remove(observer)
                name = type(observer).__name__
                self.detached[name] = f"{type(error).__name__}: {error}"
                log.warning("%s raised and is detached: %s", name, self.detached[name], exc_info=True)
