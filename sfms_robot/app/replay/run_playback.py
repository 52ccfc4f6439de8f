"""A recorded run on a head: the face that was asked for then, through retargeter and limits of the head at hand.

It is the face that is played and not the recorded joint angles, also on the same head: so one recording suits every
head, and neither another calibration nor another servo can take a joint where it must not go. Torque comes on and goes
off as in `sfms-robot run`; nobody listens, and nothing is added that was not recorded.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sfms_robot.app.head.pose import NobodyThere, WholeTimeline
from sfms_robot.app.listen.knobs import turned
from sfms_robot.app.listen.report import figures_so_far
from sfms_robot.app.open_head import HeadOptions, open_head
from sfms_robot.app.replay.run_file import RunRecording, read_recording
from sfms_robot.app.session import Panel, Programme, drive_head, run_log
from sfms_robot.app.wiring import SIM
from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles, Floats
from sfms_robot.runtime.halt import HaltLatch, halt_signals
from sfms_robot.runtime.observers import RunStatus
from sfms_robot.runtime.safety import Interrupt, signals_to


@dataclass(frozen=True)
class PlaybackOptions:
    """The flags of `sfms-robot replay --port`. `head` None: the one that was recorded, by its shipped name."""

    head: str | None = None
    port: str = SIM
    fast: bool = False
    yes: bool = False


class RecordedFace(WholeTimeline):
    """The timeline of a recording up to its way to rest: between two ticks the face is interpolated, before and
    after them it stays.
    """

    def __init__(self, recording: RunRecording) -> None:
        listened = recording.times_s <= recording.listened_s
        self._times_s, self._motion = recording.times_s[listened], recording.motion[listened]

    def sample(self, times_s: Doubles, now_s: float, state: None) -> tuple[Floats, None]:
        """Motion (N, 58) at each of (N,) instants."""
        if len(self._times_s) == 1:
            return np.repeat(self._motion, len(times_s), axis=0), None
        times_s = np.clip(times_s, self._times_s[0], self._times_s[-1])
        after = np.clip(np.searchsorted(self._times_s, times_s), 1, len(self._times_s) - 1)
        begins, ends = self._times_s[after - 1], self._times_s[after]
        share = ((times_s - begins) / (ends - begins))[:, None]
        return ((1 - share) * self._motion[after - 1] + share * self._motion[after]).astype(np.float32), None


def play_back(folder: Path, options: PlaybackOptions, panel: Panel | None = None) -> dict[str, Any]:
    """Drive a head as long as the recording goes, also one that was cut off. Blocks until then.

    Returns what it did. Raises RobotError before torque came on; after that the head is at rest, and "error" says why.
    """
    recording = read_recording(folder)
    head = options.head or recording.about.get("head")
    if head is None:
        raise ConfigError(f"{folder}: does not say which head it is of: --head NAME or DIR")
    interrupt, halt = Interrupt(), HaltLatch()
    servos = HeadOptions(head, options.port, options.fast, options.yes)
    with signals_to(interrupt), halt_signals(halt), open_head(servos) as opened:
        log, alone = run_log(opened), NobodyThere()
        facts = {"head": opened.config.name, "listener": "recorded", "duration_s": recording.listened_s}
        knobs = turned(opened.config)
        status = RunStatus(
            list(opened.config.joints),
            facts,
            lambda: {
                **figures_so_far(log, opened.rate_hz, real=not options.fast),
                "intensity": knobs.values["intensity"],
            },
        )
        programme = Programme(
            alone, alone, recording.listened_s, RecordedFace(recording), knobs=lambda: knobs.now, halt=halt,
            observers=[status],
        )  # fmt: skip
        with panel(status.document, interrupt, halt, knobs.turn_all) if panel is not None else nullcontext():
            drove = drive_head(opened, programme, interrupt, signals=False, log=log)
            status.ended(log.states[-1][1])
    return {
        "version": 1,
        "head": opened.config.name,
        "port": options.port,
        "recorded_s": round(recording.listened_s, 3),
        "duration_s": round(log.listened_s, 3),
        "whole": recording.whole,
        "exit": drove.outcome,
        "exit_code": drove.exit_code,
        "error": None if drove.error is None else str(drove.error),
        "torque_unconfirmed": log.torque_unconfirmed,
        "ticks": log.ticks,
        "limits": {"violations": log.audited.violations if log.audited else 0},
        "motion": log.motion_report(),
        "joints": log.joint_report(),
    }
