"""Programs and visitors of the page that replace microphone, camera and loudspeaker.

`--audio push`, `--face push`, `--agent-audio tcp` (`NetPerson`): one server for all flags that name the same address.
`--audio browser`, `--face browser` (`PageVisitor`): the visitor with the controls of the page. Their sound and faces go
through the sources of `push`, with the sender's times converted to our clock. A program also receives the run's sound
and events if it requests them.

1. One program feeds each of voice, face and speech. Another is refused, with the name of the first, until the first
   has disconnected. One that has sent no voice, or no face, for `SILENT_S` loses its place to a program that needs it.
2. Beyond loopback a hello needs the token, which is new and printed at every start.
3. One visitor is the person at a time: the next one has another clock and another resting face.
4. While a program or visitor that fed a voice or a face is away, that voice or face counts as lost.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np

from sfms_robot.endpoint import LOOPBACK, address_text, host_and_port, is_loopback, token_admits
from sfms_robot.errors import ConfigError, PacketError, PortError
from sfms_robot.frames import AUDIO_HZ, Floats
from sfms_robot.ports import Facts
from sfms_robot.sources.live_face import LiveFace
from sfms_robot.sources.live_voice import Clock, SourcePart
from sfms_robot.sources.net_messages import (
    MICROPHONE,
    VERSION,
    Hello,
    Hush,
    Message,
    SeenMessage,
    SenderClock,
    SoundMessage,
    json_message,
    parse_message,
    sound_message,
)
from sfms_robot.sources.net_server import NetProgram, NetServer
from sfms_robot.sources.push import PushedSight, PushedSpeech, PushedVoice

logger = logging.getLogger(__name__)

PORT: Final = 8765
SILENT_S: Final = 2.0
FLAGS: Final = {"voice": "--audio push", "face": "--face push", "speech": "--agent-audio tcp"}

OLDEST_S: Final = 1.0  # greatest age of a voice or a face that is still used
_OLD: Final = f"its time (`at`) is more than {OLDEST_S:g} s ago, by the sender's clock"
_SPARE_S: Final = 2.0  # seconds of sound that may arrive faster than real time

_open: dict[tuple[str, int], NetPerson] = {}
_opening: Final = threading.Lock()


class Intake:
    """Filter of one person's voice and face by age and pace.

    Attributes:
        counts: messages that were too old, and pieces of sound that came faster than real time.
    """

    def __init__(self, now: Clock) -> None:
        self.counts = dict.fromkeys(("old", "too_fast"), 0)
        self._now = now
        self._spare_s = _SPARE_S
        self._spared_s = now()

    def hear(self, voice: PushedVoice, message: SoundMessage, clock: SenderClock) -> str | None:
        """Pass on the next piece of the voice; return why it was left out, or a fault of its pace. Never blocks."""
        now_s, at_s, old = self._times(message, clock)
        if old:
            return f"voice left out: {_OLD}"
        piece_s = len(message.samples) / message.rate_hz
        self._spare_s = min(_SPARE_S, self._spare_s + (now_s - self._spared_s))
        self._spared_s = now_s
        if piece_s > self._spare_s:
            self.counts["too_fast"] += 1
            return f"voice left out: {piece_s:.2g} s came faster than time passes; send it as it is recorded"
        self._spare_s -= piece_s
        voice.hear(message.samples, message.rate_hz, at_s)
        return voice.pace.problem

    def see(self, sight: PushedSight | BrowserSight, message: SeenMessage, clock: SenderClock) -> str | None:
        """Pass on the person's face, or that it is lost; return why it was left out, or None. Never blocks."""
        _, at_s, old = self._times(message, clock)
        if old:
            return f"face left out: {_OLD}"
        sight.see(message.motion, at_s, message.attention)
        return None

    def at_s(self, message: SoundMessage | SeenMessage, clock: SenderClock) -> float | None:
        """Return the time of a message in our clock; None: its time is that of its arrival."""
        if not message.at_s:
            return None
        clock.observe(message.sent_s, self._now())
        return message.at_s + clock.offset_s

    def _times(self, message: SoundMessage | SeenMessage, clock: SenderClock) -> tuple[float, float | None, bool]:
        """Return the present time, the time of a message limited to it, and whether the message is too old."""
        now_s, at_s = self._now(), self.at_s(message, clock)
        old = at_s is not None and at_s < now_s - OLDEST_S
        self.counts["old"] += old
        return now_s, None if at_s is None else min(at_s, now_s), old


class NetPerson(NetServer):
    """The server for programs that feed a run or receive its sound and events.

    Attributes:
        now: `time.monotonic`, or the clock of a test.
        token: token that a hello needs; None: it needs none.
    """

    def __init__(self, flag: str, host: str, port: int, now: Clock = time.monotonic) -> None:
        super().__init__(flag, host, port)
        self.now = now
        self._place = (host, port)
        self._feeds: dict[str, _NetPart] = {}
        self._origin_s = 0.0
        self._state: Facts | None = None
        self._intake = Intake(now)
        self.token = None if is_loopback(self.address[0]) else secrets.token_urlsafe(12)
        at = address_text(*self.address)
        logger.warning(
            "%s: tcp://%s and ws://%s%s", flag, at, at, "" if self.token is None else f", token {self.token}"
        )

    # --- from the run, in its threads ---

    def join(self, part: _NetPart) -> None:
        """Pass to `part` what programs send as its `feed`. Raises PortError if another part has that feed already."""
        if part.feed in self._feeds:
            raise PortError(f"{FLAGS[part.feed]}: port {self.address[1]} is used by another run of this program")
        self._feeds[part.feed] = part

    def leave(self, part: _NetPart) -> None:
        """Remove a part; removing the last one closes the server and blocks until it is closed."""
        with _opening:
            self._feeds.pop(part.feed, None)
            if not self._feeds:
                _open.pop(self._place, None)
                self.close()

    def begin(self, origin_s: float) -> None:
        """Set loop time 0 to `origin_s` of `time.monotonic`, and serve programs from now on."""
        self._origin_s = origin_s
        self.start()

    def hears(self, audio: Floats, time_s: float) -> None:
        """Send the listener's samples (640,), the newest of which is of loop time `time_s`. Never blocks."""
        at_s = self._origin_s + time_s

        def send() -> None:
            if wanting := self._wanting("microphone"):
                samples = np.rint(np.clip(audio, -1.0, 1.0) * 32767).astype(np.int16)
                message = sound_message(MICROPHONE, AUDIO_HZ, self.now(), at_s, samples)
                for connection in wanting:
                    connection.send(message)

        self.post(send)

    def tells(self, kind: str, time_s: float, **values: Any) -> None:
        """Send an event, or a state, that begins at loop time `time_s`. Never blocks."""
        event = {"type": kind, "at_s": round(self._origin_s + time_s, 4), **values}

        def send() -> None:
            if kind == "state":
                self._state = event
            for connection in self._wanting("events"):
                connection.send(json_message(**event, sent_s=round(self.now(), 4)))

        self.post(send)

    def statistics(self) -> Facts:
        """Return the server's counts, counts of sound and faces too old or too fast, and the feeder of each feed."""
        feeders = {name: part.feeder for name, part in self._feeds.copy().items()}
        named = {name: feeder.name for name, feeder in feeders.items() if feeder is not None}
        return {**self.counts, **self._intake.counts, "feeders": named}

    # --- from programs, in the server's thread ---

    def received(self, connection: NetProgram, message: Message) -> None:
        """Pass a message to the part that it feeds. Raises PacketError if its feed was not announced."""
        if isinstance(message, Hello):
            self._greet(connection, message)
            return
        if not connection.greeted:
            raise PacketError("the first message must be a hello")
        part, problem = self._feeds.get(message.feed), None
        if part is None or part.feeder is not connection:
            raise PacketError(f"{message.feed} was not announced in its hello")
        part.heard_s = self.now()
        match part, message:
            case NetSpeech() as speech, Hush():
                speech.hush()
            case NetSpeech() as speech, SoundMessage() as sound:
                speech.say(sound.samples, sound.rate_hz, self._intake.at_s(sound, connection.clock))
            case NetSight() as sight, SeenMessage() as seen:
                problem = self._intake.see(sight, seen, connection.clock)
            case NetVoice() as voice, SoundMessage() as sound:
                problem = self._intake.hear(voice, sound, connection.clock)
        if problem is not None:
            connection.tell_once(problem)

    def gone(self, connection: NetProgram) -> None:
        """Free the places of a program that has disconnected."""
        for name, part in self._feeds.copy().items():
            if part.feeder is connection:
                part.feeder, part.lost = None, name != "speech"  # a missing speech program is not a loss
                logger.info("%s: %s has gone", FLAGS[name], connection.name)
                if isinstance(part, NetSight):
                    part.see(None)

    def _greet(self, connection: NetProgram, hello: Hello) -> None:
        if connection.greeted:
            raise PacketError("a second hello")
        if not token_admits(hello.token, self.token):
            raise PacketError("the token is not the one that the robot printed when it started")
        if hello.name:
            connection.name = f"{hello.name} ({connection.name})"
        for name in sorted(hello.feeds):
            self._claim(connection, name)
        for name in hello.feeds:
            part = self._feeds[name]
            part.feeder, part.heard_s, part.lost = connection, self.now(), False
            logger.info("%s: %s", FLAGS[name], connection.name)
        connection.greeted, connection.wants = True, hello.wants
        connection.send(json_message(type="welcome", version=VERSION, sent_s=self.now(), takes=sorted(self._feeds)))
        if self._state is not None and "events" in hello.wants:
            connection.send(json_message(**self._state, sent_s=self.now()))

    def _claim(self, connection: NetProgram, name: str) -> None:
        part = self._feeds.get(name)
        if part is None:
            raise PacketError(f"this run accepts no {name} from programs ({FLAGS[name]})")
        feeder = part.feeder
        if feeder is None:
            return
        if name == "speech" or self.now() - part.heard_s < SILENT_S:
            raise PacketError(f"{name} comes from {feeder.name} already")
        part.feeder = None
        feeder.end(f"{name} now comes from {connection.name}: none came for {SILENT_S:g} s")

    def _wanting(self, what: str) -> list[NetProgram]:
        return [each for each in self.connections if what in each.wants]


class _NetPart(SourcePart):
    """A part of a person that another program feeds through a server, which runs from its start to its close.

    argument: [HOST:]PORT, "" for the usual port; raises ConfigError, PortError. Or an existing server.

    Attributes:
        feeder: the program that feeds it, or None.
        heard_s: time of `time.monotonic` of the feeder's last message.
    """

    feed: ClassVar[str]
    feeder: NetProgram | None = None
    heard_s = 0.0

    def __init__(self, argument: str | NetPerson) -> None:
        self.outlet = _person(FLAGS[self.feed], argument) if isinstance(argument, str) else argument
        super().__init__(self.outlet.now)
        self.outlet.join(self)

    def start(self, origin_s: float) -> None:
        self.outlet.begin(origin_s)
        super().start(origin_s)

    def statistics(self) -> Facts:
        return {**super().statistics(), "net": self.outlet.statistics()}

    def close(self) -> None:
        self.outlet.leave(self)


class NetVoice(_NetPart, PushedVoice):
    """A `ports.Voice` of a person whose sound another program sends: `--audio push[:[HOST:]PORT]`."""

    feed = "voice"
    _way = FLAGS["voice"]


class NetSight(_NetPart, PushedSight):
    """A `ports.Sight` of a person whose face another program sends: `--face push[:[HOST:]PORT]`."""

    feed = "face"


class NetSpeech(_NetPart, PushedSpeech):
    """A `ports.Voice` of the robot, whose speech another program sends: `--agent-audio tcp[:[HOST:]PORT]`."""

    feed = "speech"


def _person(flag: str, argument: str) -> NetPerson:
    """Return the server of an address; create it, and bind the address, if it does not exist yet."""
    place = host_and_port(argument) if argument else (LOOPBACK, PORT)
    if place is None:
        choices = f"{flag}, {flag}:PORT, {flag}:HOST:PORT; 0 for a free one"
        raise ConfigError(f"{flag}:{argument}: {argument!r}: expected a TCP port (valid: {choices})")
    with _opening:
        if place not in _open:
            _open[place] = NetPerson(flag, *place)
        return _open[place]


# --- visitors of the page -------------------------------------------------------------------------------------------


class PageVisitor:
    """The person in front of the page. All methods may be called from any thread; none blocks.

    Attributes:
        voice, sight: sources of the person's voice and face.
    """

    def __init__(self, now: Clock = time.monotonic) -> None:
        self.now = now
        self.voice, self.sight = BrowserVoice(self), BrowserSight(self)
        self._lock = threading.Lock()
        self._number: int | None = None
        self._feeds = frozenset[str]()
        self._clock, self._intake = SenderClock(), Intake(now)

    def came(self, number: int, feeds: Sequence[str]) -> None:
        """Make visitor `number` the person; `feeds`: which of voice and face the visitor sends, or none."""
        with self._lock:
            if number != self._number:
                self._clock = SenderClock()
                self.sight.forget()
            self._set(number, frozenset(feeds))

    def gone(self, number: int) -> None:
        """Note that visitor `number` has left or has lost the controls."""
        with self._lock:
            if number == self._number:
                self._set(None, frozenset())

    def received(self, number: int, data: bytes) -> None:
        """Process a message of `net_messages`. Raises PacketError for other data, and for a feed not announced."""
        with self._lock:
            message = parse_message(data)
            if isinstance(message, Hello | Hush) or message.feed == "speech":
                raise PacketError("only voice and face are taken from a visitor")
            if number != self._number or message.feed not in self._feeds:
                raise PacketError(f"{message.feed} was not announced by `source`")
            if isinstance(message, SoundMessage):
                self._intake.hear(self.voice, message, self._clock)
            else:
                self._intake.see(self.sight, message, self._clock)

    def statistics(self) -> Facts:
        """Return counts of messages that were too old, and of pieces of sound that came faster than real time."""
        return dict(self._intake.counts)

    def _set(self, number: int | None, feeds: frozenset[str]) -> None:
        if "voice" in self._feeds - feeds:
            self.voice.interrupt()
        for feed, part in (("voice", self.voice), ("face", self.sight)):
            if feed in self._feeds | feeds:
                part.lost = feed not in feeds
        self._number, self._feeds = number, feeds


class BrowserVoice(PushedVoice):
    """`ports.Voice` of a visitor."""

    _way = "--audio browser"

    def __init__(self, visitor: PageVisitor) -> None:
        super().__init__(visitor.now)
        self._visitor = visitor

    def statistics(self) -> Facts:
        return {**super().statistics(), **self._visitor.statistics()}


class BrowserSight(LiveFace):
    """`ports.Sight` of a visitor, whose resting face is learned while it is seen, as with a webcam."""

    def __init__(self, visitor: PageVisitor) -> None:
        super().__init__(now=visitor.now)
        self._visitor = visitor

    def see(self, face: Floats | None, seen_s: float | None = None, attention: float | None = None) -> None:
        """Add the visitor's face (58,) seen at `seen_s` of `time.monotonic`, None: now. A `face` of None is ignored.

        The last face then ages until it is lost. `attention` is not used: it is computed here from head and eyes.
        """
        if face is not None:
            self.put(self._now() if seen_s is None else seen_s, face)

    def statistics(self) -> Facts:
        return self._visitor.statistics()


def open_browser_voice(argument: str, visitor: PageVisitor | None = None) -> BrowserVoice:
    """Open `--audio browser`. Raises ConfigError if no page is served, or for an argument, since it has none."""
    return _of_page("--audio", argument, visitor).voice


def open_browser_sight(argument: str, visitor: PageVisitor | None = None) -> BrowserSight:
    """Open `--face browser`; raises as `open_browser_voice`."""
    return _of_page("--face", argument, visitor).sight


def _of_page(flag: str, argument: str, visitor: PageVisitor | None) -> PageVisitor:
    if argument:
        raise ConfigError(f"{flag} browser:{argument}: expected nothing after the colon ({flag} browser)")
    if visitor is None:
        raise ConfigError(f"{flag} browser: there is no page (sfms-robot run --view serves one)")
    return visitor
