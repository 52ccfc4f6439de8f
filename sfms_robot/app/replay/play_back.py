"""Playback of a recorded run: by a head, or on a page where no head moves.

A head plays the recorded face, not the recorded joint angles, through its own retargeter and limits. So one recording
suits every head, and a joint cannot go where it must not, even with another calibration or another servo. Torque comes
on and goes off as in `sfms-robot run`; there is no listener, and nothing is added to the recording.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.app.head.pose import FaceTrack
from sfms_robot.app.listen.knobs import LiveKnobs
from sfms_robot.app.listen.page_observer import page_facts
from sfms_robot.app.listen.page_session import stay_for_visitors
from sfms_robot.app.listen.report import OUTCOME
from sfms_robot.app.options import SIM, HeadOptions, RunOptions
from sfms_robot.app.replay.run_file import RunRecording, read_recording, summary
from sfms_robot.app.session import Panel
from sfms_robot.config import load_head
from sfms_robot.data import Report
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_SAMPLES
from sfms_robot.signals.audio import energy_db
from sfms_robot.viewer.page_messages import NOTHING, pack_picture, rare_json
from sfms_robot.viewer.page_process import PageProcess

FAULTY: Final = "faulty"  # the name of every fault: a recording only has whether there was one


def recorded_face(recording: RunRecording) -> FaceTrack:
    """Return the face of a recording up to its way to rest, interpolated between ticks."""
    listened = recording.times_s <= recording.listened_s
    return FaceTrack(recording.times_s[listened], recording.motion[listened])


def play_back(
    folder: Path,
    panel: Panel | None = None,
    *,
    head: str | None = None,
    port: str = SIM,
    fast: bool = False,
    yes: bool = False,
) -> Report:
    """Drive a head for the length of a recording, which may have been cut off. Block until the end; return a report.

    `head` None: the recorded one, by its shipped name. Raises RobotError before torque came on; after that the head is
    at rest, and "error" says why.
    """
    recording = read_recording(folder)
    head = head or recording.about.get("head")
    if head is None:
        raise ConfigError(f"{folder}: the recording names no head: give it with --head NAME or DIR")
    options = HeadOptions(head=head, port=port, fast=fast, yes=yes)
    report = recorded_face(recording).play(options, panel, listener="recorded")
    return {
        **{key: report[key] for key in (*OUTCOME, "ticks", "motion", "joints")},
        "recorded_s": round(recording.listened_s, 3),
        "duration_s": round(report["duration_s"], 3),
        "whole": recording.whole,
        "limits": {"violations": report["limits"]["violations"]},
    }


# --- on a page --------------------------------------------------------------------------------------------------------


def show_recording(folder: Path, page: PageProcess) -> None:
    """Show the run in `folder` on a page whose process has begun. Blocks until it is shown.

    Raises ConfigError for a folder without a run, and if the recorded head is not available or has other joints now.
    """
    recording = read_recording(folder)
    about = recording.about
    head = load_head(about["head"], servos=False)
    if tuple(head.joints) != recording.joints:
        raise ConfigError(f"head {head.name!r} has other joints than when the run was recorded")
    options = RunOptions(port=about["port"], listener=about["listener"], seed=int(about["seed"]))
    facts = page_facts(head, options, LiveKnobs(head), about.get("audio"))
    page.say("begin", scene=about["head"], **facts | {"replay": True})
    for time_s, kind in recording.events:
        page.say("event", event=kind, at_s=round(time_s, 3))
    for record in pictures(recording):
        page.keep(record)
    page.say("end", report=summary(recording))


def wait_for_visitors(page: PageProcess) -> None:
    """Block until a visitor has come, and all have been away for some seconds. Ctrl-C ends it."""
    page.visited.wait()
    stay_for_visitors(page, threading.Event())


def pictures(recording: RunRecording) -> Iterator[bytes]:
    """Yield the frames of the page, packed: 25 a second."""
    times_s = np.arange(recording.times_s[0], recording.duration_s + 1e-9, 1.0 / FRAME_HZ)
    rows = np.minimum(np.searchsorted(recording.times_s, times_s - 1e-9), len(recording.times_s) - 1)
    talks = recording.talks_at(times_s)
    heard = np.searchsorted(recording.heard_s, times_s, side="right") - 1
    said = recording.agent_audio
    states = [(-np.inf, "starting", ()), *recording.states]
    for time_s, row, talking, frame in zip(times_s.tolist(), rows.tolist(), talks, heard.tolist(), strict=True):
        while len(states) > 1 and states[1][0] <= time_s:
            states.pop(0)
        faults = {recording.joints[joint]: FAULTY for joint in np.flatnonzero(recording.faults[row])}
        yield pack_picture(
            time_s,
            recording.motion[row],
            recording.goals_rad[row].astype(np.float64),
            recording.present_rad[row],
            rare_json(states[0][1], states[0][2], faults, None),
            voice_db=float(recording.energy_db[frame]) if 0 <= frame < len(recording.heard_s) else NOTHING,
            own_voice_db=NOTHING if said is None else energy_db(said[frame * FRAME_SAMPLES :][:FRAME_SAMPLES]),
            talking=bool(talking),
        )
