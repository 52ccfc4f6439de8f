"""A clock that stands still unless it is told."""

from dataclasses import dataclass


@dataclass
class Time:
    t: float = 0.0

    def now_s(self) -> float:
        return self.t

    def wait_until(self, time_s: float) -> None:
        self.t = max(self.t, time_s)
