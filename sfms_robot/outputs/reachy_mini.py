"""Reachy Mini through its maker's daemon: `--output reachy-mini[:HOST:PORT]` and `reachy-mini-overlay[:HOST:PORT]`.

JSON messages over ws://HOST:8000/ws/sdk (read at pollen-robotics/reachy_mini 1.13, and tried with its daemon):

    goto_target         head, antennas, body_yaw, duration   sent once, to neutral; targets are ignored meanwhile
    set_full_target     head, antennas, body_yaw             sent by `reachy-mini`, each frame
    set_speech_offsets  x, y, z, roll, pitch, yaw            sent by `reachy-mini-overlay`, each frame; the daemon adds
                                                             it to any app or move that runs, and keeps the last one
    head_pose           4x4                                  received 50 times a second
    daemon_status       state, motor mode                    received once a second

Axes, units and Euler order are ours. Antennas (right, left) [rad] and body move as those of the shipped head
reachy_mini do: the body takes the yaw beyond 40 degrees.

The daemon ignores a pose that its legs do not reach. The head's lean (roll and pitch together) therefore stays within
35 degrees, where the maker allows 40, and its shift shrinks to 0 as the lean grows. A test checks that each such pose
is within reach of `retarget.stewart`.
"""

from __future__ import annotations

import http.client
import math
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Final

import numpy as np
import orjson

from sfms_robot.config.head import other_side
from sfms_robot.errors import OutputError
from sfms_robot.frames import CHANNELS, POSE, Doubles, Floats
from sfms_robot.outputs.websocket_peer import CONNECT_S, SILENT_S, Message, WebSocketOutput
from sfms_robot.ports import ChannelLimit, Facts, OutputFrame
from sfms_robot.signals.minimum_jerk import ease
from sfms_robot.signals.rotations import rotation

RATE_HZ: Final = 50.0  # more than 100 targets a second overload a daemon
_SETTLE_S: Final = 0.2  # until the daemon accepts targets again after the way to neutral
_KNOWN_MAJOR: Final = "1"  # major version of the daemon
_NEAR_RAD, _NEAR_M = 0.2, 0.02  # a head this close to its goal is near it
_APART_S: Final = 0.5  # longest time not near the goal; then the output eases in again, which the daemon does not do
_NO_POSE: Final = "reports no head_pose"
_DRIVEN: Final = "another move or program drives it, or something holds its head"

LEAN_RAD: Final = math.radians(35)
SHIFT_M: Final = 0.015
_NECK_RAD: Final = math.radians(40)  # yaw of the head, beyond which the body turns
_BODY_RAD: Final = math.radians(160)

# Weights of channels for the right antenna. For the left antenna left and right are swapped.
ANTENNA: Final[Mapping[str, float]] = {
    "browInnerUp": 0.8, "browOuterUpLeft": 0.1, "browOuterUpRight": 0.5, "browDownLeft": -0.1, "browDownRight": -0.5,
    "mouthSmileLeft": 0.15, "mouthSmileRight": 0.15, "mouthFrownLeft": -0.15, "mouthFrownRight": -0.15,
}  # fmt: skip
_RIGHT: Final = np.array([ANTENNA.get(name, 0.0) for name in CHANNELS])
_WEIGHTS: Final = np.stack([_RIGHT, _RIGHT[[CHANNELS.index(other_side(name)) for name in CHANNELS]]])  # (2, 58)
_REST_RAD: Final = np.radians([-10.0, 10.0])
_RAISED_RAD: Final = np.radians([40.0, -40.0])

_HISTORY: Final = int(30 * RATE_HZ)  # sent frames that are compared with the daemon's reports
_WINDOW_S: Final = 5.0
_LAGS_S: Final = np.arange(0.0, 0.3, 0.004)
_NEARLY_0: Final = 1e-3  # rad, m
_MOVES_RAD: Final = 0.003  # smallest standard deviation in a window for measuring a lag

_TURN: Final = ChannelLimit(-LEAN_RAD, LEAN_RAD, math.radians(250), math.radians(3000))
_SHIFT: Final = ChannelLimit(-SHIFT_M, SHIFT_M, 0.15, 3.0)
_FACE: Final = ChannelLimit(0.0, 1.0, 4.0, 80.0)
_OFFSET: Final = ChannelLimit(-math.radians(20), math.radians(20), math.radians(250), math.radians(3000))


def in_reach(pose: Doubles) -> Doubles:
    """Return a pose (6,) within reach of the legs: less lean and shift in the same direction, the same yaw."""
    out = pose.copy()
    lean = math.hypot(*pose[:2])
    out[:2] *= min(1.0, LEAN_RAD / max(lean, 1e-9))
    shift, most = math.hypot(*pose[3:]), SHIFT_M * max(0.0, 1.0 - lean / LEAN_RAD)
    out[3:] *= min(1.0, most / max(shift, 1e-9))
    return out


def body_yaw(yaw_rad: float) -> float:
    """Return the body's part of a yaw: the part beyond that of the neck."""
    beyond = yaw_rad - np.clip(yaw_rad, -_NECK_RAD, _NECK_RAD)
    return float(np.clip(beyond, -_BODY_RAD, _BODY_RAD))


def antennas(motion: Floats) -> Doubles:
    """Return the angles (2,) of the right and the left antenna [rad] for motion (58,)."""
    angles: Doubles = _REST_RAD + _RAISED_RAD * np.clip(_WEIGHTS @ motion, -1.0, 1.0)
    return angles


def matrix(pose: Doubles) -> Doubles:
    """Return the 4x4 matrix of a pose (6,)."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation(pose[:3]), pose[3:]
    return out


def following(sent: Sequence[tuple[float, float]], reported: Sequence[tuple[float, float]]) -> dict[str, float | None]:
    """Return how a reported angle follows the one that was sent, both as (time [s], angle [rad]).

    The lag is the median of the lags with the best correlation in windows of 5 s. The correlation is that of all values
    at this lag. Both are None if the angles hardly moved.
    """
    unknown: dict[str, float | None] = {"pitch_correlation": None, "lag_ms": None}
    if min(len(sent), len(reported)) < 2:
        return unknown
    (sent_s, goals), (times_s, angles) = np.array(sent).T, np.array(reported).T
    inside_s = sent_s[0] + _LAGS_S[-1], sent_s[-1]
    inside = (times_s >= inside_s[0]) & (times_s <= inside_s[1])
    times_s, angles = times_s[inside], angles[inside]

    goals_at = np.stack([np.interp(times_s - lag_s, sent_s, goals) for lag_s in _LAGS_S])  # (lags, n)
    windows = np.split(np.arange(times_s.size), np.searchsorted(times_s, np.arange(*inside_s, _WINDOW_S)[1:]))
    best = [_correlations(goals_at[:, each], angles[each]) for each in windows if each.size]
    lags = [int(np.argmax(each)) for each in best if each is not None]
    if not lags:
        return unknown
    lag = int(np.median(lags))
    over_all = _correlations(goals_at[lag : lag + 1], angles)
    correlation = None if over_all is None else round(float(over_all[0]), 4)
    return {"pitch_correlation": correlation, "lag_ms": round(1e3 * float(_LAGS_S[lag]), 1)}


def _correlations(goals: Doubles, angles: Doubles) -> Doubles | None:
    """Return the correlation (k,) of goals (k, n) and angles (n,); None if one of them hardly moves."""
    if min(goals.std(axis=1).min(), angles.std()) < _MOVES_RAD:
        return None
    return np.corrcoef(goals, angles)[-1, :-1]


class ReachyDaemon(WebSocketOutput):
    """An output to the daemon. It checks, at the start and once a second, that the robot can be driven."""

    usual_port = 8000
    path = "/ws/sdk"
    absent = "start reachy-mini-daemon, or name its host"
    rate_hz = RATE_HZ
    moves = True

    def heard(self, messages: Sequence[Message], now_s: float) -> None:
        for message in messages:
            if message.get("type") == "daemon_status":
                self._check_status(message)

    def check(self) -> None:
        """Raise OutputError if the daemon or the robot cannot be driven now."""
        status = self._get("/api/daemon/status")
        self._check_status(status)
        version = str(status.get("version"))
        if version.partition(".")[0] != _KNOWN_MAJOR:
            self.note_once(f"its daemon is version {version}; versions 1 are known, 1.13 was tried")

    def _check_status(self, status: Message) -> None:
        """Raise OutputError for a daemon that does not run, or a robot whose motors are off."""
        state, backend = status.get("state"), status.get("backend_status")
        if state != "running":
            raise OutputError(f"its daemon is {state}, not running")
        mode = backend.get("motor_control_mode") if isinstance(backend, dict) else None
        if mode != "enabled":
            raise OutputError(f"its motors are {mode}, not enabled: wake the robot up in its dashboard")

    def _get(self, path: str) -> Message:
        """Return the object that the daemon's HTTP interface has at `path`. Raises OutputError."""
        connection = http.client.HTTPConnection(self.host, self.port, timeout=CONNECT_S)
        try:
            connection.request("GET", path)
            found = orjson.loads(connection.getresponse().read(100_000))
        except (OSError, http.client.HTTPException, orjson.JSONDecodeError) as error:
            raise OutputError(f"is not Reachy Mini's daemon: no answer from {path}") from error
        finally:
            connection.close()
        if not isinstance(found, dict):
            raise OutputError(f"is not Reachy Mini's daemon: {path} is not an object")
        return found


class ReachyMini(ReachyDaemon):
    """Head, antennas and body of a Reachy Mini. It begins with the daemon's own way to neutral."""

    kind = "reachy-mini"
    neutral_s = 1.5  # duration of the way to neutral
    limits: Mapping[str, ChannelLimit] = {
        "roll": _TURN,
        "pitch": _TURN,
        "yaw": ChannelLimit(-math.pi, math.pi, math.radians(120), math.radians(800)),
        **dict.fromkeys("xyz", _SHIFT),
        **dict.fromkeys(ANTENNA, _FACE),
    }

    def __init__(self, address: str = "") -> None:
        super().__init__(address)
        self._sent = deque[tuple[float, float]](maxlen=_HISTORY)
        self._reported = deque[tuple[float, float]](maxlen=_HISTORY)
        self._goal = np.eye(4)  # the pose that was sent last
        self._together_s = 0.0  # time at which the head was last near it

    def greet(self) -> None:
        self.check()
        lock = self._get("/api/daemon/robot-app-lock-status")
        if lock.get("state") != "free" and not str(lock.get("holder_name")).startswith("sfms"):
            raise OutputError(f"app {lock.get('holder_name')} drives it: stop the app, or use reachy-mini-overlay")
        began_s = time.monotonic()
        neutral = {"head": np.eye(4).ravel(), "antennas": _REST_RAD, "body_yaw": 0.0}
        self.say({"type": "goto_target", **neutral, "duration": self.neutral_s})
        poses = _reported(self.link.until(began_s + self.neutral_s + _SETTLE_S))
        if not len(poses):
            raise OutputError(_NO_POSE)
        if not _near(poses[-1], np.eye(4)):
            raise OutputError(f"did not go to neutral: {_DRIVEN}")
        self._goal, self._together_s = np.eye(4), time.monotonic()
        self._reported.append((self._together_s, _pitch(poses[-1])))

    def message(self, frame: OutputFrame, now_s: float) -> Message:
        pose = in_reach(frame.motion[POSE].astype(np.float64))
        self._goal = matrix(pose)
        return {
            "type": "set_full_target",
            "head": self._goal.ravel(),
            "antennas": antennas(frame.motion),
            "body_yaw": body_yaw(float(pose[2])),
        }

    def shown(self, frame: OutputFrame, now_s: float) -> None:
        self._sent.append((now_s, _pitch(self._goal)))

    def heard(self, messages: Sequence[Message], now_s: float) -> None:
        super().heard(messages, now_s)
        poses = _reported(messages)
        for place, pose in enumerate(poses, 1 - len(poses)):  # the newest arrived now
            self._reported.append((now_s + place / RATE_HZ, _pitch(pose)))
        if now_s - self._reported[-1][0] > SILENT_S:
            raise OutputError(_NO_POSE)
        if not len(poses) or _near(poses[-1], self._goal):
            self._together_s = now_s
        elif now_s - self._together_s > _APART_S:
            raise OutputError(f"does not follow: {_DRIVEN}")

    def statistics(self) -> Facts:
        """Return the frames that a slow peer missed, and how the reported pitch followed over the last 30 s."""
        return {**super().statistics(), **following(list(self._sent), list(self._reported))}


class ReachyMiniOverlay(ReachyDaemon):
    """An offset on top of the head's motion by an app or the daemon."""

    kind = "reachy-mini-overlay"
    limits: Mapping[str, ChannelLimit] = {
        **dict.fromkeys(("roll", "pitch", "yaw"), _OFFSET),
        **dict.fromkeys("xyz", _SHIFT),
    }

    def __init__(self, address: str = "") -> None:
        super().__init__(address)
        self._last = np.zeros(6)  # offset that the daemon may still have

    def greet(self) -> None:
        """Ease an offset that was left by a break in the network to 0."""
        self.check()
        steps = int(RATE_HZ) if self._last.any() else 1
        for left in self._last * (1.0 - ease(np.arange(1, steps + 1) / steps))[:, None]:
            self._send(left)
            deque(self.link.until(time.monotonic() + 1.0 / RATE_HZ), maxlen=0)

    def message(self, frame: OutputFrame, now_s: float) -> Message:
        return _offset(frame.motion[POSE].astype(np.float64))

    def shown(self, frame: OutputFrame, now_s: float) -> None:
        self._last = frame.motion[POSE].astype(np.float64)

    def close(self) -> None:
        if self._link is not None and self._link.closed:
            self._last = np.zeros(6)  # the offset is gone with the daemon
        super().close()

    def farewell(self) -> None:
        """Set an offset of nearly 0 to exactly 0; the offset of a halted run stays in the daemon."""
        if np.abs(self._last).max() < _NEARLY_0:
            self._send(np.zeros(6))

    def _send(self, pose: Doubles) -> None:
        self._last = pose
        self.say(_offset(pose))


def _offset(pose: Doubles) -> Message:
    """Return the message of an offset (6,): place first, then angles."""
    return {"type": "set_speech_offsets", "offsets": np.concatenate([pose[3:], pose[:3]])}


def _near(pose: Doubles, goal: Doubles) -> bool:
    away = np.abs(pose - goal)
    return bool(away[:3, :3].max() < _NEAR_RAD and away[:3, 3].max() < _NEAR_M)


def _pitch(pose: Doubles) -> float:
    return -math.asin(np.clip(pose[2, 0], -1.0, 1.0))


def _reported(messages: Iterable[Message]) -> Doubles:
    """Return the poses (n, 4, 4) among messages. Raises OutputError for another shape."""
    found = [message.get("head_pose") for message in messages if message.get("type") == "head_pose"]
    with suppress(TypeError, ValueError):
        poses = np.array(found, dtype=np.float64).reshape(len(found), 4, 4)
        if np.isfinite(poses).all():
            return poses
    raise OutputError("reports a head_pose that is not 4x4 numbers")
