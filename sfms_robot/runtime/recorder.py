"""Recording of a run: an observer that writes DIR/run.mcap, which `replay` and Foxglove open.

The loop only puts values into a bounded queue; a separate thread encodes and writes them. When the queue is full, a
value is dropped and counted, and the loop does not wait. It waits in virtual time only, where waiting costs nothing and
the file must be complete. Chunks are small, so that the file of a killed run can be read up to its last second. A run
of hours continues in DIR/run-0002.mcap and so on. Each is a complete file, because an index of all chunks would grow
with the run.

Topics: /speaker (25 Hz: sound, level, face, attention, place, and the robot's own voice), /plan (per plan), /event
(decisions with their evidence; of a listener without events, nods, blinks and smiles found in its plans), /face (per
tick: the 58 requested channels), /joints (per tick and joint: goal, present, age, fault), /servos (once a second: other
values of the servos), /state (when it changes).

In the format "ros2" each message is a std_msgs/String with the same JSON under /sfms_robot, and `_as_ros2` adds topics
of ROS's own types, all as CDR. Times are those of the run, from 0.
"""

from __future__ import annotations

import base64
import json
import logging
import math
import queue
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import orjson
from mcap.writer import Writer

from sfms_robot.data import Names, Report, write_whole
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, CHANNELS, Floats, Plan, SpeakerFrame
from sfms_robot.ports import Facts, Observer, Tick
from sfms_robot.processes import start_thread
from sfms_robot.runtime.planned_events import PlannedEvents
from sfms_robot.signals.audio import energy_db

RUN_FILE: Final = "run.mcap"
REPORT_FILE: Final = "report.json"
RecordFormat = Literal["json", "ros2"]
Message = tuple[str, float, Report]

_QUEUE_LENGTH: Final = 2000  # ten seconds of a 100 Hz loop
_CHUNK_BYTES: Final = 64 * 1024  # small: stalls are short, and little is lost when a run is killed
PART_MESSAGES: Final = 100_000  # about seven minutes of a 100 Hz loop
SERVOS_S: Final = 1.0
EVENTS_S: Final = 1.0
_DIGITS: Final = 5
_log = logging.getLogger(__name__)

_NUMBER: Final = {"type": "number"}
_NUMBER_OR_NULL: Final = {"type": ["number", "null"]}
_NUMBERS: Final = {"type": "array", "items": _NUMBER}
_NUMBERS_OR_NULL: Final = {"type": ["array", "null"], "items": _NUMBER}
_PCM16: Final = {"type": "string", "contentEncoding": "base64"}
_CHANNELS: Final[Facts] = dict.fromkeys(CHANNELS, _NUMBER_OR_NULL)
_JOINT: Final = {
    "type": "object",
    "properties": {
        "goal_rad": _NUMBER,
        "present_rad": _NUMBER_OR_NULL,
        "age_s": _NUMBER_OR_NULL,
        "fault": {"type": ["string", "null"]},
    },
}
_SCHEMAS: Final[Mapping[str, Facts]] = {
    "/speaker": {
        "time_s": _NUMBER,
        "audio_pcm16": _PCM16,
        "agent_audio_pcm16": {**_PCM16, "type": ["string", "null"]},
        "audio_hz": _NUMBER,
        "energy_db": _NUMBER,
        "face": {"type": ["object", "null"], "properties": _CHANNELS},
        "jaw_rad": _NUMBERS_OR_NULL,
        "attention": _NUMBER_OR_NULL,
        "place_m": _NUMBERS_OR_NULL,
    },
    "/plan": {
        "made_at_s": _NUMBER,
        "times_s": _NUMBERS,
        "frames": {"type": "array", "items": _NUMBERS},
        "jaw_rad": {"type": ["array", "null"], "items": _NUMBERS},
        "hazards_hz": {"type": "object", "additionalProperties": _NUMBER},
    },
    "/event": {
        "kind": {"type": "string"},
        "start_s": _NUMBER,
        "duration_s": _NUMBER,
        "size": _NUMBER,
        "swings": _NUMBER,
        "target_rad": _NUMBERS_OR_NULL,
        "probability": _NUMBER_OR_NULL,
        "draw": _NUMBER_OR_NULL,
        "evidence": {"type": "object", "additionalProperties": _NUMBER},
    },
    "/face": {"time_s": _NUMBER, **_CHANNELS},
    "/joints": {"time_s": _NUMBER, "joints": {"type": "object", "additionalProperties": _JOINT}},
    "/servos": {"time_s": _NUMBER, "servos": {"type": "object"}},
    "/state": {"time_s": _NUMBER, "state": {"type": "string"}, "why": {"type": "array", "items": {"type": "string"}}},
}


ROS2_TOPICS: Final = {topic: f"/sfms_robot{topic}" for topic in _SCHEMAS} | {"/event": "/sfms_robot/events"}


class Recorder(Observer):
    """Observer that writes a run to a folder.

    joints: names, in the order of `Tick.goals_rad`. wait: whether to wait for room in the queue (virtual time).
    about: further texts to keep in the file. Raises ConfigError when the folder cannot be written to.
    """

    def __init__(
        self,
        folder: Path,
        joints: Sequence[str],
        about: Mapping[str, str] | None = None,
        *,
        wait: bool = False,
        queue_length: int = _QUEUE_LENGTH,
        record_format: RecordFormat = "json",
    ) -> None:
        self._joints = tuple(joints)
        self._format = record_format
        self._wait = wait
        self._queue = queue.Queue[Tick | SpeakerFrame | Plan | None](queue_length)
        self._dropped = 0
        self._written = 0
        self._trouble: str | None = None
        self._closed = False
        self._folder = folder
        self._about = {
            **(about or {}),
            "joints": json.dumps(self._joints),
            "started_utc": datetime.now(UTC).isoformat(),
        }
        self._parts = 0
        self._in_part = 0
        self._events = PlannedEvents()
        self._state: tuple[str, Names] | None = None
        self._servos_s = self._searched_s = -math.inf
        self._begin()
        self._thread = start_thread(self._work, "recorder")

    def tick(self, seen: Tick) -> None:
        """Queue a tick. The readings are copied, because the bus may change them later."""
        self._put(replace(seen, readings=dict(seen.readings)))

    def _put(self, value: Tick | SpeakerFrame | Plan) -> None:
        if self._closed:
            return
        try:
            self._queue.put(value, block=self._wait)
        except queue.Full:
            self._dropped += 1

    def heard(self, frame: SpeakerFrame) -> None:
        """Queue a frame of the person."""
        self._put(frame)

    def planned(self, plan: Plan) -> None:
        """Queue a plan of the listener."""
        self._put(plan)

    def close(self) -> None:
        """Write the queued values and finish the file. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self._queue.put(None)
        self._thread.join()
        self._end()
        if self._trouble:
            _log.warning("the recording is incomplete: %s", self._trouble)
        if self._dropped:
            _log.warning("the recording lacks %d values: the disk was too slow", self._dropped)

    def statistics(self) -> Report:
        """Return figures for the report: messages written, values dropped, bytes on disk, and trouble with the file."""
        size = sum(part.stat().st_size for part in parts_of(self._folder))
        return {"messages": self._written, "dropped": self._dropped, "bytes": size, "trouble": self._trouble}

    def _begin(self) -> None:
        """Open the next file and write its head. Raises ConfigError if it cannot be written."""
        self._parts += 1
        self._in_part = 0
        with _naming(self._folder), ExitStack() as stack:
            self._folder.mkdir(parents=True, exist_ok=True)
            for old in parts_of(self._folder) if self._parts == 1 else ():  # files of a recording that may be replaced
                old.unlink()
            self._file = (self._folder / part_name(self._parts)).open("wb")
            stack.callback(self._file.close)
            self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES)
            self._writer.start(profile="" if self._format == "json" else "ros2", library="sfms-robot")
            self._writer.add_metadata("run", self._about)
            self._file.flush()
            stack.pop_all()
        self._channels = _json_channels(self._writer) if self._format == "json" else _ros2_channels(self._writer)

    def _end(self) -> None:
        self._attempt(self._writer.finish)
        self._attempt(self._file.close)

    def _work(self) -> None:
        """Write values until `close`; runs in the thread. After an error of the file, only empty the queue."""
        while (value := self._queue.get()) is not None:
            if self._trouble is None:
                self._attempt(partial(self._write, value))
        if self._trouble is None:
            self._attempt(partial(self._write, None))

    def _attempt(self, action: Callable[[], Any]) -> None:
        """Call `action`. An error of the file is put into the report and ends the recording, not the run."""
        try:
            with _naming(self._folder):
                action()
        except Exception as error:
            kind = "" if isinstance(error, ConfigError) else f"{type(error).__name__}: "
            self._trouble = self._trouble or f"{kind}{error}"
            _log.error("the recording ends here: %s", self._trouble)

    def _write(self, value: Tick | SpeakerFrame | Plan | None) -> None:
        """Write the messages of a value."""
        for topic, time_s, body in self._messages(value):
            time_ns = max(0, round(time_s * 1e9))
            text = orjson.dumps(body)
            for name, data in [(topic, text)] if self._format == "json" else _as_ros2(topic, time_s, body, text):
                self._writer.add_message(self._channels[name], time_ns, data, time_ns)
                self._written += 1
                self._in_part += 1
        if self._in_part >= PART_MESSAGES:
            self._end()
            self._begin()

    def _messages(self, value: Tick | SpeakerFrame | Plan | None) -> Iterator[Message]:
        """Yield (topic, time, body) of each message of a value; for None those of the last events."""
        match value:
            case None:
                yield from self._news(math.inf)
            case SpeakerFrame(face=face):
                body: Report = {
                    "time_s": value.time_s,
                    "audio_pcm16": _pcm16(value.audio),
                    "agent_audio_pcm16": None if value.agent_audio is None else _pcm16(value.agent_audio),
                    "audio_hz": AUDIO_HZ,
                    "energy_db": round(energy_db(value.audio), 2),
                    "face": face and _by_channel(face.motion),
                    "jaw_rad": face and _rounded(face.jaw_rad),
                    "attention": _rounded(value.attention),
                    "place_m": _rounded(value.place_m),
                }
                yield "/speaker", value.time_s, body
            case Plan():
                self._events.join(value)
                body = {
                    "made_at_s": value.made_at_s,
                    "times_s": _rounded(value.times_s),
                    "frames": _rounded(value.frames),
                    "jaw_rad": _rounded(value.jaw_rad),
                    "hazards_hz": {kind: _rounded(hazard) for kind, hazard in value.hazards_hz.items()},
                }
                yield "/plan", value.made_at_s, body
                yield from self._news(value.made_at_s)
            case Tick(time_s=time_s, readings=readings):
                yield "/face", time_s, {"time_s": time_s, **_by_channel(value.motion)}
                joints = {
                    name: {
                        "goal_rad": goal_rad,
                        "present_rad": reading and _rounded(reading.position_rad),
                        "age_s": reading and _rounded(reading.age_s),
                        "fault": reading and reading.fault,
                    }
                    for name, goal_rad in zip(self._joints, _rounded(value.goals_rad), strict=True)
                    for reading in [readings.get(name)]
                }
                yield "/joints", time_s, {"time_s": time_s, "joints": joints}
                if (value.state, value.why) != self._state:
                    self._state = value.state, value.why
                    yield "/state", time_s, {"time_s": time_s, "state": value.state, "why": list(value.why)}
                if time_s - self._servos_s >= SERVOS_S:
                    self._servos_s = time_s
                    servos = {
                        joint: {name: _rounded(each) for name, each in reading.extra.items()} | {"fault": reading.fault}
                        for joint, reading in readings.items()
                    }
                    yield "/servos", time_s, {"time_s": time_s, "servos": servos}

    def _news(self, now_s: float) -> Iterator[Message]:
        """Yield the events of plans, once a second: a search takes a millisecond that may delay the loop's thread."""
        if not 0 <= now_s - self._searched_s < EVENTS_S:
            self._searched_s = now_s
            for event in self._events.news():
                yield "/event", event.start_s, {name: each for name, each in vars(event).items() if name != "origin_s"}


def _json_channels(writer: Writer) -> dict[str, int]:
    channels = {}
    for topic, properties in _SCHEMAS.items():
        schema = json.dumps({"type": "object", "properties": properties}).encode()
        number = writer.register_schema(f"sfms_robot{topic.replace('/', '.')}", "jsonschema", schema)
        channels[topic] = writer.register_channel(topic, "json", number)
    return channels


def _ros2_channels(writer: Writer) -> dict[str, int]:
    from sfms_robot.signals import ros2_messages as ros2

    kinds = {**dict.fromkeys(ROS2_TOPICS.values(), ros2.STRING), **ros2.TYPED_TOPICS, "/audio": ros2.AUDIO}
    schemas = {
        kind: writer.register_schema(kind, "ros2msg", ros2.schema_text(kind).encode()) for kind in set(kinds.values())
    }
    return {
        topic: writer.register_channel(topic, "cdr", schemas[kind], {"topic_type_hash": ros2.type_hash(kind)})
        for topic, kind in kinds.items()
    }


def _as_ros2(topic: str, time_s: float, body: Facts, text: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield (topic, CDR) of each ROS 2 message made from one of our messages."""
    from sfms_robot.signals import ros2_messages as ros2

    yield ROS2_TOPICS[topic], ros2.to_cdr(ros2.STRING, {"data": text.decode()})
    head = {"header": ros2.header(max(0.0, time_s), "head")}
    match topic:
        case "/joints" if body["joints"]:
            found = [
                each["goal_rad"] if (at := each["present_rad"]) is None else at for each in body["joints"].values()
            ]
            joints = head | {"name": list(body["joints"]), "position": found}
            yield "/joint_states", ros2.to_cdr(ros2.JOINT_STATE, joints)
        case "/face":
            units = ros2.units_of(np.array([body[name] for name in CHANNELS], np.float32))
            yield "/robot_face/action_units", ros2.to_cdr(ros2.ACTION_UNITS, head | units)
            yield "/robot_face/expression", ros2.to_cdr(ros2.EXPRESSION, head | ros2.expression_of(units["intensity"]))
        case "/speaker":
            yield "/audio", ros2.to_cdr(ros2.AUDIO, head | {"audio": {"data": base64.b64decode(body["audio_pcm16"])}})
        case "/state":
            state = ros2.diagnostics(head["header"], body["state"], {"why": ", ".join(body["why"])})
            yield "/diagnostics", ros2.to_cdr(ros2.DIAGNOSTICS, state)


def check_folder(folder: Path, overwrite: bool = False) -> None:
    """Raise ConfigError if the folder cannot be used, or holds a recording that may not be overwritten."""
    with _naming(folder):
        there = (folder / RUN_FILE).exists()
    if there and not overwrite:
        raise ConfigError(f"{folder}: holds a recording already (another folder, or --overwrite)")


def write_report(folder: Path, report: Facts) -> None:
    """Write DIR/report.json, whole or not at all. An error is logged: the report is printed in any case."""
    try:
        write_whole(folder / REPORT_FILE, json.dumps(report, indent=2) + "\n")
    except ConfigError as error:
        _log.error("--record %s: the report cannot be written: %s", folder, error)


def part_name(part: int) -> str:
    """Return the file name of a recording's first, second ... part."""
    return RUN_FILE if part == 1 else f"run-{part:04d}.mcap"


def parts_of(folder: Path) -> list[Path]:
    """Return the files of a recording, in order; empty without one."""
    first = folder / RUN_FILE
    return [first, *sorted(folder.glob("run-[0-9][0-9][0-9][0-9].mcap"))] if first.is_file() else []


@contextmanager
def _naming(folder: Path) -> Iterator[None]:
    """Raise an OSError of the block as a ConfigError that names the flag: `--record DIR: No space left on device`."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"--record {folder}: {error.strerror or error}") from error


def _pcm16(audio: Floats) -> str:
    """Return samples of -1..1 as 16-bit integers, little-endian, in base64."""
    pcm = np.round(np.clip(audio, -1.0, 1.0) * 32767).astype("<i2")
    return base64.b64encode(pcm.tobytes()).decode()


def _by_channel(motion: Floats) -> dict[str, float]:
    return dict(zip(CHANNELS, _rounded(motion), strict=True))


def _rounded(value: Any) -> Any:
    """Return a number rounded, an array as rounded lists, None unchanged.

    Values that are not finite become null on disk: JSON has no inf and no NaN.
    """
    if isinstance(value, np.ndarray):
        return value.astype(np.float64).round(_DIGITS).tolist()
    return None if value is None else round(float(value), _DIGITS)
