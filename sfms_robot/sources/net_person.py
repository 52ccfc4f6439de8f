"""Other programs in place of microphone, camera and loudspeaker: `--audio push`, `--face push`, `--agent-audio tcp`.

One server for all flags that name the same address. What programs hand over goes through the sources of calls
(`push`), with the sender's times in our clock; what the run hears and does is told to those who ask for it.

1. One program feeds each of voice, face and speech. Another is refused by name until the first has gone; one that has
   sent no voice, or no face, for `SILENT_S` loses its place to whoever asks for it.
2. Beyond loopback whoever says hello needs the token, which is made anew and printed at every start.
"""

from __future__ import annotations

import ipaddress
import logging
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final, cast

import numpy as np

from sfms_robot.endpoint import LOOPBACK, host_and_port
from sfms_robot.errors import ConfigError, PacketError, PortError
from sfms_robot.frames import AUDIO_HZ, Floats
from sfms_robot.origin import token_admits
from sfms_robot.sources.net_intake import Intake, SenderClock
from sfms_robot.sources.net_messages import (
    FEEDS,
    MICROPHONE,
    VERSION,
    Hello,
    Hush,
    Message,
    Seen,
    Sound,
    json_message,
    sound_message,
)
from sfms_robot.sources.net_server import Connection, NetServer
from sfms_robot.sources.push import PushedSight, PushedSpeech, PushedVoice

logger = logging.getLogger(__name__)

PORT: Final = 8765
SILENT_S: Final = 2.0
FLAGS: Final = {"voice": "--audio push", "face": "--face push", "speech": "--agent-audio tcp"}

_open: dict[tuple[str, int], NetPerson] = {}
_opening: Final = threading.Lock()


class NetPerson:
    """The server's handler: who feeds what, and who wants to be told what.

    Attributes:
        now: `time.monotonic`, or a test's.
        token: what a hello has to hold; None: nothing.
    """

    def __init__(self, flag: str, host: str, port: int, now: Callable[[], float] = time.monotonic) -> None:
        self.now = now
        self._place = (host, port)
        self._feeds: dict[str, NetVoice | NetSight | NetSpeech] = {}
        self._feeders: dict[str, Connection] = {}
        self._clocks: dict[Connection, SenderClock] = {}
        self._heard_s: dict[str, float] = {}
        self._origin_s = 0.0
        self._state: Mapping[str, Any] | None = None
        self._intake = Intake(now)
        self._server = NetServer(flag, host, port, self)
        bound = self._server.address
        self.token = None if ipaddress.ip_address(bound[0]).is_loopback else secrets.token_urlsafe(12)
        at = f"[{bound[0]}]:{bound[1]}" if ":" in bound[0] else f"{bound[0]}:{bound[1]}"
        logger.warning(
            "%s: tcp://%s and ws://%s%s", flag, at, at, "" if self.token is None else f", token {self.token}"
        )

    @property
    def address(self) -> tuple[str, int]:
        """Host and port that are bound."""
        return self._server.address

    # --- what a run opens and tells; from its threads ---

    def join(self, name: str, part: NetVoice | NetSight | NetSpeech) -> None:
        """`part` takes what programs feed as `name`. Raises PortError when another one does already."""
        if name in self._feeds:
            raise PortError(f"{FLAGS[name]}: port {self.address[1]} is used by another run of this program")
        self._feeds[name] = part

    def leave(self, name: str) -> None:
        """The last one closes the server. Blocks until it is."""
        with _opening:
            self._feeds.pop(name, None)
            if not self._feeds:
                _open.pop(self._place, None)
                self._server.close()

    def start(self, origin_s: float) -> None:
        """Loop time 0 is `origin_s` of `time.monotonic`. From now on programs are answered."""
        self._origin_s = origin_s
        self._server.start()

    def hears(self, audio: Floats, time_s: float) -> None:
        """What the run hears, (640,), whose newest sample is of loop time `time_s`. Never blocks."""
        at_s = self._origin_s + time_s
        self._server.post(lambda: self._send_sound(audio, at_s))

    def tells(self, kind: str, time_s: float, **values: Any) -> None:
        """An event, or a state, that begins at loop time `time_s`. Never blocks."""
        told = {"type": kind, "at_s": round(self._origin_s + time_s, 4), **values}
        self._server.post(lambda: self._send_event(told))

    def statistics(self) -> Mapping[str, Any]:
        """What the server counts; sound and faces that came too late, or faster than time passes; who feeds what."""
        feeders = {name: connection.name for name, connection in self._feeders.copy().items()}
        return {**self._server.counts, **self._intake.counts, "feeders": feeders}

    # --- what programs send; in the server's thread ---

    def received(self, connection: Connection, message: Message) -> None:
        """Hand a message to the part that it feeds. Raises PacketError for one that was not announced."""
        if isinstance(message, Hello):
            self._greet(connection, message)
            return
        if not connection.greeted:
            raise PacketError("the first message is no hello")
        name = next(name for name, kind in FEEDS.items() if kind == message.kind)
        if self._feeders.get(name) is not connection:
            raise PacketError(f"{name} was not announced in its hello")
        self._heard_s[name] = self.now()
        clock = self._clocks[connection]
        match self._feeds[name], message:
            case NetSpeech() as speech, Hush():
                speech.hush()
            case NetSpeech() as speech, Sound() as sound:
                speech.say(sound.samples, sound.rate_hz, self._intake.times(sound, clock)[1])
            case NetSight() as sight, Seen() as seen:
                self._intake.see(sight, seen, clock)
            case NetVoice() as voice, Sound() as sound:
                self._intake.hear(voice, sound, clock)

    def gone(self, connection: Connection) -> None:
        self._clocks.pop(connection, None)
        for name in [each for each, feeder in self._feeders.items() if feeder is connection]:
            del self._feeders[name]
            logger.info("%s: %s has gone", FLAGS[name], connection.name)
            part = self._feeds.get(name)
            if part is not None and name != "speech":  # who has nothing to say is no loss
                part.lost = True
            if isinstance(part, NetSight):
                part.see(None)

    def _greet(self, connection: Connection, hello: Hello) -> None:
        if connection.greeted:
            raise PacketError("a second hello")
        if not token_admits(hello.token, self.token):
            raise PacketError("the token is not the one that the robot printed when it started")
        if hello.name:
            connection.name = f"{hello.name} ({connection.name})"
        for name in sorted(hello.feeds):
            self._claim(connection, name)
        for name in hello.feeds:
            self._feeders[name], self._heard_s[name] = connection, self.now()
            self._feeds[name].lost = False
            logger.info("%s: %s", FLAGS[name], connection.name)
        self._clocks[connection] = SenderClock()
        connection.greeted, connection.wants = True, hello.wants
        connection.send(json_message(type="welcome", version=VERSION, sent_s=self.now(), takes=sorted(self._feeds)))
        if self._state is not None and "events" in hello.wants:
            connection.send(json_message(**self._state, sent_s=self.now()))

    def _claim(self, connection: Connection, name: str) -> None:
        if name not in self._feeds:
            raise PacketError(f"this run takes no {name} from programs ({FLAGS[name]})")
        feeder = self._feeders.get(name)
        if feeder is None:
            return
        if name == "speech" or self.now() - self._heard_s[name] < SILENT_S:
            raise PacketError(f"{name} comes from {feeder.name} already")
        del self._feeders[name]
        feeder.end(f"{name} now comes from {connection.name}: none came for {SILENT_S:g} s")

    def _send_sound(self, audio: Floats, at_s: float) -> None:
        wanting = [each for each in self._server.connections() if "microphone" in each.wants]
        if wanting:
            samples = np.rint(np.clip(audio, -1.0, 1.0) * 32767).astype(np.int16)
            message = sound_message(MICROPHONE, AUDIO_HZ, self.now(), at_s, samples)
            for connection in wanting:
                connection.send(message)

    def _send_event(self, told: Mapping[str, Any]) -> None:
        if told["type"] == "state":
            self._state = told
        for connection in self._server.connections():
            if "events" in connection.wants:
                connection.send(json_message(**told, sent_s=round(self.now(), 4)))


class _NetPart:
    """Of what another program feeds: it joins the server, which runs from its start to its close."""

    feed: ClassVar[str]

    def __init__(self, outlet: NetPerson) -> None:
        super().__init__(outlet.now)  # type: ignore[call-arg]
        self.outlet = outlet
        outlet.join(self.feed, cast(Any, self))

    def start(self, origin_s: float) -> None:
        self.outlet.start(origin_s)
        super().start(origin_s)  # type: ignore[misc]

    def statistics(self) -> Mapping[str, Any]:
        return {**super().statistics(), "net": self.outlet.statistics()}  # type: ignore[misc]

    def close(self) -> None:
        self.outlet.leave(self.feed)


class NetVoice(_NetPart, PushedVoice):
    """`ports.Voice` of a person whose sound another program has."""

    feed = "voice"


class NetSight(_NetPart, PushedSight):
    """`ports.Sight` of a person whom another program sees."""

    feed = "face"


class NetSpeech(_NetPart, PushedSpeech):
    """`ports.Voice` of a robot for which another program speaks."""

    feed = "speech"


def open_net_voice(argument: str) -> NetVoice:
    """`--audio push[:[HOST:]PORT]`. Raises ConfigError, PortError."""
    return NetVoice(_person("--audio push", argument))


def open_net_sight(argument: str) -> NetSight:
    """`--face push[:[HOST:]PORT]`. Raises ConfigError, PortError."""
    return NetSight(_person("--face push", argument))


def open_net_speech(argument: str) -> NetSpeech:
    """`--agent-audio tcp[:[HOST:]PORT]`. Raises ConfigError, PortError."""
    return NetSpeech(_person("--agent-audio tcp", argument))


def _person(flag: str, argument: str) -> NetPerson:
    """The one of that address; its server runs from then on."""
    place = _parsed(flag, argument)
    with _opening:
        if place not in _open:
            _open[place] = NetPerson(flag, *place)
        return _open[place]


def _parsed(flag: str, argument: str) -> tuple[str, int]:
    if not argument:
        return LOOPBACK, PORT
    place = host_and_port(argument)
    if place is None:
        raise ConfigError(
            f"{flag}:{argument}: {argument!r} is no TCP port ({flag}, {flag}:PORT, {flag}:HOST:PORT; 0 for a free one)"
        )
    return place
