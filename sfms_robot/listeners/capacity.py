"""Number of heads that one server can answer in time, from the measured cost of steps on this machine.

Frames that arrive while a batch is computed form the next batch. n heads send n / T frames a second, and every `hop`-th
of them needs a plan. So batches settle at a duration B in which as many frames arrive as a batch of that duration has:

    cost(n B / T) = B,   cost(m) = plan(m / hop) + other(m - m / hop)

A frame that comes just too late for one batch waits for that batch and for the next: 2 B, and a little more where
durations vary. This delay is compared with the deadline. Costs are measured at the start for some batch sizes and
interpolated linearly between them. While serving they are scaled by the real durations of batches.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfms_robot.frames import FRAME_S, SILENCE, Plan, SpeakerFrame
from sfms_robot.ports import Listener

SIZES: Final = (1, 2, 4, 8, 16, 32)
GPU_SIZES: Final = (*SIZES, 64, 128, 256)  # batch sizes on a GPU; measuring them also captures their graphs
ROUNDS: Final = 3  # measured plans at each size, after one that is not measured
UNEVEN: Final = 1.2  # measured delay of the slowest frame in a hundred, relative to 2 B
_STEPS: Final = 1 << 20  # resolution of the search for B


# --- Batches ----------------------------------------------------------------------------------------------------------


def step_each(
    listener: Listener, speakers: Sequence[SpeakerFrame], memories: Sequence[Any], *controls: Sequence[Any]
) -> list[tuple[Plan | None, Any]]:
    """Step each stream once, in one batch if the listener supports it (`engine.RunsOnEngine`).

    `controls`: one sequence of control rows, for a listener that accepts control.
    """
    together = getattr(listener, "step_each", None)
    if together is None:
        return [listener.step(*each) for each in zip(speakers, memories, *controls, strict=True)]
    found: list[tuple[Plan | None, Any]] = together(speakers, memories, *controls)
    return found


@dataclass(frozen=True, kw_only=True)
class Capacity:
    """Costs of batches on this machine.

    Attributes:
        hop: frames from one plan to the next.
        sizes: measured numbers of heads in a batch, in ascending order.
        plan_s, other_s: duration of a batch of each size in which all heads plan, or none of them.
        scale: duration of batches in service relative to the measured one.
    """

    hop: int
    sizes: tuple[int, ...]
    plan_s: tuple[float, ...]
    other_s: tuple[float, ...]
    scale: float = 1.0

    def batch_s(self, plans: float, others: float) -> float:
        """Return the duration of a batch of `plans` steps with a plan and `others` without."""
        return self.scale * (_between(self.sizes, self.plan_s, plans) + _between(self.sizes, self.other_s, others))

    def delay_s(self, heads: int, deadline_s: float) -> float:
        """Return the longest time from a frame to its plan; inf if the machine cannot keep up with so many heads."""
        if not heads:
            return 0.0
        longest_s = 2 * deadline_s

        def kept_up(step: int) -> bool:
            b_s = step / _STEPS * longest_s
            frames = max(1.0, heads * b_s / FRAME_S)
            return self.batch_s(frames / self.hop, frames - frames / self.hop) <= b_s

        step = 1 + bisect_left(range(1, _STEPS + 1), True, key=kept_up)
        return 2 * step / _STEPS * longest_s * UNEVEN if step <= _STEPS else math.inf

    def most(self, deadline_s: float) -> int:
        """Return the largest number of heads that are answered within the deadline."""
        return bisect_left(range(1, 10_001), True, key=lambda heads: self.delay_s(heads, deadline_s) > deadline_s)


def measure_capacity(
    listener: Listener, sizes: Sequence[int], now_s: Callable[[], float] = time.perf_counter
) -> Capacity:
    """Step batches of silence and return the medians of their durations. Blocks for a second or two."""
    plan_s: list[float] = []
    other_s: list[float] = []
    for size in sizes:
        memories = [listener.start(seed) for seed in range(size)]
        planned: list[float] = []
        others: list[float] = []
        for index in range((ROUNDS + 1) * listener.hop):
            began_s = now_s()
            answers = step_each(listener, [SpeakerFrame((index + 1) * FRAME_S, SILENCE)] * size, memories)
            taken_s = now_s() - began_s
            memories = [memory for _, memory in answers]
            (others if answers[0][0] is None else planned).append(taken_s)
        plan_s.append(float(np.median(planned[1:] or planned or others)))
        others = others[listener.hop - 1 :]
        other_s.append(float(np.median(others)) if others else 0.0)
    return Capacity(hop=listener.hop, sizes=tuple(sizes), plan_s=tuple(plan_s), other_s=tuple(other_s))


def _between(sizes: Sequence[int], costs_s: Sequence[float], count: float) -> float:
    """Return the cost of `count` steps: linear between 0 (no cost) and the sizes, extrapolated beyond the last one."""
    at, cost_s = (0, *sizes), (0.0, *costs_s)  # a count below 1: some batches have one such step, most have none
    slope = max(0.0, (cost_s[-1] - cost_s[-2]) / (at[-1] - at[-2]))
    return float(np.interp(count, at, cost_s)) + slope * max(0.0, count - at[-1])
