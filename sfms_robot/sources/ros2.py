"""A person's voice and face from topics of ROS 2, without ROS installed: `--audio ros2:TOPIC`, `--face ros2:FACE_ID`.

TOPIC carries `audio_common_msgs/AudioDataStamped`: 16-bit little-endian samples without a rate (16 kHz and one channel,
or `,rate=48000,channels=2`). A face is the topic `/humans/faces/FACE_ID/facs` (REP 155), or a topic given in full, of
`hri_msgs/FacialActionUnits`: intensities of 0 to 1 of the units whose confidence is above 0. The domain is `,domain=N`,
else ROS_DOMAIN_ID, else 0. A message's time is its arrival, because the clocks of the machines may differ.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import ClassVar, Final

import numpy as np

from sfms_robot.endpoint import whole_number
from sfms_robot.errors import ConfigError, PacketError
from sfms_robot.frames import AUDIO_HZ, FRAME_S, Floats, Sighting, clip_shapes
from sfms_robot.network import LOCAL, Ros2Node, Router, ros_domain, ros_topic
from sfms_robot.ports import Facts
from sfms_robot.signals.face_units import beyond
from sfms_robot.signals.ros2_messages import ACTION_UNITS, AUDIO, Message, face_of, read_message, wire_name
from sfms_robot.sources.live_face import LOST_S, UNHEARD_S, LiveFace, pose_signs, split_options
from sfms_robot.sources.live_voice import SourcePart, check_rate
from sfms_robot.sources.push import PushedVoice

logger = logging.getLogger(__name__)

SILENT_S: Final = 1.0  # a voice without messages for this long is lost: publishers send silence too
MOST_CHANNELS: Final = 8
_FILES: Final = (b"RIFF", b"ID3", b"OggS", b"fLaC")  # first bytes of sound files


class _Subscriber(SourcePart):
    """A part that receives the messages of one topic, detects that they stopped, and logs a line if none came."""

    _flag: ClassVar[str]
    _counted = 0
    _heard_s: float | None = None
    _said = False

    def _subscribe(
        self, topic: str, domain: str, router: Router, *, kind: str, take: Callable[[Message], None]
    ) -> None:
        """Call `take` with each message of `topic`. Raises ConfigError."""
        self._topic = ros_topic(topic, self._flag)
        self._node = Ros2Node(
            f"sfms_robot_{self._flag.split()[0].strip('-')}",
            ros_domain(domain, self._flag),
            router,
            takes={self._topic: wire_name(kind)},
            received=lambda _, wire, data: take(read_message(kind, wire, data)),
        )

    def statistics(self) -> Facts:
        """Return the node's counts of messages, and the statistics of the voice or face."""
        return {**super().statistics(), **self._node.counts}

    def close(self) -> None:
        self._node.close()

    def _look(self, time_s: float, after_s: float) -> None:
        """Update `lost`: whether messages came before loop time `time_s` and have stopped for `after_s`."""
        counted = self._node.counts["received"] - self._node.counts["refused"]
        if counted > self._counted:
            self._counted, self._heard_s = counted, time_s
        if self._heard_s is None and time_s > UNHEARD_S and not self._said:
            self._said = True
            logger.warning("%s: nothing came yet: %s", self._flag, self._node.absence(self._topic))
        self.lost = self._heard_s is not None and time_s - self._heard_s > after_s


class Ros2Voice(_Subscriber, PushedVoice):
    """`ports.Voice` of `--audio ros2:TOPIC[,rate=HZ][,channels=N][,domain=N]`. Raises ConfigError."""

    _flag = _way = "--audio ros2"

    def __init__(self, argument: str, router: Router = LOCAL) -> None:
        super().__init__()
        place, options = split_options(self._way, argument, "domain", "rate", "channels")
        given = {"domain": "", "rate": str(AUDIO_HZ), "channels": "1", **dict(options)}
        try:
            self._sent_hz, self._channels = whole_number(given["rate"]), whole_number(given["channels"])
            check_rate(self._sent_hz)
        except ConfigError as error:
            raise ConfigError(f"{self._way}:{argument}: {error}") from None
        if not 0 < self._channels <= MOST_CHANNELS:
            raise ConfigError(f"{self._way}: channels: expected 1 to {MOST_CHANNELS}, got {self._channels}")
        self._subscribe(place, given["domain"], router, kind=AUDIO, take=self._hear)

    def take(self, index: int) -> Floats | None:
        self._look((index + 1) * FRAME_S, SILENT_S)
        return super().take(index)

    def _hear(self, message: Message) -> None:
        sound = message["audio"]["data"].tobytes()
        if len(sound) % (2 * self._channels) or sound.startswith(_FILES):
            what = "a sound file" if sound.startswith(_FILES) else f"{len(sound)} bytes"
            raise PacketError(f"data: expected 16-bit samples of {self._channels} channels (format wave), got {what}")
        samples = np.frombuffer(sound, "<i2").reshape(-1, self._channels)
        self.hear(samples if self._channels > 1 else samples[:, 0], self._sent_hz)


class Ros2Sight(_Subscriber, LiveFace):
    """`ports.Sight` of `--face ros2:FACE_ID|TOPIC[,domain=N][,flip=...]`. Raises ConfigError."""

    _flag = "--face ros2"

    def __init__(self, argument: str, router: Router = LOCAL) -> None:
        place, options = split_options(self._flag, argument, "domain", "flip")
        super().__init__(pose_signs("ros2", options))
        topic = place if "/" in place else f"/humans/faces/{place}/facs"
        self._subscribe(topic, dict(options).get("domain", ""), router, kind=ACTION_UNITS, take=self._see)

    def at(self, time_s: float) -> Sighting | None:
        self._look(time_s, LOST_S)
        return super().at(time_s)

    def _see(self, message: Message) -> None:
        motion = face_of(message)
        if (problem := beyond(motion)) is not None:
            raise PacketError(problem)
        clip_shapes(motion)
        self.put(self._now(), motion)
