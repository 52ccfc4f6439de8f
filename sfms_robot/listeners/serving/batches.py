"""Many streams stepped together, whatever the listener."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.ports import Listener


def step_each(
    listener: Listener, speakers: Sequence[SpeakerFrame], memories: Sequence[Any]
) -> list[tuple[Plan | None, Any]]:
    """One step of each stream; in one batch where the listener knows how (`ports.BatchListener`)."""
    together = getattr(listener, "step_each", None)
    if together is None:
        return [listener.step(speaker, memory) for speaker, memory in zip(speakers, memories, strict=True)]
    found: list[tuple[Plan | None, Any]] = together(speakers, memories)
    return found
