"""A listener stepped inline: for virtual time, where every run of one seed must be the same run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.ports import Listener

# Statistics of a feed whose steps have no duration and that leaves nothing out.
IDLE_FEED: Final[Mapping[str, Any]] = {
    "state": "listening", "restarts": 0, "skipped_frames": 0, "step_ms": {"p50": None, "p99": None},
}  # fmt: skip


class InlineFeed:
    """Steps the listener in `push`; its plan becomes visible a fixed `latency_s` later (ports.PlanFeed)."""

    lost = False

    def __init__(self, listener: Listener, seed: int, latency_s: float, engine: str | None = None) -> None:
        """`engine`: what computes it, in words, for the report."""
        self._listener, self._engine = listener, engine
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

    def statistics(self) -> Mapping[str, Any]:
        """See `ports.PlanFeed`; in virtual time a step has no duration."""
        return {**IDLE_FEED, "engine": self._engine, "hop": self._listener.hop}

    def close(self) -> None:
        """Nothing to give back."""
