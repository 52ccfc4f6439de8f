"""Many heads, one model: streams join, send frames, and are stepped in batches. Opens no socket and never waits.

Its owner (`app.serve`) passes messages and the time, and calls three methods in turn:

    batch    the frames that are due, earliest deadline first, one of each stream, as many as can be computed in time
    step     the listener steps them together
    finish   memories are kept, plans become messages

A frame's deadline is `DEADLINE_S` after it was whole at its robot, or after it came if the clocks are not known. A
frame that needs no plan may wait until the next frame that does. So a stream that is slow, sends nothing, or sends
missed frames in one burst does not delay the others: it has one place in a batch, like all of them. A stream keeps the
listener's memory and at most `MOST_WAITING` frames; if more are waiting, it continues with the newest.

A frame that was lost on the way is replaced by an empty one (no sound, no face), so that memories count time.
"""

from __future__ import annotations

import logging
import math
import secrets
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from sfms_robot.config.base import parse
from sfms_robot.config.listener import Calmness
from sfms_robot.errors import PacketError, RobotError
from sfms_robot.frames import FRAME_S, NO_SOUND, Events, Plan, SpeakerFrame
from sfms_robot.listeners.capacity import Capacity, step_each
from sfms_robot.listeners.remote_messages import (
    OURS,
    Join,
    Notice,
    Refusal,
    SentFrame,
    SentPlan,
    Welcome,
    parse_frame,
    parse_words,
    plan_message,
    words_message,
)
from sfms_robot.listeners.thread import MOST_WAITING, calmed
from sfms_robot.ports import Facts, Listener

DEADLINE_S: Final = 0.080
SILENT_S: Final = 10.0  # a stream that sends nothing for so long is dropped
RECENT: Final = 2048  # number of the last delays and batches in p50 and p99
MOST_FILLED: Final = MOST_WAITING  # most lost frames in a row that become empty ones; more are an outage
SENT_AGAIN: Final = 2  # number of plans that repeat an event
_STALE_S: Final = 2.0  # a frame that seems older than this has a wrong clock: its arrival counts
_SCALE_STEP: Final = 0.05  # weight of one batch in the scale of costs

log = logging.getLogger(__name__)


_COUNTS: Final = tuple("heads plans deadline_misses batches steps skipped_frames lost_frames refused malformed".split())


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Figures of one `StreamServer`; `report` adds up those of several servers of one listener.

    Attributes:
        server, listener: names.
        hop: frames between plans.
        counts: counts by the names of `_COUNTS`: `heads` at this moment, the others since the start.
        most_heads: number of heads that could be answered in time; None if all are admitted.
        delays_s, batch_sizes: delays of the last plans, and sizes of the last batches.
        cost_scale: duration of batches relative to the measurement at the start; None if there was none.
        cpu_s: processor time of its process.
    """

    server: str
    listener: str
    hop: int
    counts: Counter[str]
    most_heads: int | None
    delays_s: Sequence[float]
    batch_sizes: Sequence[int]
    cost_scale: float | None
    cpu_s: float


def report(parts: Sequence[Figures]) -> Facts:
    """Return the statistics of `serve`; `parts` are the figures of all processes of one server, one at least."""
    first = parts[0]
    scales = [each.cost_scale for each in parts if each.cost_scale is not None]
    return {
        "server": first.server,
        "listener": first.listener,
        "hop": first.hop,
        "processes": len(parts),
        **{name: sum(each.counts[name] for each in parts) for name in _COUNTS},
        "most_heads": None if first.most_heads is None else sum(each.most_heads or 0 for each in parts),
        "deadline_ms": DEADLINE_S * 1e3,
        "delay_ms": _spread([delay_s * 1e3 for each in parts for delay_s in each.delays_s]),
        "batch_size": _spread([size for each in parts for size in each.batch_sizes]),
        "cost_scale": round(max(scales), 3) if scales else None,
        "cpu_s": round(sum(each.cpu_s for each in parts), 3),
    }


def _spread(values: Sequence[float]) -> dict[str, float | None]:
    if not values:
        return {"p50": None, "p99": None}
    p50, p99 = np.percentile(values, [50, 99]).round(3).tolist()
    return {"p50": p50, "p99": p99}


@dataclass(frozen=True)
class _Due:
    """A frame that waits to be stepped; times by the server's clock."""

    sent: SentFrame
    came_s: float
    deadline_s: float


@dataclass(kw_only=True)
class _Stream:
    """The stream of one head."""

    name: str
    client: str
    memory: Any
    heard_s: float
    waiting: deque[_Due] = field(default_factory=deque)
    expected: int | None = None  # number of the next frame
    to_plan: int = 0  # steps until the next step that plans
    stepping: bool = False
    events: deque[Events] = field(default_factory=lambda: deque(maxlen=SENT_AGAIN))
    calmness: Calmness | None = None


Batch = Sequence[tuple[_Stream, _Due]]  # frames to be stepped together


class StreamServer:
    """The streams of a listener's heads. Not thread-safe. All times are seconds of one clock.

    Args:
        listener: the listener that is served as `name`.
        capacity: costs of its batches; None admits all heads.
        server: name of this server; a random number is appended to it.

    Attributes:
        counts: counts since the start, see `Figures`.
    """

    def __init__(self, listener: Listener, name: str, capacity: Capacity | None = None, server: str = "server") -> None:
        self._listener, self._name, self._capacity = listener, name, capacity
        self._server = f"{server}-{secrets.token_hex(3)}"
        self.counts = Counter[str]()
        self._delays_s, self._batch_sizes = deque[float](maxlen=RECENT), deque[int](maxlen=RECENT)
        self._streams: dict[str, _Stream] = {}
        self._most = self._batch_limit()

    @property
    def heads(self) -> int:
        """Return the number of streams at this moment."""
        return len(self._streams)

    @property
    def clients(self) -> Mapping[str, str]:
        """Return the client of each stream, by the stream's name."""
        return {name: stream.client for name, stream in self._streams.items()}

    @property
    def waits(self) -> bool:
        """Return whether `batch` has something to return."""
        return bool(self._ready())

    # --- coming and going --------------------------------------------------------------------------------------------

    def join(self, message: bytes, now_s: float) -> bytes:
        """Return the answer to a request for a stream: Welcome or Refusal, as bytes. Never raises."""
        try:
            said = parse_words(message)
            if not isinstance(said, Join):
                raise PacketError("expected a join")
            answer = self._admit(said, now_s)
        except RobotError as error:
            self._count_malformed("join", error)
            answer = Refusal(f"server {self._server} cannot take that: {error}", final=True)
        if isinstance(answer, Refusal):
            self.counts["refused"] += 1
            log.info("refused: %s", answer.reason)
        return words_message(answer)

    def _admit(self, join: Join, now_s: float) -> Welcome | Refusal:
        if not OURS.fits(join.interface):
            return Refusal(f"this robot is {join.interface}; server {self._server} is {OURS}", final=True)
        calmness = None if join.calmness is None else parse(Calmness, dict(join.calmness), "calmness")
        known = next((each for each in self._streams.values() if each.client == join.client), None)
        if known is None:
            if (reason := self._full()) is not None:
                return Refusal(reason, final=False)
            memory = self._listener.start(join.seed)
            known = _Stream(name=secrets.token_hex(6), client=join.client, memory=memory, heard_s=now_s)
            self._streams[known.name] = known
        known.heard_s, known.calmness = now_s, calmness or known.calmness
        return Welcome(
            stream=known.name,
            server=self._server,
            listener=self._name,
            horizon=self._listener.horizon,
            hop=self._listener.hop,
        )

    def _full(self) -> str | None:
        """Return the reason why no further head is admitted; None if one more is."""
        if self._capacity is None:
            return None
        delay_s = self._capacity.delay_s(self.heads + 1, DEADLINE_S)
        if delay_s <= DEADLINE_S:
            return None
        after = "not be kept up with" if math.isinf(delay_s) else f"be answered after {delay_s * 1e3:.0f} ms"
        return (
            f"server {self._server} is full: with {self.heads} heads one more would {after}, "
            f"{DEADLINE_S * 1e3:.0f} ms are promised"
        )

    def expire(self, now_s: float) -> None:
        """Drop streams that send nothing."""
        for name, stream in list(self._streams.items()):
            if now_s - stream.heard_s > SILENT_S and not stream.stepping:
                log.info("stream %s has sent nothing for %.0f s: dropped", name, SILENT_S)
                del self._streams[name]

    # --- frames ------------------------------------------------------------------------------------------------------

    def receive(self, name: str, message: bytes, now_s: float) -> Sequence[bytes]:
        """Process a message to the stream `name`; return the messages that answer it at once. Never raises."""
        stream = self._streams.get(name)
        if stream is None:
            return [words_message(Notice("unknown"))]
        stream.heard_s = now_s
        try:
            if message[:1] != b"{":
                return self._enqueue(stream, parse_frame(message), now_s)
            said = parse_words(message)
            if not isinstance(said, Notice):
                raise PacketError("a stream: expected a notice (leave, calm)")
            if said.kind == "leave":
                del self._streams[name]
            elif said.kind == "calm" and said.calmness is not None:
                stream.calmness = parse(Calmness, dict(said.calmness), "calmness")
        except RobotError as error:
            self._count_malformed(f"stream {name} of {stream.client!r}", error)
        return []

    def _count_malformed(self, origin: str, error: RobotError) -> None:
        self.counts["malformed"] += 1
        if self.counts["malformed"] == 1:
            log.warning("%s: %s (more malformed messages are only counted)", origin, error)

    def _enqueue(self, stream: _Stream, sent: SentFrame, now_s: float) -> Sequence[bytes]:
        gap = 0 if stream.expected is None else sent.number - stream.expected
        if gap < 0:
            return []  # the frame came late, and an empty one has replaced it; or it came twice
        self.counts["lost_frames"] += gap
        stream.expected = sent.number + 1
        made_s = sent.server_sent_s if 0.0 <= now_s - sent.server_sent_s <= _STALE_S else now_s
        for back in range(min(gap, MOST_FILLED), -1, -1):
            ago_s = back * FRAME_S
            frame = SpeakerFrame(sent.frame.time_s - ago_s, NO_SOUND) if back else sent.frame
            own = SentFrame(sent.number - back, frame, sent.sent_s - ago_s, sent.server_sent_s)
            stream.waiting.append(_Due(own, now_s, made_s + DEADLINE_S))
        if len(stream.waiting) <= MOST_WAITING:
            return []
        left_out = len(stream.waiting) - 1
        stream.waiting = deque([stream.waiting[-1]])
        self.counts["skipped_frames"] += left_out
        return [words_message(Notice("skipped", frames=left_out))]

    # --- batches -----------------------------------------------------------------------------------------------------

    def batch(self) -> Batch | None:
        """Return the next batch to be stepped, or None. Its streams are in no other batch until `finish`."""
        # A frame that needs no plan may wait until the next frame that does.
        due = sorted(self._ready(), key=lambda each: each.waiting[0].deadline_s + each.to_plan * FRAME_S)[: self._most]
        for stream in due:
            stream.stepping = True
            stream.memory, stream.calmness = calmed(self._listener, stream.memory, stream.calmness), None
        return [(stream, stream.waiting.popleft()) for stream in due] or None

    def _ready(self) -> list[_Stream]:
        return [each for each in self._streams.values() if each.waiting and not each.stepping]

    def step(self, batch: Batch) -> list[tuple[Plan | None, Any]]:
        """Step the streams of a batch; return (plan, memory) of each. Raises what the listener raises."""
        return step_each(self._listener, [due.sent.frame for _, due in batch], [stream.memory for stream, _ in batch])

    def finish(
        self, batch: Batch, answers: Sequence[tuple[Plan | None, Any]], began_s: float, now_s: float
    ) -> list[tuple[str, bytes]]:
        """Keep the memories; return the messages to be sent, each with its stream. `began_s`: start of the step."""
        step_s = now_s - began_s
        messages = []
        for (stream, due), (plan, memory) in zip(batch, answers, strict=True):
            stream.memory, stream.stepping = memory, False
            stream.to_plan = self._listener.hop - 1 if plan is not None else max(0, stream.to_plan - 1)
            if plan is not None and stream.name in self._streams:
                earlier = tuple(event for each in stream.events for event in each)
                sent = SentPlan(
                    number=due.sent.number,
                    plan=plan,
                    echo_s=due.sent.sent_s,
                    came_s=due.came_s,
                    sent_s=now_s,
                    step_ms=step_s * 1e3,
                )
                messages.append((stream.name, plan_message(sent, earlier)))
                stream.events.append(plan.events)
                delay_s = now_s - due.came_s
                self._delays_s.append(delay_s)
                self.counts.update(plans=1, deadline_misses=delay_s > DEADLINE_S)
        self.counts.update(batches=1, steps=len(batch))
        self._batch_sizes.append(len(batch))
        self._weigh(sum(plan is not None for plan, _ in answers), len(answers), step_s)
        return messages

    def too_many(self, batch: Batch) -> None:
        """Requeue a batch that did not fit in memory, and halve batches from now on; drop a stream that was alone.

        The dropped stream joins again.
        """
        self._most = max(1, len(batch) // 2)
        if len(batch) == 1:
            self.failed(batch)
        for stream, due in batch:
            stream.waiting.appendleft(due)
            stream.stepping = False

    def failed(self, batch: Batch) -> None:
        """Drop the streams of a batch whose step raised: they join again."""
        for stream, _ in batch:
            self._streams.pop(stream.name, None)

    def _weigh(self, plans: int, steps: int, step_s: float) -> None:
        """Adapt the scale of the costs to the duration of this batch."""
        if self._capacity is None:
            return
        scale = self._capacity.scale
        expected_s = self._capacity.batch_s(plans, steps - plans) / scale
        if expected_s > 0:
            ratio = min(max(step_s / expected_s, 0.25), 4.0)
            self._capacity = replace(self._capacity, scale=scale + _SCALE_STEP * (ratio - scale))

    def _batch_limit(self) -> int:
        """Return the largest number of streams that can all plan in a batch within half of the deadline."""
        if self._capacity is None:
            return 1 << 16
        return next((size for size in range(1, 4096) if self._capacity.batch_s(size + 1, 0) > DEADLINE_S / 2), 4096)

    # --- figures -----------------------------------------------------------------------------------------------------

    def figures(self) -> Figures:
        """Return the figures of this server so far."""
        capacity = self._capacity
        return Figures(
            server=self._server,
            listener=self._name,
            hop=self._listener.hop,
            counts=self.counts + Counter(heads=self.heads),
            delays_s=[*self._delays_s],
            batch_sizes=[*self._batch_sizes],
            most_heads=None if capacity is None else capacity.most(DEADLINE_S),
            cost_scale=None if capacity is None else capacity.scale,
            cpu_s=time.process_time(),
        )
