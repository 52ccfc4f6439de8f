"""The report of a run (`run --json`), the facts in its recording, and its messages to other programs.

Every figure of the report is from the run's own log, the bus's counters or the listener.
"""

from __future__ import annotations

import hashlib
import json
import platform
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import yaml

from sfms_robot import __version__
from sfms_robot.app.options import RunOptions
from sfms_robot.config import Head, load_listener
from sfms_robot.data import Names, Report
from sfms_robot.errors import INTERRUPTED, BusError, ConfigError, ModelError, PortError, RobotError
from sfms_robot.frames import ListenerEvent, SpeakerFrame
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.plugins import listener_folder
from sfms_robot.ports import Document, Outlet, PlanFeed, Source, Tick
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.planned_events import EventWatch
from sfms_robot.signals.quantiles import Quantiles

if TYPE_CHECKING:
    from sfms_robot.app.listen.knobs import LiveKnobs
    from sfms_robot.app.open_head import OpenHead
    from sfms_robot.outputs.sender import Outputs

LONG: Final = ("joints", "head_yaml", "listener_config", "options")  # facts that are too long for one line
# The head, its port and how the drive ended: keys of every report.
OUTCOME: Final = ("version", "head", "port", "exit", "exit_code", "error", "torque_unconfirmed")
_KINDS: Final = {kind.exit_code: kind for kind in (ConfigError, PortError, BusError, ModelError)}


def run_report(
    opened: OpenHead, log: RunLog, feed: PlanFeed, outcome: str, elapsed_s: float | None, error: Exception | None
) -> Report:
    """Return version 1 of the report of a drive without a listener; a run adds its own entries.

    Args:
        outcome: "done", "interrupted", or "failed" together with an `error`.
        elapsed_s: duration of the drive; None in virtual time, where wall-clock figures are null.
    """
    code = 0 if error is None else getattr(error, "exit_code", 1)  # exit code of the process, see `errors`
    heard = dict(feed.statistics())
    timeline, limiter = (getattr(log.state, part, None) for part in ("timeline", "limiter"))
    plans = _counts(timeline, ("held", "eased", "late", "refused"))
    return {
        "version": 1,
        "head": opened.config.name,
        "port": opened.options.port,
        "exit": outcome,
        "exit_code": INTERRUPTED if outcome == "interrupted" else code,
        "error": None if error is None else str(error),
        "listener": "none",
        "seed": 0,
        "duration_s": round(log.listened_s, 4),
        **_loop_figures(opened, log, elapsed_s),
        "listener_step_ms": heard.pop("step_ms"),
        "hop": heard.pop("hop", None),
        "budget_ms": heard.pop("budget_ms", None),
        "listener_state": heard,
        "bus": dict(opened.bus.statistics()),
        "limits": {
            "violations": log.audited.violations if log.audited else 0,
            "clamped": log.audited.clamped if log.audited else 0,
            **_counts(limiter, ("chased", "refused")),
        },
        "joints": log.joint_report(),
        "motion": {f"{name}s": counter.total() for name, counter in log.counters.items()},
        "states": {
            "seconds": {name: round(seconds, 3) for name, seconds in log.state_s.items()},
            "changes": [
                {"time_s": round(at_s, 3), "state": state.name, "why": list(state.why)} for at_s, state in log.states
            ],
        },
        "attention": log.attention_report(),
        "plans": {**plans, "refused": plans.get("refused", 0) + log.refused_plans},
        "observers_detached": dict(log.detached),
    }


def failure(report: Report) -> RobotError | None:
    """Return the error that ended a run, from its report; None if no error ended it."""
    if report["exit"] != "failed":
        return None
    return _KINDS.get(report["exit_code"], RobotError)(report["error"])


def figures_so_far(
    opened: OpenHead,
    log: RunLog,
    person: Source,
    feed: PlanFeed,
    live: LiveKnobs,
    outputs: Outputs,
    more: Document,
) -> Report:
    """Return the figures of the report that are known during the run, by the report's names. From any thread."""
    passed_s = log.listened_s + (1 + log.eased) * log.period_s
    return {
        **_loop_figures(opened, log, None if opened.options.fast else passed_s),
        "motion": {f"{name}s": counter.so_far for name, counter in log.counters.items()},
        "source": dict(person.statistics()),
        "listener_state": dict(feed.statistics()),
        "intensity": live.values["intensity"],
        "outputs": outputs.statistics(),
        **more(),
    }


def _loop_figures(opened: OpenHead, log: RunLog, elapsed_s: float | None) -> Report:
    """Return the figures of the loop; wall-clock figures are null in virtual time (`elapsed_s` None)."""
    measured = log.late_ms, log.frame_to_wire_ms, log.speech_to_wire_ms
    late_ms, frame_ms, speech_ms = [Quantiles()] * 3 if elapsed_s is None else measured
    return {
        "torque_unconfirmed": log.torque_unconfirmed,
        "frames": log.frames,
        "ticks": log.ticks,
        "tick": {
            "target_hz": opened.rate_hz,
            "achieved_hz": round(log.ticks / elapsed_s, 2) if elapsed_s else None,
            "late": None if elapsed_s is None else log.late,
            "jitter_ms": late_ms.report(p50=50, p99=99, max=100),
        },
        "latency_ms": {
            "frame_to_wire": frame_ms.report(p50=50, p99=99),
            "speech_to_wire": speech_ms.report(p50=50, p95=95),
        },
    }


def _counts(state: object, names: Names) -> dict[str, int]:
    return {name: int(getattr(state, name)) for name in names if hasattr(state, name)}


# --- the facts in a recording ---------------------------------------------------------------------------------------


def run_facts(head: Head, options: RunOptions) -> dict[str, str]:
    """Return the facts that a recording keeps of its run, text by text, for `Recorder(about=...)`.

    `head_yaml` is the head as it was used, calibration included, in the form of a head's file. For a listener that is
    a folder, the facts include its configuration and the SHA-256 of its weights.
    """
    calmness = options.calmness and options.calmness.model_dump(exclude_none=True)
    values = {**asdict(options), "audio": options.hears, "calmness": calmness}
    given = {name: value for name, value in values.items() if value not in (None, (), False)}
    return {
        "head": head.name,
        "listener": options.listener_name,
        "seed": str(options.seed),
        "port": options.port,
        "audio": Path(options.hears).name,
        "version": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "options": json.dumps(given, default=str),
        "head_yaml": yaml.safe_dump(head.model_dump(mode="json", exclude_defaults=True), sort_keys=False),
        **_listener_facts(options.listener),
    }


def _listener_facts(name: str) -> dict[str, str]:
    try:
        folder = listener_folder(name)
    except ConfigError:  # the listener is an object of the calling program
        folder = None
    if folder is None:
        return {}
    facts = {"listener_config": (folder / "config.yaml").read_text(encoding="utf-8")}
    if (weights := folder / "model.safetensors").is_file():
        with weights.open("rb") as file:
            facts["listener_sha256"] = hashlib.file_digest(file, "sha256").hexdigest()
    return facts


def limitation(listener: str) -> str | None:
    """Return the channels that a listener, by name or folder, shows on no head, as one line; None if there are none.

    Also None for a listener of another package. Raises ConfigError.
    """
    folder = listener_folder(listener)
    return None if folder is None else MotionSpace.of(load_listener(folder / "config.yaml"), folder).limitation


# --- messages to the programs that a run works with -----------------------------------------------------------------


class OutletObserver(EventWatch):
    """An observer that sends sound, planned events and changes of state to one outlet of a source."""

    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet
        self._state: tuple[str, Names] | None = None
        super().__init__(self._event)

    def tick(self, seen: Tick) -> None:
        state = (seen.state, seen.why)
        if state != self._state:
            self._state = state
            self._outlet.tells("state", seen.time_s, state=seen.state, why=list(seen.why))

    def heard(self, frame: SpeakerFrame) -> None:
        if len(frame.audio):
            self._outlet.hears(frame.audio, frame.time_s)

    def _event(self, event: ListenerEvent) -> None:
        sent = {key: value for key, value in event_row(event).items() if value is not None}
        self._outlet.tells("event", event.start_s, **sent)


def event_row(event: ListenerEvent) -> Report:
    """Return an event in the form that is sent to programs and pages, except for its time."""
    return {
        "event": event.kind,
        "lasts_s": round(event.duration_s, 3),
        "size": round(event.size, 4),
        "swings": event.swings,
        "probability": None if event.probability is None else round(event.probability, 5),
    }
