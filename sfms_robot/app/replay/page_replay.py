"""A recorded run on a page, to be played there: no head moves."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.app.listen.knobs import turned
from sfms_robot.app.listen.page_observer import page_facts
from sfms_robot.app.replay.run_file import RunRecording, read_recording, summary
from sfms_robot.config import Calmness, load_head
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_SAMPLES
from sfms_robot.signals.audio import energy_db
from sfms_robot.sources.registry import DEFAULT_SPEAKER
from sfms_robot.viewer.page_messages import NOTHING, pack_picture, rare_json
from sfms_robot.viewer.page_process import PageProcess

LEFT_S: Final = 5.0  # nobody has looked for so long
_LOOK_S: Final = 0.5
FAULTY: Final = "faulty"  # what a recording tells of a fault here


def show_recording(folder: Path, page: PageProcess) -> None:
    """Put the run in `folder` on a page whose process has begun. Blocks until it is there.

    Raises ConfigError for a folder without one, and where the recorded head is not at hand or has other joints now.
    """
    recording = read_recording(folder)
    page.say("begin", scene=recording.about["head"], **_facts(recording))
    for time_s, kind in recording.events:
        page.say("event", event=kind, at_s=round(time_s, 3))
    for record in pictures(recording):
        page.keep(record)
    page.say("end", report=summary(recording))


def wait_for_visitors(page: PageProcess) -> None:
    """Block until somebody has looked, and nobody has for `LEFT_S`. Ctrl-C ends it."""
    alone_s, pause = 0.0, threading.Event()
    page.visited.wait()
    while alone_s < LEFT_S:
        pause.wait(_LOOK_S)
        alone_s = 0.0 if page.visitors else alone_s + _LOOK_S


def pictures(recording: RunRecording) -> Iterator[bytes]:
    """What the page would have been told, packed: 25 a second."""
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
            time_s, recording.motion[row], recording.goals_rad[row].astype(np.float64), recording.present_rad[row],
            rare_json(states[0][1], states[0][2], faults, None),
            voice_db=float(recording.energy_db[frame]) if 0 <= frame < len(recording.heard_s) else NOTHING,
            own_voice_db=NOTHING if said is None else energy_db(said[frame * FRAME_SAMPLES :][:FRAME_SAMPLES]),
            talking=bool(talking),
        )  # fmt: skip


def _facts(recording: RunRecording) -> dict[str, Any]:
    about = recording.about
    head = load_head(about["head"])
    if tuple(head.joints) != recording.joints:
        raise ConfigError(f"head {head.name!r} has other joints than when the run was recorded")
    speaker = about.get("audio")
    facts = page_facts(
        head, port=about["port"], listener=about["listener"], seed=int(about["seed"]),
        speaker=DEFAULT_SPEAKER if speaker == "default" else speaker,
        calmness=Calmness(), people={}, knobs=turned(head), source={"voice": False, "face": False}, choices=False,
    )  # fmt: skip
    return facts | {"replay": True}
