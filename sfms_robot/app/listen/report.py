"""The report of a run (`run --json`): every figure from the run's own log, the bus's counters or the listener."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfms_robot.ports import Bus, PlanFeed
from sfms_robot.runtime.log import RunLog, quantiles
from sfms_robot.signals.events import find_blinks, find_nods, find_smiles


def run_report(
    log: RunLog,
    bus: Bus,
    feed: PlanFeed,
    *,
    head: str,
    listener: str,
    port: str,
    seed: int,
    outcome: str,
    rate_hz: float,
    elapsed_s: float | None,
    priority: str,
) -> dict[str, Any]:
    """Version 1 of the report. `elapsed_s` None means virtual time: wall-clock figures are null."""
    real = elapsed_s is not None
    listened = np.asarray(log.pitch_rad), np.asarray(log.blink), np.asarray(log.smile)
    return {
        "version": 1,
        "head": head,
        "listener": listener,
        "port": port,
        "seed": seed,
        "duration_s": round(log.listened_s, 4),
        "exit": outcome,
        "frames": log.frames,
        "ticks": len(log.late_ms),
        "tick": log.tick_report(rate_hz, elapsed_s),
        "latency_ms": {
            "frame_to_wire": quantiles(log.frame_to_wire_ms if real else (), p50=50, p99=99),
            "speech_to_wire": quantiles(log.speech_to_wire_ms if real else (), p50=50, p95=95),
        },
        "listener_step_ms": quantiles(feed.step_times_ms(), p50=50, p99=99),
        "bus": dict(bus.statistics()),
        "limits": {"violations": log.audited.violations, "clamped": log.audited.clamped},
        "joints": log.joint_report(),
        "motion": {
            "nods": len(find_nods(listened[0], rate_hz)),
            "blinks": len(find_blinks(listened[1], rate_hz)),
            "smiles": len(find_smiles(listened[2], rate_hz)),
        },
        "plans": {"refused": log.refused_plans, "unheard_frames": feed.unheard()},
        "priority": priority,
    }
