"""The report of a run (`run --json`): every figure from the run's own log, the bus's counters or the listener."""

from __future__ import annotations

from typing import Any

from sfms_robot.ports import Bus, PlanFeed
from sfms_robot.runtime.log import RunLog


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
    error: Exception | None,
    rate_hz: float,
    elapsed_s: float | None,
    priority: str,
) -> dict[str, Any]:
    """Version 1 of the report. `elapsed_s` None means virtual time: wall-clock figures are null."""
    real = elapsed_s is not None
    heard = dict(feed.statistics())
    timeline, limiter = (getattr(log.state, part, None) for part in ("timeline", "limiter"))
    plans = _counts(timeline, ("held", "eased", "late", "refused"))
    return {
        "version": 1,
        "head": head,
        "listener": listener,
        "port": port,
        "seed": seed,
        "duration_s": round(log.listened_s, 4),
        "exit": outcome,
        "error": None if error is None else str(error),
        "torque_unconfirmed": log.torque_unconfirmed,
        "frames": log.frames,
        "ticks": log.ticks,
        "tick": log.tick_report(rate_hz, elapsed_s),
        "latency_ms": _latency(log, real),
        "listener_step_ms": heard.pop("step_ms"),
        "hop": heard.pop("hop", None),
        "budget_ms": heard.pop("budget_ms", None),
        "listener_state": heard,
        "bus": dict(bus.statistics()),
        "limits": {
            "violations": log.audited.violations if log.audited else 0,
            "clamped": log.audited.clamped if log.audited else 0,
            **_counts(limiter, ("chased", "refused")),
        },
        "joints": log.joint_report(),
        "motion": log.motion_report(),
        "states": log.state_report(),
        "attention": log.attention_report(),
        "plans": {**plans, "refused": plans.get("refused", 0) + log.refused_plans},
        "observers_detached": dict(log.detached),
        "priority": priority,
    }


def figures_so_far(log: RunLog, rate_hz: float, *, real: bool) -> dict[str, Any]:
    """Those figures of the report that are known while it runs, under the report's names. From any thread.

    `real` False means virtual time.
    """
    return {
        "torque_unconfirmed": log.torque_unconfirmed,
        "frames": log.frames,
        "ticks": log.ticks,
        "tick": log.tick_report(rate_hz, log.listened_s + (1 + log.eased) * log.period_s if real else None),
        "latency_ms": _latency(log, real),
        "motion": log.motion_so_far(),
    }


def _latency(log: RunLog, real: bool) -> dict[str, Any]:
    return {
        "frame_to_wire": log.frame_to_wire_ms.report(p50=50, p99=99) if real else {"p50": None, "p99": None},
        "speech_to_wire": log.speech_to_wire_ms.report(p50=50, p95=95) if real else {"p50": None, "p95": None},
    }


def _counts(state: object, names: tuple[str, ...]) -> dict[str, int]:
    return {name: int(getattr(state, name)) for name in names if hasattr(state, name)}
