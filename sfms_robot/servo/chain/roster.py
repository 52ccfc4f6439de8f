"""Who is asked on every poll, and who only now and then: bookkeeping of silence, without a wire.

On a chain each servo waits for the answer of the one before it, so where answers stop, exactly one servo is suspect:
it leaves the list at once and is probed alone, with growing pauses. A single lost answer in the middle is forgiven
once. A wire on which nobody answers blames nobody until it has happened a few times, and then everybody: the supply
may be gone. When one of the silent comes back, the others are asked at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

QUIET_POLLS: Final = 3  # polls without any answer before servos are blamed rather than the wire
MISSES: Final = 2  # single lost answers in a row before a servo counts as silent
FIRST_PAUSE_S: Final = 0.05
LONGEST_PAUSE_S: Final = 1.0


@dataclass(slots=True)
class _Place:
    misses: int = 0
    silent: bool = False
    pause_s: float = 0.0
    probe_s: float = 0.0


class Roster:
    """Servos by id, in bus order.

    Attributes:
        quiet_polls: polls in a row in which nobody answered.
    """

    def __init__(self, servos: Sequence[int]) -> None:
        self.quiet_polls = 0
        self._places = {servo: _Place() for servo in servos}

    @property
    def listed(self) -> list[int]:
        return [servo for servo, place in self._places.items() if not place.silent]

    @property
    def silent(self) -> list[int]:
        return [servo for servo, place in self._places.items() if place.silent]

    def answered(self, servo: int) -> None:
        """It is on the list again, whatever was before."""
        place = self._places[servo]
        place.misses, place.silent = 0, False

    def blame(self, any_answer: bool, gaps: Sequence[int], missed: Sequence[int], now_s: float) -> list[int]:
        """End of a poll: `gaps` are where answers stopped, `missed` were passed over. Gives the newly silent."""
        self.quiet_polls = 0 if any_answer else self.quiet_polls + 1
        found = list(gaps) if any_answer else []
        if self.quiet_polls >= QUIET_POLLS:
            found = self.listed
        for servo in missed:
            self._places[servo].misses += 1
            if self._places[servo].misses >= MISSES:
                found.append(servo)
        for servo in found:
            place = self._places[servo]
            place.silent, place.pause_s, place.probe_s = True, FIRST_PAUSE_S, now_s + FIRST_PAUSE_S
        return found

    def suspect_all(self, now_s: float) -> None:
        """The wire was gone and is back: everybody is asked alone first, at once."""
        for place in self._places.values():
            place.silent, place.pause_s, place.probe_s = True, FIRST_PAUSE_S, now_s

    def hurry(self, now_s: float) -> None:
        """Somebody came back: ask the other silent ones now."""
        for place in self._places.values():
            if place.silent:
                place.pause_s, place.probe_s = FIRST_PAUSE_S, min(place.probe_s, now_s)

    def due(self, now_s: float) -> int | None:
        """The silent servo that has waited longest for a probe."""
        waiting = [servo for servo in self.silent if self._places[servo].probe_s <= now_s]
        return min(waiting, key=lambda servo: self._places[servo].probe_s, default=None)

    def probe_failed(self, servo: int, now_s: float) -> None:
        place = self._places[servo]
        place.pause_s = min(2.0 * place.pause_s, LONGEST_PAUSE_S)
        place.probe_s = now_s + place.pause_s
