"""`head pose`: one expression, or a few channels, on a head that otherwise rests.

It is a run without a listener: the face rises, stays and falls on the timeline. Everything after the timeline is as in
a run, so the limits, the way in and the way to rest are the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.app.listen.report import OUTCOME, failure
from sfms_robot.app.options import HeadOptions, RunOptions
from sfms_robot.app.session import Panel, run
from sfms_robot.config import Head, load_head
from sfms_robot.config.base import read
from sfms_robot.data import Report, data_dir
from sfms_robot.errors import ConfigError, TorqueError
from sfms_robot.frames import CHANNEL_INDEX, NEUTRAL, Doubles, Floats, Plan, SpeakerFrame
from sfms_robot.ports import Facts, Observer, Source, Tick
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.runtime.clock import IDLE_FEED
from sfms_robot.runtime.safety import EASE_S
from sfms_robot.signals.minimum_jerk import ease

RISE_S: Final = 0.5
MOVED_DEG: Final = 0.1
_ANGLES: Final = ("roll", "pitch", "yaw")
_TURN: Final = 360.0
_BOUNDS: Final = {"roll": 1.0, "pitch": 1.0, "yaw": 1.6, "x": 0.1, "y": 0.1, "z": 0.1}  # rad and m, either way


@cache
def expressions() -> Mapping[str, Mapping[str, float]]:
    """Return the channels of the faces of configs/expressions.yaml, by name. Raises ConfigError."""
    faces = read(data_dir("configs") / "expressions.yaml")
    sides = dict.fromkeys(CHANNEL_INDEX, ("",))
    return {
        face: {f"{name}{side}": value for name, value in given.items() for side in sides.get(name, ("Left", "Right"))}
        for face, given in faces.items()
    }


def parse_face(words: Sequence[str]) -> Floats:
    """Return motion (58,) of expressions and CHANNEL=VALUE; later words replace earlier ones. Raises ConfigError."""
    motion = NEUTRAL.copy()
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            if name not in expressions():
                choices = [*expressions(), "CHANNEL=VALUE"]
                raise ConfigError.at("head pose", "EXPRESSION", word, "is not an expression", choices)
            for channel, value in expressions()[name].items():
                motion[CHANNEL_INDEX[channel]] = value
            continue
        if name not in CHANNEL_INDEX:
            raise ConfigError.at("head pose", "CHANNEL", name, "is not a channel", CHANNEL_INDEX)
        high = _BOUNDS.get(name, 1.0)
        low = -high if name in _BOUNDS else 0.0
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            unit = "rad" if name in _ANGLES else "m" if name in _BOUNDS else ""
            meant = (
                f"; {value:g} deg is {name}={math.radians(value):.3g}" if unit == "rad" and abs(value) < _TURN else ""
            )
            problem = f"is not a number in its range{f', in {unit}' if unit else ''}{meant}"
            raise ConfigError.at("head pose", name, text, problem, [f"{low:g}..{high:g}"])
        motion[CHANNEL_INDEX[name]] = value
    return motion


def pose_head(options: HeadOptions, words: Sequence[str], hold_s: float, panel: Panel | None = None) -> Report:
    """Rise to the face of `words`, hold it, return to rest. Report how far each joint went, and unconfirmed torque.

    Blocks until then. Raises any other RobotError, with the head at rest.
    """
    face, head = parse_face(words), load_head(options.head)
    furthest = Furthest(head)
    report = held_face(face, hold_s).play(options, panel, observers=[furthest])
    error = failure(report)
    if error is not None and str(error) != str(TorqueError(report["torque_unconfirmed"])):
        raise error
    blind = HeadRetargeter(head).blind_channels
    return {
        **{key: report[key] for key in OUTCOME},
        "face": list(words),
        "joints": furthest.moved(),
        "blind": [name for name, index in CHANNEL_INDEX.items() if face[index] and name in blind],
    }


class FaceTrack:
    """A `Timeline` through motion (K, 58) at rising times (K,), which ignores plans.

    Between two times it is linear, or a smooth step; before the first and after the last time it is constant.
    """

    def __init__(self, times_s: Doubles, motion: Floats, *, smooth: bool = False) -> None:
        self.duration_s = float(times_s[-1])
        if len(times_s) == 1:
            times_s, motion = times_s + np.arange(2.0), np.repeat(motion, 2, axis=0)
        self._times_s, self._motion, self._smooth = times_s, motion, smooth

    def play(
        self,
        options: HeadOptions,
        panel: Panel | None = None,
        *,
        listener: str = "none",
        record: Path | None = None,
        observers: Sequence[Observer] = (),
    ) -> Report:
        """Run once with this track instead of a person and a listener; return the report. `listener`: its name."""
        alone = NobodyThere()
        chosen = RunOptions(
            **vars(options), listener=listener, duration_s=self.duration_s, record=record, overwrite=True
        )
        return run(chosen, panel, source=alone, feed=alone, timeline=self, observers=observers)

    def start(self) -> None:
        return None

    def accept(self, plan: Plan, state: None) -> None:
        return None

    def lead_limit_s(self, state: None) -> float:
        return float("inf")

    def sample(self, times_s: Doubles, now_s: float, state: None) -> tuple[Floats, None]:
        """Return motion (N, 58) at each of (N,) instants."""
        times_s = np.clip(times_s, self._times_s[0], self._times_s[-1])
        after = np.clip(np.searchsorted(self._times_s, times_s), 1, len(self._times_s) - 1)
        begins, ends = self._times_s[after - 1], self._times_s[after]
        share = (times_s - begins) / (ends - begins)
        share = (ease(share) if self._smooth else share)[:, None]
        return ((1 - share) * self._motion[after - 1] + share * self._motion[after]).astype(np.float32), None


def held_face(face: Floats, hold_s: float) -> FaceTrack:
    """Return a track of one face (58,): torque comes on and settles, the face rises, stays for `hold_s`, and falls."""
    neutral = np.zeros_like(face)
    times_s = np.cumsum([0.0, EASE_S, RISE_S, hold_s, RISE_S])
    return FaceTrack(times_s, np.stack([neutral, neutral, face, face, neutral]), smooth=True)


class NobodyThere(Source):
    """An empty source and an empty feed: no person, no listener."""

    lost = False

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        return ()

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        """Drop the frame."""

    def poll(self, now_s: float) -> Sequence[Plan]:
        return ()

    def statistics(self) -> Facts:
        return IDLE_FEED


class Furthest(Observer):
    """An observer of how far from rest each joint was sent after the face began to rise, and how far it went."""

    def __init__(self, head: Head) -> None:
        self._joints = tuple(head.joints)
        self._rest_rad = head.rest_rad
        self._sent, self._reached = np.zeros(len(self._joints)), np.full(len(self._joints), np.nan)

    def tick(self, seen: Tick) -> None:
        if seen.time_s < EASE_S:
            return
        places = [each and each.position_rad for each in map(seen.readings.get, self._joints)]
        self._sent = _further(self._sent, seen.goals_rad - self._rest_rad)
        self._reached = _further(self._reached, np.array(places, np.float64) - self._rest_rad)  # None becomes NaN

    def moved(self) -> dict[str, dict[str, float | None]]:
        """Return the joints that were sent away from rest, in degrees; None where a servo reports no position."""
        rows = zip(self._joints, np.degrees(self._sent).round(2), np.degrees(self._reached).round(2), strict=True)
        return {
            joint: {"sent_deg": float(sent), "reached_deg": None if np.isnan(reached) else float(reached)}
            for joint, sent, reached in rows
            if abs(sent) >= MOVED_DEG
        }


def _further(furthest: Doubles, now: Doubles) -> Doubles:
    """Return the value that is further from 0, joint by joint; NaN counts as unknown."""
    return np.where((np.abs(now) > np.abs(furthest)) | np.isnan(furthest), now, furthest)
