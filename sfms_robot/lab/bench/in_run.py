"""A listener where it works: in its own process beside the servo loop of the default head, in real time.

Both tracks are heard, the robot's own voice too. What counts is that the loop is never late for the listener's sake,
and that no frame waits for the one before: a step has a frame's 40 ms.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run
from sfms_robot.lab.bench.measure import HEAD
from sfms_robot.listeners.process import threads
from sfms_robot.sources.registry import DEFAULT_SPEAKER

RUN_S: Final = 8.0
VOICE: Final = "katie"


def in_run(folder: Path, duration_s: float = RUN_S) -> dict[str, Any]:
    """Drive `measure.HEAD` on emulated servos for `duration_s` with the listener in `folder`.

    Returns ticks and how many of them were late, how fast frames were taken, and the ways from frame to wire [ms].
    """
    options = RunOptions(
        head=HEAD, listener=str(folder), audio=DEFAULT_SPEAKER, agent_audio=VOICE, duration_s=duration_s
    )
    report = run(options)
    step_ms = report["listener_step_ms"]
    return {
        "head": HEAD,
        "duration_s": report["duration_s"],
        "frames": report["frames"],
        "unheard_frames": report["listener_state"]["skipped_frames"],
        "frames_per_s": 1e3 / step_ms["p50"] if step_ms["p50"] else None,
        "step_ms": step_ms,
        "ticks": report["ticks"],
        "late_ticks": report["tick"]["late"],
        "achieved_hz": report["tick"]["achieved_hz"],
        "frame_to_wire_ms": report["latency_ms"]["frame_to_wire"],
        "threads": threads(),
    }
