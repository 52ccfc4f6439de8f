"""What a server of streams has done, as values that add up: of one process, or of several that serve one listener."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Figures:
    """Of one `StreamServer`.

    Attributes:
        server, listener: names.
        hop: frames between plans; deadline_s: promised from a frame to its plan.
        heads: streams at this moment; most_heads: that could be answered in time, None where nobody asks.
        plans, misses, batches, steps, skipped, lost, refused, malformed: counts; `misses` are plans later than the
            deadline.
        delays_s, batch_sizes: of the last plans, and of the last batches.
        cost_scale: how much longer batches take than measured at the start; None where that was not measured.
        cpu_s: time of a core that its process has used.
    """

    server: str
    listener: str
    hop: int
    deadline_s: float
    heads: int
    most_heads: int | None
    plans: int
    misses: int
    batches: int
    steps: int
    skipped: int
    lost: int
    refused: int
    malformed: int
    delays_s: Sequence[float]
    batch_sizes: Sequence[int]
    cost_scale: float | None
    cpu_s: float


def report(parts: Sequence[Figures]) -> Mapping[str, Any]:
    """As `serve` tells them; `parts` are the processes of one server, one at least."""
    first = parts[0]

    def total(name: str) -> int:
        return sum(getattr(each, name) for each in parts)

    scales = [each.cost_scale for each in parts if each.cost_scale is not None]
    return {
        "server": first.server,
        "listener": first.listener,
        "hop": first.hop,
        "processes": len(parts),
        "heads": total("heads"),
        "most_heads": None if first.most_heads is None else total("most_heads"),
        "plans": total("plans"),
        "deadline_ms": first.deadline_s * 1e3,
        "deadline_misses": total("misses"),
        "delay_ms": _spread([delay_s * 1e3 for each in parts for delay_s in each.delays_s]),
        "batches": total("batches"),
        "batch_size": _spread([size for each in parts for size in each.batch_sizes]),
        "steps": total("steps"),
        "skipped_frames": total("skipped"),
        "lost_frames": total("lost"),
        "refused": total("refused"),
        "malformed": total("malformed"),
        "cost_scale": round(max(scales), 3) if scales else None,
        "cpu_s": round(sum(each.cpu_s for each in parts), 3),
    }


def _spread(values: Sequence[float]) -> dict[str, float | None]:
    if not values:
        return {"p50": None, "p99": None}
    p50, p99 = np.percentile(values, [50, 99]).round(3).tolist()
    return {"p50": p50, "p99": p99}
