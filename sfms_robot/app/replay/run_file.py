"""DIR/run.mcap, and the files that it goes on in -> arrays. A run that was killed is read up to where its file ends."""

from __future__ import annotations

import base64
import json
import math
import struct
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Footer, Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from sfms_robot.app.listen.report import LONG
from sfms_robot.endpoint import whole_number
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_SAMPLES, MOTION_DIM, Doubles, Floats
from sfms_robot.runtime.loop import AWAY_S
from sfms_robot.runtime.recorder import RUN_FILE, parts_of

_PAUSE_FRAMES = 5  # a silence shorter than 0.2 s does not end a phrase
_FLOOR_DB, _BELOW_LOUD_DB = -50.0, 27.0


@dataclass(frozen=True, kw_only=True)
class RunRecording:
    """A run as arrays: N ticks, J joints, M speaker frames.

    Attributes:
        about: what the run wrote about itself (head, listener, seed, ...).
        joints: (J,) names.
        times_s: (N,) of the ticks. motion: (N, 58) the face asked for.
        goals_rad, present_rad: (N, J) float32; present is NaN where nothing was read within `AWAY_S`.
        faults: (N, J) a named fault is there.
        heard_s: (M,) ends of the speaker's frames. audio: (M * 640,) zeros where there was none.
        agent_audio: (M * 640,) voice of the head itself, sample by sample beside `audio`; None where the recording has
            none, as those of version 0.1.
        energy_db: (M,). speaker: (M, 58) NaN where no face was seen. speaker_jaw_rad: (M, 3) NaN where no jaw was.
        plans: how many the listener made.
        states: (time_s, name, why) of every change, in order; none in a file of version 0.1.
        events: (start_s, kind) of the nods, blinks and smiles that plans held.
        servos_s: (K,) when servos told the rest of what they tell. servos: (K, J) by name, such as temperature_C; NaN
            where one did not.
        whole: the file has its end.
    """

    about: Mapping[str, str]
    joints: tuple[str, ...]
    times_s: Doubles
    motion: Floats
    goals_rad: Floats
    present_rad: Floats
    faults: NDArray[np.bool_]
    heard_s: Doubles
    audio: Floats
    agent_audio: Floats | None
    energy_db: Doubles
    speaker: Floats
    speaker_jaw_rad: Floats
    plans: int
    states: Sequence[tuple[float, str, tuple[str, ...]]]
    events: Sequence[tuple[float, str]]
    servos_s: Doubles
    servos: Mapping[str, Floats]
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
        """Something was heard."""
        return bool(np.any(self.energy_db > _FLOOR_DB))

    @property
    def talking(self) -> NDArray[np.bool_]:
        """(M,) the speaker is in a phrase: loud against his own level, pauses under 0.2 s closed."""
        if not self.has_voice:
            return np.zeros(len(self.heard_s), dtype=np.bool_)
        loud = self.energy_db > max(_FLOOR_DB, float(np.percentile(self.energy_db, 95)) - _BELOW_LOUD_DB)
        edges = np.flatnonzero(np.diff(loud.astype(int)))
        for end, start in zip(edges[:-1], edges[1:], strict=True):
            if loud[end] and start - end <= _PAUSE_FRAMES:
                loud[end : start + 1] = True
        return loud

    def talks_at(self, times_s: Doubles) -> NDArray[np.bool_]:
        """(N,) whether the speaker is in a phrase at some instants."""
        if not len(self.heard_s):
            return np.zeros(len(times_s), dtype=np.bool_)
        frame = np.searchsorted(self.heard_s, np.asarray(times_s) - 1e-9)
        out: NDArray[np.bool_] = self.talking[np.minimum(frame, len(self.heard_s) - 1)]
        return out

    @property
    def title(self) -> str:
        """One line: head, listener, speaker and length."""
        parts = [self.about[key] for key in ("head", "listener", "audio") if self.about.get(key)]
        cut = "" if self.whole else " (the file was cut off)"
        return "  |  ".join([*parts, f"{self.listened_s:.1f} s{cut}"])


def read_recording(folder: Path | str) -> RunRecording:
    """Read what `run --record` wrote. Raises ConfigError, in one line, when there is nothing that can be read."""
    parts = parts_of(Path(folder))
    if not parts:
        what = f"has no {RUN_FILE}" if Path(folder).is_dir() else "is no folder"
        raise ConfigError(f"{folder}: {what}: not what `sfms-robot run --record DIR` wrote")
    found, file = _Found(), parts[0]
    try:
        for file in parts:
            for kind, value in _records(file):
                found.take(kind, value)
    except (EndOfFile, struct.error) as error:
        if not found.ticks:
            raise ConfigError(f"{file}: holds no tick: the file is cut off") from error
    except McapError as error:
        raise ConfigError(f"{file}: not a recorded run: {error}") from error
    except Exception as error:  # a broken chunk: each compressor has errors of its own
        raise ConfigError(f"{file}: damaged: {error}") from error
    if not found.ticks:
        raise ConfigError(
            f"{file}: holds no tick: " + ("the run never began" if found.whole else "the file is cut off")
        )
    return found.recording()


def states_of(folder: Path) -> list[tuple[float, str, tuple[str, ...]]]:
    """Every state of a recorded run: since when, its name, why."""
    records = (each for file in parts_of(folder) for each in _records(file))
    return [(told["time_s"], told["state"], tuple(told["why"])) for kind, told in records if kind == "/state"]


def summary(recording: RunRecording) -> dict[str, Any]:
    """What is in a recording, for the command line."""
    told: dict[str, Any] = {key: value for key, value in recording.about.items() if key not in LONG}
    if told.get("seed", "").isdecimal():  # what a run writes about itself is text
        told["seed"] = whole_number(told["seed"])
    return {
        **told,
        "duration_s": round(recording.listened_s, 3),
        "ticks": len(recording.times_s),
        "speaker_frames": len(recording.heard_s),
        "plans": recording.plans,
        "events": dict(Counter(kind for _, kind in recording.events)),
        "states": [name for _, name, _ in recording.states],
        "joints": len(recording.joints),
        "faults": int(recording.faults.any(axis=0).sum()),
        "hottest_C": _hottest(recording.servos.get("temperature_C")),
        "whole": recording.whole,
    }


def _hottest(temperatures_C: Floats | None) -> float | None:
    if temperatures_C is None or np.isnan(temperatures_C).all():
        return None
    return round(float(np.nanmax(temperatures_C)), 1)


def _records(file: Path) -> Iterator[tuple[str, Any]]:
    """(topic, body), ("about", metadata) and, when the file has one, ("end", None)."""
    topics: dict[int, str] = {}
    with file.open("rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                yield topics[record.channel_id], json.loads(record.data)
            elif isinstance(record, Metadata) and record.name == "run":
                yield "about", record.metadata
            elif isinstance(record, Footer):
                yield "end", None


class _Found:
    """What was read so far, number by number: messages as they come take twenty times as much."""

    def __init__(self) -> None:
        self.about: dict[str, str] = {}
        self.whole = False
        self._joints: tuple[str, ...] = ()
        self._plans = 0
        self._times_s, self._heard_s, self._energy_db = (array("d") for _ in range(3))
        self._motion, self._goals_rad, self._present_rad, self._speaker, self._jaw_rad = (array("f") for _ in range(5))
        self._faults, self._pcm16, self._agent_pcm16 = bytearray(), bytearray(), bytearray(2 * FRAME_SAMPLES)
        self._speaks = False
        self._states: list[tuple[float, str, tuple[str, ...]]] = []
        self._events: list[tuple[float, str]] = []
        self._servos_s = array("d")
        self._servos: dict[str, array[float]] = {}

    @property
    def ticks(self) -> int:
        """Whole ones: a cut may fall between the face and the joints of one."""
        return min(len(self._times_s), len(self._motion) // MOTION_DIM)

    def take(self, kind: str, value: Any) -> None:
        """One record of `_records`."""
        if kind == "about":  # at the beginning of every part
            self.about, self.whole = self.about or value, False
            self._joints = tuple(json.loads(value["joints"]))
        elif kind == "end":
            self.whole = True
        elif kind == "/plan":
            self._plans += 1
        elif kind == "/face":
            self._motion.extend(_by_channel(value))
        elif kind == "/joints":
            self._tick(value["time_s"], [value["joints"][name] for name in self._joints])
        elif kind == "/speaker":
            self._heard_s.append(value["time_s"])
            self._energy_db.append(value["energy_db"])
            self._speaker.extend(_by_channel(value["face"]))
            self._jaw_rad.extend(value.get("jaw_rad") or [math.nan] * 3)  # no key in a recording of version 0.1
            self._pcm16 += _samples(value["audio_pcm16"])
            self._speaks |= (said := value.get("agent_audio_pcm16")) is not None
            self._agent_pcm16 += _samples(said or "")
        elif kind == "/state":
            self._states.append((value["time_s"], value["state"], tuple(value["why"])))
        elif kind == "/event":
            self._events.append((value["start_s"], value["kind"]))
        elif kind == "/servos":
            self._told(value["time_s"], value["servos"])

    def _tick(self, time_s: float, joints: Sequence[Mapping[str, Any]]) -> None:
        self._times_s.append(time_s)
        self._goals_rad.extend(joint["goal_rad"] for joint in joints)
        self._present_rad.extend(_read_rad(joint) for joint in joints)
        self._faults += bytes(joint["fault"] is not None for joint in joints)

    def _told(self, time_s: float, servos: Mapping[str, Mapping[str, Any]]) -> None:
        """A row of J for every name that any servo ever told, NaN before it was first told."""
        before = len(self._servos_s) * len(self._joints)
        for name in {name for told in servos.values() for name in told} - {"fault", *self._servos}:
            self._servos[name] = array("f", [math.nan] * before)
        for name, values in self._servos.items():
            values.extend(_or_nan(servos.get(joint, {}).get(name)) for joint in self._joints)
        self._servos_s.append(time_s)

    def recording(self) -> RunRecording:
        count, ticks = len(self._joints), self.ticks
        by_joint = [np.array(values, dtype=np.float32) for values in (self._goals_rad, self._present_rad)]
        goals_rad, present_rad = (values.reshape(-1, count)[:ticks] for values in by_joint)
        return RunRecording(
            about=self.about,
            joints=self._joints,
            times_s=np.array(self._times_s)[:ticks],
            motion=np.array(self._motion, dtype=np.float32).reshape(-1, MOTION_DIM)[:ticks],
            goals_rad=goals_rad,
            present_rad=present_rad,
            faults=np.frombuffer(self._faults, dtype=np.bool_).reshape(-1, count)[:ticks],
            heard_s=np.array(self._heard_s),
            audio=_sound(self._pcm16),
            # A frame holds what the robot says after it: the sound of the frame itself stands in the one before.
            agent_audio=_sound(self._agent_pcm16)[: len(self._heard_s) * FRAME_SAMPLES] if self._speaks else None,
            energy_db=np.array(self._energy_db),
            speaker=np.array(self._speaker, dtype=np.float32).reshape(-1, MOTION_DIM),
            speaker_jaw_rad=np.array(self._jaw_rad, dtype=np.float32).reshape(-1, 3),
            plans=self._plans,
            states=self._states,
            events=self._events,
            servos_s=np.array(self._servos_s),
            servos={name: np.array(values, np.float32).reshape(-1, count) for name, values in self._servos.items()},
            whole=self.whole,
        )


def _by_channel(body: Mapping[str, float | None] | None) -> list[float]:
    return [math.nan if body is None else _or_nan(body[name]) for name in CHANNELS]


def _read_rad(joint: Mapping[str, Any]) -> float:
    """A position that is older than the servo may be away is none."""
    return math.nan if (joint.get("age_s") or 0.0) > AWAY_S else _or_nan(joint["present_rad"])


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _samples(pcm16: str) -> bytes:
    """Return the samples of one frame, always 640 of them, so that they stay in step with the clock."""
    size = 2 * FRAME_SAMPLES
    return base64.b64decode(pcm16)[:size].ljust(size, b"\0")


def _sound(pcm16: bytearray) -> Floats:
    return np.frombuffer(pcm16, dtype="<i2").astype(np.float32) / np.float32(32767)
