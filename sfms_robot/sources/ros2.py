"""A person in a graph of ROS 2, without ROS installed: `--audio ros2:TOPIC`, `--face ros2:FACE_ID`.

TOPIC carries `audio_common_msgs/AudioDataStamped`: 16-bit little-endian samples, which have no rate of their own (16
kHz and one channel, or `,rate=48000,channels=2`). A face is `/humans/faces/FACE_ID/facs` (REP 155), or a whole topic,
of `hri_msgs/FacialActionUnits`: intensities of 0 to 1, of units whose confidence is above 0. `,domain=N` is the domain,
else ROS_DOMAIN_ID, else 0. Messages count from their arrival: the clocks of the machines may differ.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from sfms_robot.errors import ConfigError, PacketError
from sfms_robot.frames import FRAME_S, SHAPES, Floats, Sighting
from sfms_robot.network import LOCAL, Ros2Node, Router, ros_domain, ros_topic
from sfms_robot.signals.ros2_messages import ACTION_UNITS, AUDIO, face_of, read_message, wire_name
from sfms_robot.signals.spaces import beyond
from sfms_robot.sources.live_face import LOST_S, UNHEARD_S, LiveFace, parse_face_argument
from sfms_robot.sources.push import PushedVoice

logger = logging.getLogger(__name__)

SILENT_S: Final = 1.0  # a voice that is away for so long is lost: publishers send silence too
_OPTION: Final = re.compile(r",([a-z]+)=([^,=]*)$")
_OPENFACE_FULL: Final = 5.0  # full intensity of trackers that count 0 to 5
_OVERSHOOT: Final = 1.1
_FILES: Final = (b"RIFF", b"ID3", b"OggS", b"fLaC")  # begin sound files
_RATES: Final = {"rate": (16_000, 4_000, 384_000), "channels": (1, 1, 8)}  # value, least, most


def _options(flag: str, argument: str, more: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """Return what stands before the options of `ros2:PLACE,NAME=VALUE`, and these. Raises ConfigError."""
    place, given = argument, {"domain": "", **more}
    while option := _OPTION.search(place):
        if option[1] not in given:
            raise ConfigError(f"{flag}: option {option[1]!r} is not known ({', '.join(given)})")
        place, given[option[1]] = place[: option.start()], option[2]
    return place, given


def _number(flag: str, name: str, text: str) -> int:
    value, least, most = _RATES[name]
    if text and not (text.isascii() and text.isdigit() and least <= int(text[:9]) <= most):
        raise ConfigError(f"{flag}: {name}: expected {least} to {most}, got {text!r}")
    return int(text or value)


class _Heard:
    """Arrivals of one topic: lost or not, and a line where there are none."""

    def __init__(self, flag: str, topic: str, node: Ros2Node, lost_after_s: float) -> None:
        self._flag, self._topic, self._node, self._lost_after_s = flag, topic, node, lost_after_s
        self._counted = 0
        self._heard_s: float | None = None
        self._said = False

    def lost(self, time_s: float) -> bool:
        """Return whether messages came before loop time `time_s`, and have stopped."""
        counted = self._node.counts["received"] - self._node.counts["refused"]
        if counted > self._counted:
            self._counted, self._heard_s = counted, time_s
        if self._heard_s is None and time_s > UNHEARD_S and not self._said:
            self._said = True
            logger.warning("%s: nothing came yet: %s", self._flag, self._node.absence(self._topic))
        return self._heard_s is not None and time_s - self._heard_s > self._lost_after_s


class Ros2Voice(PushedVoice):
    """`ports.Voice` of `--audio ros2:TOPIC[,rate=HZ][,channels=N][,domain=N]`. Raises ConfigError."""

    _way = "--audio ros2"

    def __init__(self, argument: str, router: Router = LOCAL) -> None:
        super().__init__()
        place, given = _options(self._way, argument, {"rate": "", "channels": ""})
        self._sent_hz, self._channels = (_number(self._way, name, given[name]) for name in _RATES)
        topic = ros_topic(place, self._way)
        domain = ros_domain(given["domain"], self._way)
        takes = {topic: wire_name(AUDIO)}
        self._node = Ros2Node("sfms_robot_voice", domain, router, takes=takes, received=self._take_message)
        self._heard = _Heard(self._way, topic, self._node, SILENT_S)

    def take(self, index: int) -> Floats | None:
        self.lost = self._heard.lost((index + 1) * FRAME_S)
        return super().take(index)

    def statistics(self) -> Mapping[str, Any]:
        return {**super().statistics(), **self._node.counts}

    def close(self) -> None:
        self._node.close()

    def _take_message(self, topic: str, wire: str, data: bytes) -> None:
        sound = read_message((AUDIO,), wire, data)["audio"]["data"].tobytes()
        if sound.startswith(_FILES) or len(sound) % (2 * self._channels):
            what = f"{len(sound)} bytes" if len(sound) % (2 * self._channels) else "a sound file"
            raise PacketError(f"data: expected 16-bit samples of {self._channels} channels (format wave), got {what}")
        samples = np.frombuffer(sound, "<i2").reshape(-1, self._channels)
        self.hear(samples if self._channels > 1 else samples[:, 0], self._sent_hz)


class Ros2Sight(LiveFace):
    """`ports.Sight` of `--face ros2:FACE_ID|TOPIC[,domain=N][,flip=...]`. Raises ConfigError."""

    _way = "--face ros2"

    def __init__(self, argument: str, router: Router = LOCAL) -> None:
        place, given = _options(self._way, argument, {"flip": ""})
        super().__init__(parse_face_argument("ros2", f",flip={given['flip']}" if given["flip"] else "")[1])
        self._full = 1.0
        topic = ros_topic(place if "/" in place else f"/humans/faces/{place}/facs", self._way)
        domain = ros_domain(given["domain"], self._way)
        takes = {topic: wire_name(ACTION_UNITS)}
        self._node = Ros2Node("sfms_robot_face", domain, router, takes=takes, received=self._take_message)
        self._heard = _Heard(self._way, topic, self._node, LOST_S)

    def at(self, time_s: float) -> Sighting | None:
        self.lost = self._heard.lost(time_s)
        return super().at(time_s)

    def statistics(self) -> Mapping[str, Any]:
        """Return the node's counts of messages."""
        return dict(self._node.counts)

    def close(self) -> None:
        self._node.close()

    def _take_message(self, topic: str, wire: str, data: bytes) -> None:
        units = read_message((ACTION_UNITS,), wire, data)
        peak = np.max(units["intensity"], where=units["confidence"] > 0, initial=0.0)
        if self._full == 1.0 and _OVERSHOOT < peak <= _OPENFACE_FULL:
            self._full = _OPENFACE_FULL
            logger.warning("%s: intensities of %s are taken as 0 to %g", self._way, topic, self._full)
        motion = face_of({**units, "intensity": units["intensity"] / np.float32(self._full)})
        if (problem := beyond(motion)) is not None:
            raise PacketError(problem)
        motion[SHAPES] = np.clip(motion[SHAPES], 0.0, 1.0)
        self.put(self._now(), motion)
