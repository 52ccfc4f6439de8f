"""A visitor of the page in place of microphone and camera: `--audio browser`, `--face browser`.

One visitor at a time, whom the page names: who comes after has another clock, and another face at rest. While one who
brought a voice, or a face, is away, it is lost.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sfms_robot.errors import ConfigError, PacketError
from sfms_robot.frames import POSE_CHANNELS, Floats, Sighting
from sfms_robot.sources.live_face import LiveFace
from sfms_robot.sources.net_intake import Intake, SenderClock
from sfms_robot.sources.net_messages import VOICE, Seen, Sound, parse_message
from sfms_robot.sources.push import PushedVoice


class Visitor:
    """Who is in front of the page. All methods from any thread; none blocks.

    Attributes:
        voice, sight: the person, as sources.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.voice = BrowserVoice(self, now)
        self.sight = BrowserSight(self, now)
        self._now = now
        self._lock = threading.Lock()
        self._number: int | None = None
        self._feeds: frozenset[str] = frozenset()
        self._clock, self._intake = SenderClock(), Intake(now)

    def came(self, number: int, feeds: Sequence[str]) -> None:
        """Visitor `number` is the person from now on, and brings `feeds` of voice and face; none: nobody does."""
        with self._lock:
            if number != self._number:
                self._clock = SenderClock()
                self.sight.forget()
            self._number, before, self._feeds = number, self._feeds, frozenset(feeds)
            self._lose(before - self._feeds)
            self.voice.lost = self.voice.lost and "voice" not in feeds
            self.sight.lost = self.sight.lost and "face" not in feeds

    def gone(self, number: int) -> None:
        """Visitor `number` has gone, or has the controls no more."""
        with self._lock:
            if number == self._number:
                before, self._number, self._feeds = self._feeds, None, frozenset()
                self._lose(before)

    def received(self, number: int, data: bytes) -> None:
        """A message of `net_messages`. Raises PacketError for what is none, or was not announced."""
        with self._lock:
            message = parse_message(data)
            if not isinstance(message, (Sound, Seen)) or (isinstance(message, Sound) and message.kind != VOICE):
                raise PacketError("of a visitor only voice and face are taken")
            name = "voice" if isinstance(message, Sound) else "face"
            if number != self._number or name not in self._feeds:
                raise PacketError(f"{name} was not announced by `source`")
            if isinstance(message, Sound):
                self._intake.hear(self.voice, message, self._clock)
            else:
                self._intake.see(self.sight, message, self._clock)

    def statistics(self) -> Mapping[str, Any]:
        """Messages that came too late, and sound that came faster than time passes."""
        return dict(self._intake.counts)

    def _lose(self, feeds: frozenset[str]) -> None:
        if "voice" in feeds:
            self.voice.lost = True
            self.voice.interrupt()
        if "face" in feeds:
            self.sight.lost = True


class BrowserVoice(PushedVoice):
    """`ports.Voice` of a visitor."""

    def __init__(self, visitor: Visitor, now: Callable[[], float]) -> None:
        super().__init__(now)
        self._visitor = visitor

    def statistics(self) -> Mapping[str, Any]:
        return {**super().statistics(), **self._visitor.statistics()}


class BrowserSight:
    """`ports.Sight` of a visitor. Their rest is learned while they are seen, as a webcam's person's is."""

    lost = False
    duration_s: float | None = None
    latency_s = 0.0

    def __init__(self, visitor: Visitor, now: Callable[[], float]) -> None:
        self._visitor, self._now = visitor, now
        self._lock = threading.Lock()
        self._face = LiveFace(np.ones(len(POSE_CHANNELS), np.float32))

    def see(self, face: Floats | None, seen_s: float | None = None, attention: float | None = None) -> None:
        """Their face (58,) at `seen_s` of `time.monotonic`, None: now; without one the last grows old and is lost.

        Their attention is judged here, by head and eyes.
        """
        if face is not None:
            with self._lock:
                self._face.put(self._now() if seen_s is None else seen_s, face)

    def forget(self) -> None:
        """Another person."""
        with self._lock:
            self._face.forget()

    def start(self, origin_s: float) -> None:
        with self._lock:
            self._face.start(origin_s)

    def at(self, time_s: float) -> Sighting | None:
        with self._lock:
            return self._face.at(time_s)

    def statistics(self) -> Mapping[str, Any]:
        return self._visitor.statistics()

    def close(self) -> None:
        """Nothing is held open."""


def open_browser_voice(argument: str, visitor: Visitor | None = None) -> BrowserVoice:
    """`--audio browser`. Raises ConfigError where no page is served, and for an argument: it takes none."""
    return _of_page("--audio", argument, visitor).voice


def open_browser_sight(argument: str, visitor: Visitor | None = None) -> BrowserSight:
    """`--face browser`, as `open_browser_voice`."""
    return _of_page("--face", argument, visitor).sight


def _of_page(flag: str, argument: str, visitor: Visitor | None) -> Visitor:
    if argument:
        raise ConfigError(f"{flag} browser:{argument}: takes nothing behind the colon ({flag} browser)")
    if visitor is None:
        raise ConfigError(f"{flag} browser: there is no page (sfms-robot run --view serves one)")
    return visitor
