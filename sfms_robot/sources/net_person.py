"""Programs and visitors of the page in place of microphone, camera and loudspeaker.

`--audio push`, `--face push`, `--agent-audio tcp` (`NetPerson`): one server for all flags that name the same address.
`--audio browser`, `--face browser` (`PageVisitor`): the visitor with the controls of the page. What they hand over goes
through the sources of calls (`push`), with the sender's times in our clock; a program also receives what the run hears
and does where it asks for that.

1. One program feeds each of voice, face and speech. Another is refused by name until the first has gone; one that has
   sent no voice, or no face, for `SILENT_S` loses its place to a program that asks for it.
2. Beyond loopback a hello needs the token, which is new and printed at every start.
3. One visitor is the person at a time: the next one has another clock, and another face at rest.
4. While a program or visitor that brought a voice, or a face, is away, it counts as lost.
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

OLDEST_S: Final = 1.0  # of a voice or a face that is still of use
_OLD: Final = f"its time (`at`) is more than {OLDEST_S:g} s ago, by the sender's clock"
_SPARE_S: Final = 2.0  # of sound, that may arrive faster than time passes

_open: dict[tuple[str, int], NetPerson] = {}
_opening: Final = threading.Lock()


class Intake:
    """Voice and face of one person, judged by their age and pace.

    Attributes:
        counts: messages that came too late, and sound that came faster than time passes.
    """

    def __init__(self, now: Clock) -> None:
        self.counts = dict.fromkeys(("old", "too_fast"), 0)
        self._now = now
        self._spare_s = _SPARE_S
        self._spared_s = now()

    def hear(self, voice: PushedVoice, message: SoundMessage, clock: SenderClock) -> str | None:
        """Hand on the next piece of their voice; return why it was left out, or what is wrong. Never blocks."""
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
        """Hand on their face now, or that it is lost; return why it was left out. Never blocks."""
        _, at_s, old = self._times(message, clock)
        if old:
            return f"face left out: {_OLD}"
        sight.see(message.motion, at_s, message.attention)
        return None

    def at_s(self, message: SoundMessage | SeenMessage, clock: SenderClock) -> float | None:
        """Return the time of a message in our clock; None: as it arrives."""
        if not message.at_s:
            return None
        clock.observe(message.sent_s, self._now())
        return message.at_s + clock.offset_s

    def _times(self, message: SoundMessage | SeenMessage, clock: SenderClock) -> tuple[float, float | None, bool]:
        """Return now, the time of a message, at most now, and whether it is too old."""
        now_s, at_s = self._now(), self.at_s(message, clock)
        old = at_s is not None and at_s < now_s - OLDEST_S
        self.counts["old"] += old
        return now_s, None if at_s is None else min(at_s, now_s), old


class NetPerson(NetServer):
    """The programs beside a run: which of them feeds what, and which are sent what.

    Attributes:
        now: `time.monotonic`, or a test's.
        token: needed in a hello; None: not needed.
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
        """Give `part` what programs feed as its `feed`. Raises PortError when another one takes it already."""
        if part.feed in self._feeds:
            raise PortError(f"{FLAGS[part.feed]}: port {self.address[1]} is used by another run of this program")
        self._feeds[part.feed] = part

    def leave(self, part: _NetPart) -> None:
        """Take a part away; the last one closes the server. Blocks until it is closed."""
        with _opening:
            self._feeds.pop(part.feed, None)
            if not self._feeds:
                _open.pop(self._place, None)
                self.close()

    def begin(self, origin_s: float) -> None:
        """Set loop time 0 to `origin_s` of `time.monotonic`. From now on programs are answered."""
        self._origin_s = origin_s
        self.start()

    def hears(self, audio: Floats, time_s: float) -> None:
        """Send what the run hears, (640,), whose newest sample is of loop time `time_s`. Never blocks."""
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
        """Return the server's counts, sound and faces that were too late or too fast, and which program feeds what."""
        feeders = {name: part.feeder for name, part in self._feeds.copy().items()}
        named = {name: feeder.name for name, feeder in feeders.items() if feeder is not None}
        return {**self.counts, **self._intake.counts, "feeders": named}

    # --- from programs, in the server's thread ---

    def received(self, connection: NetProgram, message: Message) -> None:
        """Hand a message to the part that it feeds. Raises PacketError for one that was not announced."""
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
        """Free the places of a program that has gone."""
        for name, part in self._feeds.copy().items():
            if part.feeder is connection:
                part.feeder, part.lost = None, name != "speech"  # a program with nothing to say is no loss
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
            raise PacketError(f"this run takes no {name} from programs ({FLAGS[name]})")
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
    """A part of a person that another program feeds: it joins the server, which runs from its start to its close.

    argument: [HOST:]PORT, "" for the usual one; raises ConfigError, PortError. Or a server that runs already.

    Attributes:
        feeder: the program that feeds it; None: none does.
        heard_s: when that sent something last, of `time.monotonic`.
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
    """`ports.Voice` of a person whose sound another program has: `--audio push[:[HOST:]PORT]`."""

    feed = "voice"
    _way = FLAGS["voice"]


class NetSight(_NetPart, PushedSight):
    """`ports.Sight` of a person that another program sees: `--face push[:[HOST:]PORT]`."""

    feed = "face"


class NetSpeech(_NetPart, PushedSpeech):
    """`ports.Voice` of a robot for which another program speaks: `--agent-audio tcp[:[HOST:]PORT]`."""

    feed = "speech"


def _person(flag: str, argument: str) -> NetPerson:
    """Return the person of an address, whose server runs from then on."""
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
    """The person in front of the page. All methods from any thread; none blocks.

    Attributes:
        voice, sight: the person, as sources.
    """

    def __init__(self, now: Clock = time.monotonic) -> None:
        self.now = now
        self.voice, self.sight = BrowserVoice(self), BrowserSight(self)
        self._lock = threading.Lock()
        self._number: int | None = None
        self._feeds = frozenset[str]()
        self._clock, self._intake = SenderClock(), Intake(now)

    def came(self, number: int, feeds: Sequence[str]) -> None:
        """Make visitor `number` the person, who brings `feeds` of voice and face, or none."""
        with self._lock:
            if number != self._number:
                self._clock = SenderClock()
                self.sight.forget()
            self._set(number, frozenset(feeds))

    def gone(self, number: int) -> None:
        """Note that visitor `number` has gone, or has lost the controls."""
        with self._lock:
            if number == self._number:
                self._set(None, frozenset())

    def received(self, number: int, data: bytes) -> None:
        """Take a message of `net_messages`. Raises PacketError for any other, and for one that was not announced."""
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
        """Return counts of messages that came too late, and of sound that came faster than time passes."""
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
    """`ports.Sight` of a visitor. Their rest is learned while they are seen, as that of a person at a webcam."""

    def __init__(self, visitor: PageVisitor) -> None:
        super().__init__(now=visitor.now)
        self._visitor = visitor

    def see(self, face: Floats | None, seen_s: float | None = None, attention: float | None = None) -> None:
        """Take their face (58,) at `seen_s` of `time.monotonic`, None: now; without one the last grows old and is lost.

        Their attention is judged here, by head and eyes.
        """
        if face is not None:
            self.put(self._now() if seen_s is None else seen_s, face)

    def statistics(self) -> Facts:
        return self._visitor.statistics()


def open_browser_voice(argument: str, visitor: PageVisitor | None = None) -> BrowserVoice:
    """Open `--audio browser`. Raises ConfigError where no page is served, and for an argument: it takes none."""
    return _of_page("--audio", argument, visitor).voice


def open_browser_sight(argument: str, visitor: PageVisitor | None = None) -> BrowserSight:
    """Open `--face browser`, as `open_browser_voice`."""
    return _of_page("--face", argument, visitor).sight


def _of_page(flag: str, argument: str, visitor: PageVisitor | None) -> PageVisitor:
    if argument:
        raise ConfigError(f"{flag} browser:{argument}: takes nothing behind the colon ({flag} browser)")
    if visitor is None:
        raise ConfigError(f"{flag} browser: there is no page (sfms-robot run --view serves one)")
    return visitor
