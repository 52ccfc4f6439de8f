"""A listener on another machine, as the loop sees it: frames go out, plans come back (`ports.PlanFeed`).

    joining     it requests a stream repeatedly until a server answers
    listening   frames go to its stream; plans come through a jitter buffer
    hung        frames were sent, and nothing has come back for `HUNG_S`; frames and requests continue
    refused     the server has refused with a reason; the next request is after `REFUSED_S`: another one may be there

A server that was restarted has none of the earlier streams; it reports that, and is joined again. The server keeps the
memory of a stream: after joining again the listener starts without memory. Meanwhile plans run out, the face eases to
neutral, and idle motion of the head continues, as with any lost listener (docs/safety.md).

Keys of zenoh:

    sfms/listen/NAME/join           a query with Join, answered with Welcome or Refusal
    sfms/listen/NAME/STREAM/up      frames, and notices, from the robot
    sfms/listen/NAME/STREAM/down    plans, and notices, to it

Sending never waits: frames and plans that the network does not accept at once are dropped, since newer ones follow.
"""

from __future__ import annotations

import logging
import math
import secrets
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.config.listener import Calmness
from sfms_robot.errors import ConfigError, PacketError
from sfms_robot.frames import ListenerEvent, Plan, SpeakerFrame
from sfms_robot.listeners.remote_messages import (
    OURS,
    Join,
    Notice,
    Refusal,
    SentFrame,
    Welcome,
    Words,
    frame_message,
    parse_plan,
    parse_words,
    words_message,
)
from sfms_robot.listeners.remote_timing import ClockOffset, JitterBuffer
from sfms_robot.network import Connection, Router, session_config
from sfms_robot.plugins import REMOTE as PREFIX
from sfms_robot.ports import Facts
from sfms_robot.signals.quantiles import Quantiles

if TYPE_CHECKING:
    import zenoh

HUNG_S: Final = 1.0
JOIN_S: Final = 0.25  # time from one request to the next
REFUSED_S: Final = 5.0
AWAY_S: Final = 5.0  # longest wait for the first answer; after that the head begins without the listener
_SHOWN: Final = 64  # number of past events that are remembered
_WAIT_S: Final = 0.01

log = logging.getLogger(__name__)


class RemoteListener:
    """A `ports.PlanFeed` over a link.

    Args:
        name: name of the served listener.
        link: carries messages; tests have another one.
        seed, calmness: as in `process.ListenerProcess`.
    """

    def __init__(self, name: str, link: ZenohLink, seed: int, calmness: Calmness | None = None) -> None:
        self._name, self._link, self._seed, self._calmness = name, link, seed, calmness
        self._client = secrets.token_hex(8)
        self._state = "joining"
        self._welcome: Welcome | None = None
        self._refusal: Refusal | None = None
        self._buffer = JitterBuffer(1, 1)
        self._clock = ClockOffset()
        self._step_ms, self._rtt_ms, self._delay_ms = Quantiles(), Quantiles(), Quantiles()
        self._shown = deque[tuple[str, float]](maxlen=_SHOWN)
        self._asked_s = -math.inf
        self._waiting_since_s: float | None = None  # time since which an answer to a frame is missing
        self._skipped = self._refused_messages = 0
        self._joins = self._losses = 0

    # --- before the loop ---------------------------------------------------------------------------------------------

    def wait_loaded(self, limit_s: float = AWAY_S) -> None:
        """Block until the server answers, `limit_s` at most; after that log a warning: the head begins without it.

        Raises ConfigError if the server refuses for good, or the link can never be opened.
        """
        end_s = time.monotonic() + limit_s
        while self._welcome is None and (now_s := time.monotonic() - end_s) < 0:  # before loop time, which begins at 0
            self._attend(now_s)
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
        if self._welcome is None:
            self._skipped += 1
            return
        theirs_s = self._clock.theirs(now_s)
        sent = SentFrame(frame.number, frame, now_s, math.nan if theirs_s is None else theirs_s)
        self._link.send(frame_message(sent))
        if self._waiting_since_s is None:
            self._waiting_since_s = now_s

    def poll(self, now_s: float) -> Sequence[Plan]:
        """Return plans that are due. Never blocks, never raises."""
        self._attend(now_s)
        silent_s = 0.0 if self._waiting_since_s is None else now_s - self._waiting_since_s
        if self._state == "listening" and silent_s > HUNG_S:  # although frames were sent
            log.warning("%s%s has not answered for %.1f s", PREFIX, self._name, silent_s)
            self._lose("hung")
        return [self._with_new_events(plan) for plan in self._buffer.take(now_s)]

    @property
    def lost(self) -> bool:
        """Return whether the listener does not answer: not joined (yet), hung, refused."""
        return self._state != "listening"

    def calm(self, calmness: Calmness) -> None:
        """Use other rates from the next frames on."""
        self._calmness = calmness
        if self._welcome is not None:
            self._link.send(words_message(Notice("calm", calmness=calmness.model_dump())))

    def statistics(self) -> Facts:
        """Return the figures of `ports.PlanFeed`, and of the link: delays [ms], and counts of lost messages.

        `state` is joining, listening, hung or refused; `restarts` counts streams begun after the first.
        """
        welcome, best = self._welcome, self._clock.best
        return {
            "state": self._state,
            "restarts": max(0, self._joins - 1),
            "skipped_frames": self._skipped,
            "step_ms": self._step_ms.report(p50=50, p99=99),
            "hop": welcome and welcome.hop,
            "budget_ms": None,
            "why": self._refusal and self._refusal.reason,
            "link": {
                "to": self._link.where,
                "server": welcome and welcome.server,
                "round_trip_ms": self._rtt_ms.report(p50=50, p99=99),
                "frame_to_plan_ms": self._delay_ms.report(p50=50, p99=99),
                "clock_offset_s": best and round(best.offset_s, 4),
                "clock_offset_within_ms": best and round(best.delay_s * 500, 2),
                "buffer_ms": round(self._buffer.shift_s * 1e3, 1),
                "lost_plans": self._buffer.lost,
                "late_plans": self._buffer.late,
                "doubled_plans": self._buffer.doubled,
                "refused_messages": self._refused_messages,
                "outages": self._losses,
            },
        }

    def close(self) -> None:
        """Leave the stream and close the link. Idempotent."""
        if self._welcome is not None:
            self._link.send(words_message(Notice("leave")))
            self._welcome = None
        self._link.close()

    # --- messages --------------------------------------------------------------------------------------------------

    def _attend(self, now_s: float) -> None:
        """Handle received messages, and request a stream if a request is due."""
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

    def _listen_to(self, said: Words, now_s: float) -> None:
        match said:
            case Welcome():
                self._join(said, now_s)
            case Refusal() if self._state != "listening":
                if self._refusal is None or self._refusal.reason != said.reason:
                    log.warning("%s%s: %s", PREFIX, self._name, said.reason)
                self._refusal, self._welcome, self._state = said, None, "refused"
            case Notice(kind="skipped"):
                self._skipped += said.frames
            case Notice(kind="unknown") if self._state != "joining":
                log.warning("%s%s was started again: joining again", PREFIX, self._name)
                self._lose("joining")

    def _join(self, welcome: Welcome, now_s: float) -> None:
        if self._welcome is not None and welcome.stream == self._welcome.stream:
            return  # the answer to a request during an outage: the stream is still there
        if not OURS.fits(welcome.interface):
            reason = f"this robot is {OURS}; server {welcome.server} is {welcome.interface}"
            self._listen_to(Refusal(reason, final=True), now_s)
            return
        if self._welcome is None or (self._welcome.horizon, self._welcome.hop) != (welcome.horizon, welcome.hop):
            self._buffer = JitterBuffer(welcome.horizon, welcome.hop)
        if self._welcome is None or self._welcome.server != welcome.server:
            self._clock = ClockOffset()
        self._buffer.restart(now_s)
        self._welcome, self._refusal, self._state = welcome, None, "listening"
        self._waiting_since_s = None
        self._joins += 1
        self._link.follow(welcome.stream)
        if self._joins > 1:
            log.info("%s%s listens again", PREFIX, self._name)

    def _take(self, message: bytes, came_s: float) -> None:
        sent = parse_plan(message)
        if self._welcome is None:
            return
        if self._state == "hung":
            log.info("%s%s answers again", PREFIX, self._name)
            self._state = "listening"
            self._buffer.restart(came_s)
        self._waiting_since_s = None
        self._step_ms.add(sent.step_ms)
        if 0.0 <= sent.echo_s <= came_s:
            self._clock.observe(sent.echo_s, sent.came_s, sent.sent_s, came_s)
            self._delay_ms.add((came_s - sent.echo_s) * 1e3)
            self._rtt_ms.add(max(0.0, came_s - sent.echo_s - (sent.sent_s - sent.came_s)) * 1e3)
        self._buffer.put(sent.number, sent.plan, came_s)

    def _lose(self, state: str) -> None:
        self._state, self._asked_s = state, -math.inf
        self._losses += 1
        if state == "joining":
            self._welcome = None

    def _with_new_events(self, plan: Plan) -> Plan:
        """Return the plan without events of earlier plans: each event is sent with several plans."""
        fresh: list[ListenerEvent] = []
        for event in plan.events:
            key = event.kind, round(event.start_s - self._buffer.shift_s, 3)
            if key not in self._shown:
                self._shown.append(key)
                fresh.append(event)
        return replace(plan, events=tuple(fresh))


# --- Link -------------------------------------------------------------------------------------------------------------

ROOT: Final = "sfms/listen"
ANSWER_S: Final = 2.0  # longest wait for the answer to a request
MOST_RECEIVED: Final = 1000  # messages that wait for `received`; the oldest are dropped


def listen_key(name: str, *parts: str) -> str:
    """Return a key of a served listener: of "join", where streams are requested, or of a stream and "up" or "down"."""
    return "/".join((ROOT, name, *parts))


class ZenohLink:
    """A link to the listener that is served as `name`. No method blocks.

    Attributes:
        where: the router as text, for messages to people.
    """

    def __init__(self, name: str, router: Router) -> None:
        self._name = name
        self.where = str(router)
        self._connection = Connection(session_config("call", router))
        self._received = deque[tuple[float, bytes]](maxlen=MOST_RECEIVED)
        self._publisher: zenoh.Publisher | None = None
        self._subscriber: Any = None

    @property
    def problem(self) -> str | None:
        """Return the reason why the link can never carry a message; None as long as it may."""
        return self._connection.problem

    def ask(self, message: bytes) -> None:
        """Send a request to the servers of this name; `received` returns every answer."""
        session = self._connection.session
        if session is not None:
            session.get(listen_key(self._name, "join"), self._on_reply, payload=message, timeout=ANSWER_S)

    def follow(self, stream: str) -> None:
        """Receive messages of this stream from now on, and `send` to it."""
        import zenoh

        session = self._connection.session
        if session is None:
            return
        self._unfollow()
        self._subscriber = session.declare_subscriber(listen_key(self._name, stream, "down"), self._on_sample)
        self._publisher = session.declare_publisher(
            listen_key(self._name, stream, "up"),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,  # messages are not gathered into larger packets, which would take time
        )

    def send(self, message: bytes) -> None:
        """Send a message to the stream; it may be lost."""
        if self._publisher is not None:
            self._publisher.put(message)

    def received(self) -> Sequence[tuple[float, bytes]]:
        """Return (age [s], message) of all messages since the last call, in the order of arrival."""
        now_s = time.monotonic()
        taken = [self._received.popleft() for _ in range(len(self._received))]
        return [(now_s - came_s, message) for came_s, message in taken]

    def close(self) -> None:
        """Close the connection. Idempotent."""
        self._unfollow()
        self._connection.close()

    def _unfollow(self) -> None:
        for declared in (self._publisher, self._subscriber):
            if declared is not None:
                declared.undeclare()
        self._publisher = self._subscriber = None

    def _on_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._on_sample(reply.ok)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self._received.append((time.monotonic(), sample.payload.to_bytes()))
