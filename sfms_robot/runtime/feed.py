"""A listener stepped inline: for virtual time, where every run of one seed must be the same run."""

from __future__ import annotations

from collections.abc import Sequence

from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.ports import Listener


class InlineFeed:
    """Steps the listener in `push`; its plan becomes visible a fixed `latency_s` later (ports.PlanFeed)."""

    def __init__(self, listener: Listener, seed: int, latency_s: float) -> None:
        self._listener = listener
        self._memory = listener.start(seed)
        self._latency_s = latency_s
        self._coming: list[tuple[float, Plan]] = []

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        plan, self._memory = self._listener.step(frame, self._memory)
        if plan is not None:
            self._coming.append((now_s + self._latency_s, plan))

    def poll(self, now_s: float) -> Sequence[Plan]:
        visible = [plan for at_s, plan in self._coming if at_s <= now_s]
        self._coming = self._coming[len(visible) :]
        return visible

    def step_times_ms(self) -> Sequence[float]:
        return ()

    def unheard(self) -> int:
        return 0

    def close(self) -> None:
        """Nothing to give back."""
