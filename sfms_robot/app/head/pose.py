"""`head pose`: one expression, or a few channels, on a head that otherwise rests.

It is a run without a listener: the face asked for rises, stays and falls on the timeline, and everything behind the
timeline is what a run has, so the limits, the way in and the way to rest are the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfms_robot.app.open_head import HeadOptions, open_head
from sfms_robot.app.session import Programme, drive_head
from sfms_robot.app.wiring import SIM
from sfms_robot.errors import ConfigError, TorqueError
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM, POSE_CHANNELS, Doubles, Floats, Plan, SpeakerFrame
from sfms_robot.ports import Observer, Source, Tick
from sfms_robot.runtime.clock import IDLE_FEED
from sfms_robot.runtime.safety import EASE_S, Interrupt
from sfms_robot.signals.minimum_jerk import ease

RISE_S: Final = 0.5
MOVED_DEG: Final = 0.1
_BOUNDS: Final = {"roll": 1.0, "pitch": 1.0, "yaw": 1.6, "x": 0.1, "y": 0.1, "z": 0.1}  # rad and m, either way

EXPRESSIONS: Final[Mapping[str, Mapping[str, float]]] = {
    "smile": {
        "mouthSmileLeft": 0.9, "mouthSmileRight": 0.9, "cheekSquintLeft": 0.4, "cheekSquintRight": 0.4,
        "eyeSquintLeft": 0.2, "eyeSquintRight": 0.2,
    },
    "frown": {"mouthFrownLeft": 0.8, "mouthFrownRight": 0.8, "browDownLeft": 0.6, "browDownRight": 0.6},
    "surprise": {
        "browInnerUp": 0.9, "browOuterUpLeft": 0.8, "browOuterUpRight": 0.8, "eyeWideLeft": 0.8, "eyeWideRight": 0.8,
        "jawOpen": 0.4,
    },
    "anger": {
        "browDownLeft": 1.0, "browDownRight": 1.0, "noseSneerLeft": 0.6, "noseSneerRight": 0.6,
        "mouthPressLeft": 0.5, "mouthPressRight": 0.5,
    },
    "blink": {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    "kiss": {"mouthPucker": 1.0, "mouthFunnel": 0.2},
    "nod": {"pitch": 0.2},
    "look_left": {
        "eyeLookOutLeft": 0.7, "eyeLookInRight": 0.7, "yaw": 0.3,
    },
    "look_right": {"eyeLookInLeft": 0.7, "eyeLookOutRight": 0.7, "yaw": -0.3},
}  # fmt: skip


@dataclass(frozen=True)
class PoseOptions:
    """The flags of `sfms-robot head pose`."""

    head: str
    face: tuple[str, ...]
    port: str = SIM
    hold_s: float = 2.0
    fast: bool = False
    yes: bool = False


def parse_face(words: Sequence[str]) -> Floats:
    """Expressions and CHANNEL=VALUE, later ones over earlier ones -> motion (58,). Raises ConfigError."""
    motion = np.zeros(MOTION_DIM, np.float32)
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            if name not in EXPRESSIONS:
                choices = [*EXPRESSIONS, "CHANNEL=VALUE"]
                raise ConfigError.at("head pose", "EXPRESSION", word, "is not an expression", choices)
            for channel, value in EXPRESSIONS[name].items():
                motion[CHANNEL_INDEX[channel]] = value
            continue
        if name not in CHANNEL_INDEX:
            raise ConfigError.at("head pose", "CHANNEL", name, "is not a channel", CHANNEL_INDEX)
        motion[CHANNEL_INDEX[name]] = _value(name, text)
    return motion


def _value(channel: str, text: str) -> float:
    low, high = (-_BOUNDS[channel], _BOUNDS[channel]) if channel in POSE_CHANNELS else (0.0, 1.0)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise ConfigError.at("head pose", channel, text, "is not a number in its range", [f"{low:g}..{high:g}"])
    return value


def pose_head(options: PoseOptions) -> dict[str, Any]:
    """Rise to the face, hold it, return to rest. Reports how far each joint went, and torque not confirmed off.

    Raises any other RobotError, the head at rest.
    """
    face = parse_face(options.face)
    held = HeldFace(face, options.hold_s)
    with open_head(HeadOptions(options.head, options.port, options.fast, options.yes)) as opened:
        motion = opened.motion
        furthest = Furthest(motion.retargeter.joints, motion.rest_rad)
        alone = NobodyThere()
        drove = drive_head(opened, Programme(alone, alone, held.duration_s, held, observers=[furthest]), Interrupt())
    if drove.error is not None and not isinstance(drove.error, TorqueError):
        raise drove.error
    shown = [name for name, index in CHANNEL_INDEX.items() if face[index]]
    return {
        "version": 1,
        "head": opened.config.name,
        "face": list(options.face),
        "port": options.port,
        "exit": drove.outcome,
        "exit_code": drove.exit_code,
        "error": drove.error and str(drove.error),
        "torque_unconfirmed": drove.log.torque_unconfirmed,
        "joints": furthest.moved(),
        "blind": [name for name in shown if name in motion.retargeter.blind_channels],
    }


class WholeTimeline:
    """A `ports.Timeline` whose future is known: it takes no plans, and there is nothing to remember."""

    def start(self) -> None:
        return None

    def accept(self, plan: Plan, state: None) -> None:
        return None

    def lead_limit_s(self, state: None) -> float:
        return float("inf")


class HeldFace(WholeTimeline):
    """A timeline of one face: torque comes on and settles, the face rises, stays for `hold_s`, and falls."""

    def __init__(self, face: Floats, hold_s: float) -> None:
        self._face = face
        self._falls_s = EASE_S + RISE_S + hold_s
        self.duration_s = self._falls_s + RISE_S

    def sample(self, times_s: Doubles, now_s: float, state: None) -> tuple[Floats, None]:
        """Motion (N, 58) at each of (N,) instants."""
        share = ease((times_s - EASE_S) / RISE_S) - ease((times_s - self._falls_s) / RISE_S)
        return (share[:, None] * self._face).astype(np.float32), None


class NobodyThere(Source):
    """The empty source and the empty feed: nobody speaks, nobody listens."""

    lost = False

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        return ()

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        """There is nobody to hear it."""

    def poll(self, now_s: float) -> Sequence[Plan]:
        return ()

    def statistics(self) -> Mapping[str, Any]:
        return IDLE_FEED


class Furthest(Observer):
    """How far from rest each joint was sent once the face began to rise, and how far it went."""

    def __init__(self, joints: Sequence[str], rest_rad: Doubles) -> None:
        self._joints, self._rest_rad = tuple(joints), rest_rad
        self._sent = np.zeros(len(rest_rad))
        self._reached: dict[str, float] = {}

    def tick(self, seen: Tick) -> None:
        if seen.time_s < EASE_S:
            return
        sent = seen.goals_rad - self._rest_rad
        self._sent = np.where(np.abs(sent) > np.abs(self._sent), sent, self._sent)
        for joint, rest in zip(self._joints, self._rest_rad, strict=True):
            at = seen.readings[joint].position_rad if joint in seen.readings else None
            if at is not None and abs(at - rest) >= abs(self._reached.get(joint, 0.0)):
                self._reached[joint] = float(at - rest)

    def moved(self) -> dict[str, dict[str, float | None]]:
        """Joints that were sent away from rest, in degrees from there; None where a servo does not tell."""
        rows: dict[str, dict[str, float | None]] = {}
        for joint, sent in zip(self._joints, np.degrees(self._sent), strict=True):
            if abs(sent) >= MOVED_DEG:
                reached = self._reached.get(joint)
                rows[joint] = {
                    "sent_deg": round(float(sent), 2),
                    "reached_deg": None if reached is None else round(math.degrees(reached), 2),
                }
        return rows
