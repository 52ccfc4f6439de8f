"""The data that a page receives of its run: facts at the start, 25 pictures a second, events when decided, recordings.

The loop packs the numbers of a picture and passes them on; the page's process turns them into text. Work of a
millisecond, once a second, is done in a thread.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.app.catalogue import shipped_listeners, shipped_speakers
from sfms_robot.app.head.pose import expressions
from sfms_robot.app.listen.knobs import LiveKnobs
from sfms_robot.app.listen.report import event_row
from sfms_robot.app.options import RunOptions
from sfms_robot.config import Calmness, Head, load_listener
from sfms_robot.data import Report
from sfms_robot.frames import CHANNELS, FRAME_HZ, NO_SOUND, Floats, Plan, SpeakerFrame
from sfms_robot.listeners.events.model import load_tables
from sfms_robot.plugins import listener_folder
from sfms_robot.ports import Document, Observer, Tick
from sfms_robot.runtime.loop import AWAY_S
from sfms_robot.runtime.planned_events import PlannedEvents
from sfms_robot.runtime.recorder import RUN_FILE, Recorder
from sfms_robot.signals import voice_activity
from sfms_robot.signals.audio import energy_db
from sfms_robot.sources.registry import DEFAULT_SPEAKER
from sfms_robot.viewer.page_messages import NOTHING, VERSION, pack_picture, rare_json
from sfms_robot.viewer.page_process import PageProcess

TELL_S: Final = 1.0  # period of documents, and of searches for events in plans of a listener that decides none
LONGEST_S: Final = 300.0  # longest recording; the rest is left out
_WAITING: Final = 50  # plans that wait for the thread
_EPS_FRAMES: Final = 1e-6


def page_facts(
    head: Head,
    options: RunOptions,
    knobs: LiveKnobs,
    speaker: str | None,
    *,
    feeds: Collection[str] = (),
    choices: bool = False,
) -> Report:
    """Return the `hello` of docs/reference/protocol.md, except for the entries that differ between visitors.

    Args:
        speaker: name of the recorded person, or "default"; None: a live person.
        feeds: voice and face, if a visitor may provide them.
        choices: True if another listener, speaker or seed may be chosen.
    """
    calmness = options.calmness or Calmness()
    return {
        "version": VERSION,
        "head": head.name,
        "port": options.port,
        "listener": options.listener_name,
        "speaker": DEFAULT_SPEAKER if speaker == "default" else speaker,
        "seed": options.seed,
        "listeners": _lines(shipped_listeners()) if choices else [],
        "speakers": _lines(shipped_speakers()) if choices else [],
        "joints": [
            {
                "name": name,
                **{key: getattr(joint, key) for key in ("min_rad", "max_rad", "rest_rad", "bus", "id", "model")},
            }
            for name, joint in head.joints.items()
        ],
        "urdf_joints": list(head.joints),
        "urdf": None,
        "channels": list(CHANNELS),
        "regions": list(knobs),
        "expressions": expressions(),
        **knobs.values,
        "calmness": calmness.model_dump(exclude={"addressed"}),
        "people_per_minute": {},
        "human": "human/head.bin",
        "source": {name: name in feeds for name in ("voice", "face")},
        "replay": False,
    }


def people_per_minute(listener: str) -> dict[str, float]:
    """Return events a minute by kind, as learned from people, for rates of None; {} if no events are decided.

    A listener of another package or machine may decide events. Its learned rates are not known here, so it is treated
    as a shipped one. Raises ConfigError.
    """
    folder = listener_folder(listener)
    if folder is not None and not load_listener(folder / "config.yaml").events:
        return {}
    return {kind: hazard.per_minute for kind, hazard in load_tables().hazards.items()}


def _lines(rows: list[Report]) -> list[dict[str, str]]:
    return [{"name": row["name"], "line": row["description"]} for row in rows]


class PageObserver(Observer):
    """`ports.Observer` that shows a run on a page. The code that opened the page closes it.

    Args:
        joints: names, in the order of `Tick.goals_rad`.

    Attributes:
        document: returns the state of the run (`runtime.observers`); None: not known yet.
    """

    def __init__(self, page: PageProcess, joints: Sequence[str]) -> None:
        self.document: Document | None = None
        self._page, self._joints = page, tuple(joints)
        self._index = -1
        self._frame = SpeakerFrame(0.0, NO_SOUND)
        self._voice_db = self._own_db = NOTHING
        self._ear = voice_activity.start()
        self._hazards_hz: Mapping[str, float] = {}
        self._told_s = -math.inf
        self._rare: tuple[Any, bytes] = (None, b"")
        self._plans = deque[Plan](maxlen=_WAITING)
        self._events = PlannedEvents()  # used by the thread that sends

    def tick(self, seen: Tick) -> None:
        """Send a picture, 25 times a second, and once a second the state of the run."""
        index = math.floor(seen.time_s * FRAME_HZ + _EPS_FRAMES)
        if index == self._index:
            return
        self._index = index
        self._page.watch(seen.time_s)
        self._page.show(self._picture(seen))
        if seen.time_s - self._told_s >= TELL_S:
            self._told_s = seen.time_s
            self._page.later(self._tell)

    def heard(self, frame: SpeakerFrame) -> None:
        """Measure the levels of both voices."""
        self._frame = frame
        self._voice_db = energy_db(frame.audio) if len(frame.audio) else NOTHING
        if len(frame.audio):
            self._ear = voice_activity.step(self._voice_db, self._ear)
        self._own_db = NOTHING if frame.agent_audio is None else energy_db(frame.agent_audio)

    def planned(self, plan: Plan) -> None:
        """Keep the hazards, and have the events sent."""
        self._plans.append(plan)
        self._hazards_hz = plan.hazards_hz
        if plan.events:
            self._page.later(self._tell_events)

    def _picture(self, seen: Tick) -> bytes:
        frame = self._frame
        return pack_picture(
            seen.time_s, seen.motion, seen.goals_rad, self._read_rad(seen), self._rare_json(seen),
            voice_db=self._voice_db, own_voice_db=self._own_db, talking=self._ear.active,
            attention=frame.attention, place_m=frame.place_m,
        )  # fmt: skip

    def _tell(self) -> None:
        """Send events and the state of the run; takes some milliseconds."""
        self._tell_events()
        if self.document is not None and self._page.visitors:
            self._page.say("status", status=self.document())

    def _tell_events(self) -> None:
        while self._plans:
            self._events.join(self._plans.popleft())
        for event in self._events.news():
            evidence = {name: round(float(value), 3) for name, value in event.evidence.items()}
            self._page.say("event", **event_row(event), at_s=round(event.start_s, 3), evidence=evidence)

    def _read_rad(self, seen: Tick) -> Floats:
        """Return angles (J,), NaN without a recent one: platform legs read at other times fit no current pose."""
        read = (
            math.nan if each is None or each.position_rad is None or each.age_s > AWAY_S else each.position_rad
            for each in map(seen.readings.get, self._joints)
        )  # fmt: skip
        return np.fromiter(read, np.float32, len(self._joints))

    def _rare_json(self, seen: Tick) -> bytes:
        faults = {joint: reading.fault for joint, reading in seen.readings.items() if reading.fault}
        if seen.busy:
            faults["this computer"] = seen.busy
        key = (seen.state, seen.why, faults, self._hazards_hz)
        if key != self._rare[0]:
            self._rare = (key, rare_json(*key))
        return self._rare[1]


class PageRecorder(Observer):
    """`ports.Observer` that passes a run on to a `Recorder` while a visitor records. The page's thread calls `record`.

    Args:
        folder: folder of the recordings, each of which gets a folder in it.
        about: see `Recorder`.
    """

    def __init__(self, page: PageProcess, folder: Path, joints: Sequence[str], about: Mapping[str, str]) -> None:
        self._page, self._folder, self._joints, self._about = page, folder, tuple(joints), dict(about)
        self._recorder: Recorder | None = None
        self._into: Path | None = None
        self._began_s = self._now_s = 0.0
        self._tell(False, None)

    def record(self, on: bool) -> None:
        """Begin a recording, or end it and offer it for download; blocks until it is written. Raises ConfigError."""
        if on and self._recorder is None:
            into = self._folder / f"recording-{len(list(self._folder.iterdir())) + 1}"
            recorder = Recorder(into, self._joints, about=self._about)
            self._into, self._began_s, self._recorder = into, self._now_s, recorder
            self._tell(True, 0.0)
        elif not on:
            self.close()

    def tick(self, seen: Tick) -> None:
        """Record a tick."""
        self._now_s = seen.time_s
        if recorder := self._at(seen.time_s):
            recorder.tick(seen)

    def heard(self, frame: SpeakerFrame) -> None:
        """Record a frame."""
        if recorder := self._at(frame.time_s):
            recorder.heard(frame)

    def planned(self, plan: Plan) -> None:
        """Record a plan."""
        if recorder := self._at(plan.made_at_s):
            recorder.planned(plan)

    def close(self) -> None:
        """End the recording that is in progress."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.close()
            self._tell(False, min(LONGEST_S, math.ceil(self._now_s - self._began_s)))

    def _at(self, time_s: float) -> Recorder | None:
        return self._recorder if time_s - self._began_s <= LONGEST_S else None

    def _tell(self, on: bool, seconds: float | None) -> None:
        file = None if on or self._into is None else str(self._into / RUN_FILE)
        self._page.say("recorded", file=file, record={"on": on, "seconds": seconds})
