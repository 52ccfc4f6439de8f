"""Read DIR/run.mcap, and the files that continue it, into arrays. A file that was cut off is read up to its end."""

from __future__ import annotations

import base64
import json
import math
import struct
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Footer, Message, Metadata
from mcap.stream_reader import StreamReader

from sfms_robot.app.listen.report import LONG
from sfms_robot.data import Names, Report
from sfms_robot.endpoint import whole_number
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_SAMPLES, MOTION_DIM, Bools, Doubles, Floats
from sfms_robot.runtime.loop import AWAY_S
from sfms_robot.runtime.recorder import ROS2_TOPICS, RUN_FILE, parts_of
from sfms_robot.signals.events import runs
from sfms_robot.signals.ros2_messages import STRING, from_cdr

_PAUSE_FRAMES = 5  # a silence shorter than 0.2 s does not end a phrase
_FLOOR_DB, _BELOW_LOUD_DB = -50.0, 27.0
_FRAME_BYTES = 2 * FRAME_SAMPLES

_Rows = defaultdict[str, list[Any]]  # rows by topic


@dataclass(frozen=True, kw_only=True)
class RunRecording:
    """A run as arrays: N ticks, J joints, M speaker frames.

    Attributes:
        about: facts of the run (head, listener, seed, ...).
        joints: (J,) names.
        times_s: (N,) times of the ticks. motion: (N, 58) the requested face.
        goals_rad, present_rad: (N, J) float32; present is NaN where nothing was read within `AWAY_S`.
        faults: (N, J) True where there is a named fault.
        heard_s: (M,) ends of the speaker's frames. audio: (M * 640,) zeros where there was none.
        agent_audio: (M * 640,) voice of the head itself, aligned with `audio` sample by sample; None if it was not
            recorded.
        energy_db: (M,). speaker: (M, 58) NaN where no face was seen.
        plans: number of plans of the listener.
        states: (time_s, name, why) of every change, in order.
        events: (start_s, kind) of the nods, blinks and smiles in the plans.
        hottest_C: highest temperature of all servos; None if none reported one.
        whole: True if the file has its end.
    """

    about: Mapping[str, str]
    joints: Names
    times_s: Doubles
    motion: Floats
    goals_rad: Floats
    present_rad: Floats
    faults: Bools
    heard_s: Doubles
    audio: Floats
    agent_audio: Floats | None
    energy_db: Doubles
    speaker: Floats
    plans: int
    states: Sequence[tuple[float, str, Names]]
    events: Sequence[tuple[float, str]]
    hottest_C: float | None
    whole: bool

    @property
    def duration_s(self) -> float:
        """Time of the last tick."""
        return float(self.times_s[-1])

    @property
    def listened_s(self) -> float:
        """Time of the last tick before the way to rest."""
        ends_s = min((at_s for at_s, state, _ in self.states if state == "stopping"), default=float("inf"))
        return float(self.times_s[max(0, int(np.searchsorted(self.times_s, ends_s)) - 1)])

    @property
    def has_voice(self) -> bool:
        """True if there is any sound."""
        return bool(np.any(self.energy_db > _FLOOR_DB))

    @property
    def talking(self) -> Bools:
        """(M,) True in a phrase of the speaker: loud against their own level, pauses under 0.2 s closed."""
        if not self.has_voice:
            return np.zeros(len(self.heard_s), dtype=np.bool_)
        loud = self.energy_db > max(_FLOOR_DB, float(np.percentile(self.energy_db, 95)) - _BELOW_LOUD_DB)
        for start, end in runs(~loud):
            if start > 0 and end < len(loud) and end - start <= _PAUSE_FRAMES:
                loud[start:end] = True
        return loud

    def talks_at(self, times_s: Doubles) -> Bools:
        """Return (N,) whether the speaker is in a phrase at the instants."""
        if not len(self.heard_s):
            return np.zeros(len(times_s), dtype=np.bool_)
        frame = np.searchsorted(self.heard_s, np.asarray(times_s) - 1e-9)
        out: Bools = self.talking[np.minimum(frame, len(self.heard_s) - 1)]
        return out

    @property
    def title(self) -> str:
        """One line: head, listener, speaker and length."""
        parts = [self.about[key] for key in ("head", "listener", "audio") if self.about.get(key)]
        cut = "" if self.whole else " (the file was cut off)"
        return "  |  ".join([*parts, f"{self.listened_s:.1f} s{cut}"])


def read_recording(folder: Path | str) -> RunRecording:
    """Read the recording that `run --record` wrote. Raises ConfigError, in one line, if nothing can be read."""
    parts = parts_of(Path(folder))
    if not parts:
        what = f"has no {RUN_FILE}" if Path(folder).is_dir() else "is no folder"
        raise ConfigError(f"{folder}: {what}: not what `sfms-robot run --record DIR` wrote")
    about: Mapping[str, str] = {}
    joints: Names = ()
    rows, whole = _Rows(list), False
    try:
        for file in parts:
            for topic, body in _records(file):
                if topic == "about":  # at the beginning of every part
                    about, joints, whole = about or body, tuple(json.loads(body["joints"])), False
                elif topic == "end":
                    whole = True
                else:
                    rows[topic].append(_row(topic, body, joints))
    except (EndOfFile, struct.error):
        whole = False  # the file was cut off
    except McapError as error:
        raise ConfigError(f"{file}: not a recorded run: {error}") from error
    except Exception as error:  # a broken chunk: each compressor has its own exceptions
        raise ConfigError(f"{file}: damaged: {error}") from error
    if not rows["/face"] or not rows["/joints"]:
        raise ConfigError(f"{file}: holds no tick: " + ("the run never began" if whole else "the file is cut off"))
    return _arrays(rows, about, joints, whole)


def summary(recording: RunRecording) -> Report:
    """Return a summary of a recording, for the command line."""
    facts: Report = {key: value for key, value in recording.about.items() if key not in LONG}
    if facts.get("seed", "").isdecimal():  # facts are text
        facts["seed"] = whole_number(facts["seed"])
    return {
        **facts,
        "duration_s": round(recording.listened_s, 3),
        "ticks": len(recording.times_s),
        "speaker_frames": len(recording.heard_s),
        "plans": recording.plans,
        "events": dict(Counter(kind for _, kind in recording.events)),
        "states": [name for _, name, _ in recording.states],
        "joints": len(recording.joints),
        "faults": int(recording.faults.any(axis=0).sum()),
        "hottest_C": recording.hottest_C,
        "whole": recording.whole,
    }


def _records(file: Path) -> Iterator[tuple[str, Any]]:
    """Yield (topic, body), ("about", metadata) and, when the file has one, ("end", None).

    In the format "ros2" the JSON texts are read; messages of ROS's own types, which repeat parts of them, are left out.
    """
    topics = {}
    in_ros2 = False
    ours = {name: topic for topic, name in ROS2_TOPICS.items()}
    with file.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                in_ros2 = record.message_encoding == "cdr"
                topics[record.id] = ours.get(record.topic) if in_ros2 else record.topic
            elif isinstance(record, Message):
                if (topic := topics[record.channel_id]) is not None:
                    yield topic, json.loads(from_cdr(STRING, record.data)["data"] if in_ros2 else record.data)
            elif isinstance(record, Metadata) and record.name == "run":
                yield "about", record.metadata
            elif isinstance(record, Footer):
                yield "end", None


def _row(topic: str, body: Any, joints: Sequence[str]) -> Any:
    """Return the part of a message that is kept: numbers in arrays, since messages take twenty times as much memory.

    None becomes NaN.
    """
    match topic:
        case "/face":
            return _by_channel(body)
        case "/joints":  # (J, 4): goal, position, its age, fault
            servos = [body["joints"][name] for name in joints]
            return body["time_s"], np.array(
                [(each["goal_rad"], each["present_rad"], each["age_s"], each["fault"] is not None) for each in servos],
                np.float32,
            ).reshape(-1, 4)
        case "/speaker":
            sound, said = (body[key] and _pcm16(body[key]) for key in ("audio_pcm16", "agent_audio_pcm16"))
            return body["time_s"], body["energy_db"], _by_channel(body["face"]), sound, said
        case "/state":
            return body["time_s"], body["state"], tuple(body["why"])
        case "/event":
            return body["start_s"], body["kind"]
        case "/servos":  # only the temperatures are kept
            return [each["temperature_C"] for each in body["servos"].values() if each.get("temperature_C") is not None]
    return None  # a plan: only counted


def _arrays(rows: _Rows, about: Mapping[str, str], joints: Names, whole: bool) -> RunRecording:
    """Return the rows of each topic as a recording. A cut may fall between the face and the joints of one tick."""
    times_s, moved = zip(*rows["/joints"][: len(rows["/face"])], strict=True)
    goals_rad, present_rad, ages_s, faults = np.moveaxis(np.stack(moved), 2, 0)
    present_rad[ages_s > AWAY_S] = math.nan
    heard_s, energy_db, faces, sound, said = zip(*rows["/speaker"], strict=True) if rows["/speaker"] else [()] * 5
    hottest_C = max(chain.from_iterable(rows["/servos"]), default=None)
    return RunRecording(
        about=about,
        joints=joints,
        times_s=np.array(times_s),
        motion=np.stack(rows["/face"][: len(times_s)]),
        goals_rad=goals_rad,
        present_rad=present_rad,
        faults=faults != 0,
        heard_s=np.array(heard_s),
        audio=_sound(sound),
        # A frame holds the robot's sound of the time after it: the sound during a frame is in the frame before.
        agent_audio=_sound([None, *said[:-1]]) if any(said) else None,
        energy_db=np.array(energy_db),
        speaker=np.array(faces, np.float32).reshape(-1, MOTION_DIM),
        plans=len(rows["/plan"]),
        states=rows["/state"],
        events=rows["/event"],
        hottest_C=None if hottest_C is None else round(hottest_C, 1),
        whole=whole,
    )


def _by_channel(body: Mapping[str, float | None] | None) -> Floats:
    return np.array([(body or {}).get(name) for name in CHANNELS], np.float32)


def _pcm16(text: str) -> bytes:
    """Return the samples of one frame, always 640 of them, so that they stay in step with the clock."""
    return base64.b64decode(text)[:_FRAME_BYTES].ljust(_FRAME_BYTES, b"\0")


def _sound(frames: Sequence[bytes | None]) -> Floats:
    pcm16 = b"".join(frame or bytes(_FRAME_BYTES) for frame in frames)
    return np.frombuffer(pcm16, "<i2").astype(np.float32) / np.float32(32767)
