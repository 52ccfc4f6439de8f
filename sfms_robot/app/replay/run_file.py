"""Read DIR/run.mcap, and the files that continue it, into arrays; a file that was cut off up to where it ends."""

from __future__ import annotations

import base64
import json
import math
import struct
from array import array
from collections import Counter, defaultdict
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
        about: facts of the run (head, listener, seed, ...).
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
        servos_s: (K,) times of the other readings. servos: (K, J) by name, such as temperature_C; NaN if not reported.
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
        """True if there is any sound."""
        return bool(np.any(self.energy_db > _FLOOR_DB))

    @property
    def talking(self) -> NDArray[np.bool_]:
        """(M,) True in a phrase of the speaker: loud against their own level, pauses under 0.2 s closed."""
        if not self.has_voice:
            return np.zeros(len(self.heard_s), dtype=np.bool_)
        loud = self.energy_db > max(_FLOOR_DB, float(np.percentile(self.energy_db, 95)) - _BELOW_LOUD_DB)
        edges = np.flatnonzero(np.diff(loud.astype(int)))
        for end, start in zip(edges[:-1], edges[1:], strict=True):
            if loud[end] and start - end <= _PAUSE_FRAMES:
                loud[end : start + 1] = True
        return loud

    def talks_at(self, times_s: Doubles) -> NDArray[np.bool_]:
        """Return (N,) whether the speaker is in a phrase at the instants."""
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
    """Return (time_s, name, why) of every change of state in a recorded run."""
    records = (each for file in parts_of(folder) for each in _records(file))
    return [_state(value) for kind, value in records if kind == "/state"]


def summary(recording: RunRecording) -> dict[str, Any]:
    """Return a summary of a recording, for the command line."""
    facts: dict[str, Any] = {key: value for key, value in recording.about.items() if key not in LONG}
    if facts.get("seed", "").isdecimal():  # facts are text
        facts["seed"] = whole_number(facts["seed"])
    warmth_C = recording.servos.get("temperature_C", np.full(1, np.nan))
    hottest_C = None if np.isnan(warmth_C).all() else round(float(np.nanmax(warmth_C)), 1)
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
        "hottest_C": hottest_C,
        "whole": recording.whole,
    }


def _records(file: Path) -> Iterator[tuple[str, Any]]:
    """Yield (topic, body), ("about", metadata) and, when the file has one, ("end", None)."""
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
    """The values read so far, as flat arrays by name: messages take twenty times as much memory."""

    def __init__(self) -> None:
        self.about: dict[str, str] = {}
        self.whole = False
        self._joints: tuple[str, ...] = ()
        self._plans = 0
        self._doubles: defaultdict[str, array[float]] = defaultdict(lambda: array("d"))
        self._floats: defaultdict[str, array[float]] = defaultdict(lambda: array("f"))
        self._servos: dict[str, array[float]] = {}
        self._faults, self._pcm16, self._agent_pcm16 = bytearray(), bytearray(), bytearray(2 * FRAME_SAMPLES)
        self._speaks = False
        self._states: list[tuple[float, str, tuple[str, ...]]] = []
        self._events: list[tuple[float, str]] = []

    @property
    def ticks(self) -> int:
        """Number of whole ticks: a cut may fall between the face and the joints of one."""
        return min(len(self._doubles["times_s"]), len(self._floats["motion"]) // MOTION_DIM)

    def take(self, kind: str, value: Any) -> None:
        """Add one record of `_records`."""
        if kind == "about":  # at the beginning of every part
            self.about, self.whole = self.about or value, False
            self._joints = tuple(json.loads(value["joints"]))
        elif kind == "end":
            self.whole = True
        elif kind == "/plan":
            self._plans += 1
        elif kind == "/face":
            self._floats["motion"].extend(_by_channel(value))
        elif kind == "/joints":
            joints = [value["joints"][name] for name in self._joints]
            self._doubles["times_s"].append(value["time_s"])
            self._floats["goals_rad"].extend(joint["goal_rad"] for joint in joints)
            self._floats["present_rad"].extend(_read_rad(joint) for joint in joints)
            self._faults += bytes(joint["fault"] is not None for joint in joints)
        elif kind == "/speaker":
            for name in ("time_s", "energy_db"):
                self._doubles[name].append(value[name])
            self._floats["speaker"].extend(_by_channel(value["face"]))
            self._floats["jaw_rad"].extend(value.get("jaw_rad") or [math.nan] * 3)  # no key before version 0.2
            said = value.get("agent_audio_pcm16")
            self._speaks |= said is not None
            self._pcm16 += _samples(value["audio_pcm16"])
            self._agent_pcm16 += _samples(said or "")
        elif kind == "/state":
            self._states.append(_state(value))
        elif kind == "/event":
            self._events.append((value["start_s"], value["kind"]))
        elif kind == "/servos":
            self._take_servos(value["time_s"], value["servos"])

    def _take_servos(self, time_s: float, servos: Mapping[str, Mapping[str, Any]]) -> None:
        """Add a row of J for every name that any servo has reported, NaN before its first value."""
        before = len(self._doubles["servos_s"]) * len(self._joints)
        for name in {name for reported in servos.values() for name in reported} - {"fault", *self._servos}:
            self._servos[name] = array("f", [math.nan] * before)
        for name, values in self._servos.items():
            values.extend(_or_nan(servos.get(joint, {}).get(name)) for joint in self._joints)
        self._doubles["servos_s"].append(time_s)

    def recording(self) -> RunRecording:
        """Return all that was read."""
        count, ticks = len(self._joints), self.ticks
        times = {name: np.array(self._doubles[name]) for name in ("times_s", "time_s", "energy_db", "servos_s")}

        def rows(values: array[float], width: int) -> Floats:
            return np.array(values, dtype=np.float32).reshape(-1, width)

        return RunRecording(
            about=self.about,
            joints=self._joints,
            times_s=times["times_s"][:ticks],
            motion=rows(self._floats["motion"], MOTION_DIM)[:ticks],
            goals_rad=rows(self._floats["goals_rad"], count)[:ticks],
            present_rad=rows(self._floats["present_rad"], count)[:ticks],
            faults=np.frombuffer(self._faults, dtype=np.bool_).reshape(-1, count)[:ticks],
            heard_s=times["time_s"],
            audio=_sound(self._pcm16),
            # A frame holds the robot's sound after it: the sound of the frame itself is in the one before.
            agent_audio=_sound(self._agent_pcm16)[: len(times["time_s"]) * FRAME_SAMPLES] if self._speaks else None,
            energy_db=times["energy_db"],
            speaker=rows(self._floats["speaker"], MOTION_DIM),
            speaker_jaw_rad=rows(self._floats["jaw_rad"], 3),
            plans=self._plans,
            states=self._states,
            events=self._events,
            servos_s=times["servos_s"],
            servos={name: rows(values, count) for name, values in self._servos.items()},
            whole=self.whole,
        )


def _state(value: Mapping[str, Any]) -> tuple[float, str, tuple[str, ...]]:
    return value["time_s"], value["state"], tuple(value["why"])


def _by_channel(body: Mapping[str, float | None] | None) -> list[float]:
    return [math.nan if body is None else _or_nan(body[name]) for name in CHANNELS]


def _read_rad(joint: Mapping[str, Any]) -> float:
    """Return a position, NaN where it is so old that the servo counts as away."""
    return math.nan if (joint.get("age_s") or 0.0) > AWAY_S else _or_nan(joint["present_rad"])


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _samples(pcm16: str) -> bytes:
    """Return the samples of one frame, always 640 of them, so that they stay in step with the clock."""
    size = 2 * FRAME_SAMPLES
    return base64.b64decode(pcm16)[:size].ljust(size, b"\0")


def _sound(pcm16: bytearray) -> Floats:
    return np.frombuffer(pcm16, dtype="<i2").astype(np.float32) / np.float32(32767)
