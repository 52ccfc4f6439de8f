"""How a sound card's clock runs against the computer's.

The card counts samples; each callback tells when its newest sample came, by the computer's clock. A callback may come
late, never early. So in the plane of (samples, seconds) the truth is a line under all callbacks, as high as it goes:
the edge of their lower convex hull below the middle of them, which leaves the least lateness in all (Moon, Skelly and
Towsley, "Estimation and removal of clock skew from network delay measurements", 1999). One late callback, or many, lie
above it and change nothing.
"""

from __future__ import annotations

from collections import deque
from typing import Final

BIN_S: Final = 1.0  # the least late callback of every second is kept
BINS: Final = 64  # so the line follows a card that warms up within a minute
LEAST_SPAN_S: Final = 8.0  # of fewer seconds jitter would say more of the rate than the card does
LOST_S: Final = 0.02  # when the least late of a whole second is this late, samples were lost
LARGEST_SKEW: Final = 5e-3  # more is another rate than the one that was said

_Point = tuple[float, float]


class SampleClock:
    """Samples of one unbroken stream <-> seconds of `time.monotonic`. Counts begin at 0; not thread-safe.

    Args:
        rate_hz: nominal.
        skew: as far as it is known: seconds of the computer for one of the card, less one.
    """

    def __init__(self, rate_hz: float, skew: float = 0.0) -> None:
        self._nominal_hz = rate_hz
        self.skew = skew
        self._offset_s: float | None = None  # the line: offset + (1 + skew) x, with x = samples / nominal rate
        self._least: deque[_Point] = deque(maxlen=BINS)  # (x, seconds - x)
        self._bin: _Point | None = None
        self._bin_ends_s = BIN_S

    @property
    def rate_hz(self) -> float:
        """The card's true rate, by the computer's clock."""
        return self._nominal_hz / (1.0 + self.skew)

    @property
    def drift_ppm(self) -> float:
        """How much faster than it says the card is."""
        return (1.0 / (1.0 + self.skew) - 1.0) * 1e6

    def observe(self, count: int, captured_s: float) -> None:
        """A callback: `count` samples so far, the newest of them at `captured_s` or before."""
        x_s = count / self._nominal_hz
        point = (x_s, float(captured_s) - x_s)
        below_s = point[1] - self.skew * x_s
        self._offset_s = below_s if self._offset_s is None else min(self._offset_s, below_s)
        if self._bin is None or below_s < self._bin[1] - self.skew * self._bin[0]:
            self._bin = point
        if x_s >= self._bin_ends_s:
            self._least_of_bin(self._bin)
            self._bin, self._bin_ends_s = None, x_s + BIN_S

    def lateness_s(self, count: int, captured_s: float) -> float:
        """How late such a callback would be; below 0: earlier than the line thinks possible. 0 for the first."""
        return 0.0 if self._offset_s is None else captured_s - self.time_s(count)

    def time_s(self, count: float) -> float:
        """When so many samples had been captured. Raises ValueError before the first callback."""
        if self._offset_s is None:
            raise ValueError("no callback was observed")
        return self._offset_s + (1.0 + self.skew) * count / self._nominal_hz

    def count_at(self, time_s: float) -> float:
        """How many samples had been captured then."""
        return (time_s - self.time_s(0)) * self.rate_hz

    def _least_of_bin(self, point: _Point) -> None:
        if self.lateness_s(round(point[0] * self._nominal_hz), sum(point)) > LOST_S:
            self._least.clear()
        self._least.append(point)
        if len(self._least) == 1 or self._least[-1][0] - self._least[0][0] < LEAST_SPAN_S:
            self._offset_s = min(r - self.skew * x for x, r in self._least)
            return
        (x0, r0), (x1, r1) = _edge_below_the_middle(list(self._least))
        self.skew = min(max((r1 - r0) / (x1 - x0), -LARGEST_SKEW), LARGEST_SKEW)
        self._offset_s = min(r - self.skew * x for x, r in self._least)


def _edge_below_the_middle(points: list[_Point]) -> tuple[_Point, _Point]:
    """Of the lower convex hull of points that go from left to right, two or more."""
    hull: list[_Point] = []
    for point in points:
        while len(hull) > 1 and _turns_right(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    middle = sum(x for x, _ in points) / len(points)
    right = next((index for index in range(1, len(hull)) if hull[index][0] >= middle), len(hull) - 1)
    return hull[right - 1], hull[right]


def _turns_right(a: _Point, b: _Point, c: _Point) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])
