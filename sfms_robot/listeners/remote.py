"""A listener on another machine, as the loop sees it: frames go out, plans come back (`ports.PlanFeed`). Opens nothing.

    joining     it asks to be listened for, again and again, for as long as nobody answers
    listening   frames go to the stream that it was given; plans come through a jitter buffer
    hung        frames went out, and nothing has come back for `HUNG_S`; frames go on, and so does the asking
    refused     the server has said why not; asked again after `REFUSED_S`, since another one may stand there by then

A server that was started anew knows no streams of before, says so, and is joined again. Memory of a stream is the
server's: after a new beginning the listener has heard nothing yet. Meanwhile plans run out, the face eases to neutral,
and the head lives on by itself, as with any listener that is lost (docs/safety.md).
"""

from __future__ import annotations

import logging
import math
import secrets
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

from sfms_robot.config.listener import Calmness
from sfms_robot.errors import ConfigError, PacketError
from sfms_robot.frames import FRAME_HZ, ListenerEvent, Plan, SpeakerFrame
from sfms_robot.listeners.jitter_buffer import JitterBuffer
from sfms_robot.listeners.remote_messages import (
    Interface,
    Join,
    Notice,
    Refusal,
    SentFrame,
    Welcome,
    frame_message,
    parse_plan,
    parse_words,
    words_message,
)
from sfms_robot.plugins import REMOTE as PREFIX
from sfms_robot.signals.quantiles import Quantiles

HUNG_S: Final = 1.0
JOIN_S: Final = 0.25  # from one asking to the next
REFUSED_S: Final = 5.0
AWAY_S: Final = 5.0  # of waiting for the first answer; after that the head begins without
_TOLD: Final = 64  # events that are remembered as told
_WAIT_S: Final = 0.01

log = logging.getLogger(__name__)


class Link(Protocol):
    """What carries messages to one server and back. Nothing here blocks."""

    @property
    def where(self) -> str:
        """For people."""

    @property
    def problem(self) -> str | None:
        """Why nothing will ever be carried; None as long as it may."""

    def ask(self, message: bytes) -> None:
        """To whoever serves; every answer is among `received`."""

    def follow(self, stream: str) -> None:
        """From now on messages to this stream are received, and `send` means it."""

    def send(self, message: bytes) -> None:
        """To the stream; may be lost."""

    def received(self) -> Sequence[tuple[float, bytes]]:
        """What came since the last call, each with its age [s], in the order of coming."""

    def close(self) -> None: ...


# --- Clock offset -----------------------------------------------------------------------------------------------------
#
# The clock of a server relative to ours, and the delay of a round trip (as in NTP: RFC 5905, section 8). A message
# leaves at t1 of our clock and arrives at t2 of the server's; its answer leaves at t3 of the server's and arrives at
# t4 of ours:
#
#     offset = ((t2 - t1) + (t3 - t4)) / 2        delay = (t4 - t1) - (t3 - t2)
#
# The offset is wrong by half the difference between the two ways, at most by delay / 2, so the sample with the least
# delay of the last seconds is used. Clocks drift apart, so an old sample is dropped.

WINDOW_S: Final = 10.0
SET_S: Final = 1.0  # an offset so far from the one believed: a clock was set, or the server is another one


@dataclass(frozen=True)
class ClockSample:
    """One exchange, complete at `at_s` of our clock; seconds."""

    at_s: float
    offset_s: float
    delay_s: float


class ClockOffset:
    """Remembers the samples of `WINDOW_S` that could still become the best one."""

    def __init__(self) -> None:
        self._samples: deque[ClockSample] = deque()  # delays rise: the first is the best

    def observe(self, sent_s: float, their_came_s: float, their_sent_s: float, came_s: float) -> None:
        """An exchange: the four times of the section's text, in their order."""
        sample = ClockSample(
            came_s,
            ((their_came_s - sent_s) + (their_sent_s - came_s)) / 2,
            max(0.0, (came_s - sent_s) - (their_sent_s - their_came_s)),
        )
        if self._samples and abs(sample.offset_s - self._samples[0].offset_s) > SET_S + sample.delay_s:
            self._samples.clear()
        while self._samples and self._samples[-1].delay_s >= sample.delay_s:
            self._samples.pop()
        self._samples.append(sample)
        while came_s - self._samples[0].at_s > WINDOW_S:
            self._samples.popleft()

    def forget(self) -> None:
        """Another server."""
        self._samples.clear()

    @property
    def best(self) -> ClockSample | None:
        """The sample that is believed; None before the first."""
        return self._samples[0] if self._samples else None

    def theirs(self, our_s: float) -> float | None:
        """A time of our clock by theirs; None while nothing is known of it."""
        return None if self.best is None else our_s + self.best.offset_s


class RemoteListener:
    """`ports.PlanFeed` over a link.

    Args:
        name: of the served listener.
        seed, calmness: as of `process.ListenerProcess`.
    """

    def __init__(self, name: str, link: Link, seed: int, calmness: Calmness | None = None) -> None:
        self._name, self._link, self._seed, self._calmness = name, link, seed, calmness
        self._client = secrets.token_hex(8)
        self._state = "joining"
        self._welcome: Welcome | None = None
        self._refusal: Refusal | None = None
        self._buffer = JitterBuffer(1, 1)
        self._clock = ClockOffset()
        self._step_ms, self._rtt_ms, self._delay_ms = Quantiles(), Quantiles(), Quantiles()
        self._told: deque[tuple[str, float]] = deque(maxlen=_TOLD)
        self._asked_s = -math.inf
        self._heard_s: float | None = None  # when anything came from the stream, or it began
        self._waiting_since_s: float | None = None  # for an answer to a frame
        self._skipped = self._unsent = self._refused_messages = 0
        self._joins = self._losses = 0
        self._looped = False

    # --- before the loop ---------------------------------------------------------------------------------------------

    def wait_loaded(self, limit_s: float = AWAY_S) -> None:
        """Block until the server has answered, `limit_s` at most: then the head begins without, and one line says so.

        Raises ConfigError where the server refuses for good, or the link can never be.
        """
        end_s = time.monotonic() + limit_s
        while self._welcome is None and time.monotonic() < end_s:
            self._attend(time.monotonic())
            if self._refusal is not None and self._refusal.final:
                raise ConfigError(f"{PREFIX}{self._name}: {self._refusal.reason}")
            if self._link.problem is not None:
                raise ConfigError(f"{PREFIX}{self._name}: {self._link.problem}")
            time.sleep(_WAIT_S)
        if self._welcome is None:
            why = "does not answer" if self._refusal is None else f"says: {self._refusal.reason}"
            log.warning("%s%s at %s %s: the head begins without it", PREFIX, self._name, self._link.where, why)

    # --- ports.PlanFeed ----------------------------------------------------------------------------------------------

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        """Send a frame. Never blocks."""
        self._begin_loop(now_s)
        if self._welcome is None:
            self._unsent += 1
            return
        theirs_s = self._clock.theirs(now_s)
        number = round(frame.time_s * FRAME_HZ) - 1
        sent = SentFrame(number, frame, now_s, math.nan if theirs_s is None else theirs_s)
        self._link.send(frame_message(sent))
        if self._waiting_since_s is None:
            self._waiting_since_s = now_s

    def poll(self, now_s: float) -> Sequence[Plan]:
        """Plans whose turn it is. Never blocks, never raises."""
        self._begin_loop(now_s)
        self._attend(now_s)
        self._supervise(now_s)
        return [self._once_told(plan) for plan in self._buffer.take(now_s)]

    @property
    def lost(self) -> bool:
        """Whether it does not answer: not joined (yet), hung, refused."""
        return self._state != "listening"

    def calm(self, calmness: Calmness) -> None:
        """From the next frames on."""
        self._calmness = calmness
        if self._welcome is not None:
            self._link.send(words_message(Notice("calm", calmness=calmness.model_dump())))

    def statistics(self) -> Mapping[str, Any]:
        """As `ports.PlanFeed`: `state` is joining, listening, hung or refused; `restarts` counts streams begun after
        the first. `link` says what the way there and back takes [ms], and what was lost on it.
        """
        welcome, best = self._welcome, self._clock.best
        return {
            "state": self._state,
            "restarts": max(0, self._joins - 1),
            "skipped_frames": self._skipped + self._unsent,
            "step_ms": self._step_ms.report(p50=50, p99=99),
            "hop": None if welcome is None else welcome.hop,
            "budget_ms": None,
            "why": None if self._refusal is None else self._refusal.reason,
            "link": {
                "to": self._link.where,
                "server": None if welcome is None else welcome.server,
                "round_trip_ms": self._rtt_ms.report(p50=50, p99=99),
                "frame_to_plan_ms": self._delay_ms.report(p50=50, p99=99),
                "clock_offset_s": None if best is None else round(best.offset_s, 4),
                "clock_offset_within_ms": None if best is None else round(best.delay_s * 500, 2),
                "buffer_ms": round(self._buffer.shift_s * 1e3, 1),
                "lost_plans": self._buffer.lost,
                "late_plans": self._buffer.late,
                "doubled_plans": self._buffer.doubled,
                "refused_messages": self._refused_messages,
                "outages": self._losses,
            },
        }

    def close(self) -> None:
        """Say goodbye. Idempotent."""
        if self._welcome is not None:
            self._link.send(words_message(Notice("leave")))
            self._welcome = None
        self._link.close()

    # --- what comes --------------------------------------------------------------------------------------------------

    def _begin_loop(self, now_s: float) -> None:
        """Times of before the loop were of another clock."""
        if not self._looped:
            self._looped, self._asked_s, self._heard_s = True, -math.inf, now_s

    def _attend(self, now_s: float) -> None:
        """Take what came, and ask to be let in where that is due."""
        for age_s, message in self._link.received():
            try:
                if message[:1] == b"{":
                    self._listen_to(parse_words(message), now_s)
                else:
                    self._take(message, now_s - age_s)
            except PacketError as error:
                if not self._refused_messages:
                    log.warning("%s sends %s", self._link.where, error)
                self._refused_messages += 1
        every_s = REFUSED_S if self._state == "refused" else JOIN_S
        if self._state != "listening" and now_s - self._asked_s >= every_s:
            self._asked_s = now_s
            calmness = None if self._calmness is None else self._calmness.model_dump()
            self._link.ask(words_message(Join(self._client, self._seed, calmness)))

    def _listen_to(self, said: Join | Welcome | Refusal | Notice, now_s: float) -> None:
        if isinstance(said, Welcome):
            self._join(said, now_s)
        elif isinstance(said, Refusal) and self._state != "listening":
            if self._refusal is None or self._refusal.reason != said.reason:
                log.warning("%s%s: %s", PREFIX, self._name, said.reason)
            self._refusal, self._welcome, self._state = said, None, "refused"
        elif isinstance(said, Notice) and said.kind == "skipped":
            self._skipped += said.frames
        elif isinstance(said, Notice) and said.kind == "unknown" and self._state != "joining":
            log.warning("%s%s has been started anew: joined again", PREFIX, self._name)
            self._lose("joining")

    def _join(self, welcome: Welcome, now_s: float) -> None:
        if self._welcome is not None and welcome.stream == self._welcome.stream:
            return  # the answer to an asking during an outage: the stream is still there
        if not Interface().fits(welcome.interface):
            reason = f"this robot is {Interface()}; server {welcome.server} is {welcome.interface}"
            self._listen_to(Refusal(reason, final=True), now_s)
            return
        if self._welcome is None or (self._welcome.horizon, self._welcome.hop) != (welcome.horizon, welcome.hop):
            self._buffer = JitterBuffer(welcome.horizon, welcome.hop)
        if self._welcome is None or self._welcome.server != welcome.server:
            self._clock.forget()
        self._buffer.restart(now_s)
        self._welcome, self._refusal, self._state = welcome, None, "listening"
        self._heard_s, self._waiting_since_s = now_s, None
        self._joins += 1
        self._link.follow(welcome.stream)
        if self._joins > 1:
            log.warning("%s%s listens again", PREFIX, self._name)

    def _take(self, message: bytes, came_s: float) -> None:
        sent = parse_plan(message)
        if self._welcome is None:
            return
        if self._state == "hung":
            log.warning("%s%s answers again", PREFIX, self._name)
            self._state = "listening"
            self._buffer.restart(came_s)
        self._heard_s, self._waiting_since_s = came_s, None
        self._step_ms.add(sent.step_ms)
        if 0.0 <= sent.echo_s <= came_s:
            self._clock.observe(sent.echo_s, sent.came_s, sent.sent_s, came_s)
            self._delay_ms.add((came_s - sent.echo_s) * 1e3)
            self._rtt_ms.add(max(0.0, came_s - sent.echo_s - (sent.sent_s - sent.came_s)) * 1e3)
        self._buffer.put(sent.number, sent.plan, came_s)

    def _supervise(self, now_s: float) -> None:
        """Nothing has come for long, though frames went out."""
        if self._state != "listening" or self._waiting_since_s is None:
            return
        silent_s = now_s - max(self._waiting_since_s, self._heard_s or 0.0)
        if silent_s > HUNG_S:
            log.warning("%s%s has not answered for %.1f s", PREFIX, self._name, silent_s)
            self._lose("hung")

    def _lose(self, state: str) -> None:
        self._state, self._asked_s = state, -math.inf
        self._losses += 1
        if state == "joining":
            self._welcome = None

    def _once_told(self, plan: Plan) -> Plan:
        """The plan without the events that one before has told: each is sent with several plans."""
        fresh: list[ListenerEvent] = []
        for event in plan.events:
            key = event.kind, round(event.start_s - self._buffer.shift_s, 3)
            if key not in self._told:
                self._told.append(key)
                fresh.append(event)
        if len(fresh) == len(plan.events):
            return plan
        return replace(plan, events=tuple(fresh))
