"""Motion on its way to an output: eased and limited, in a separate thread that survives losses of the peer.

    MotionShaper    motion that an output shows, a value passed from step to step: no jump at start, end, halt, return
    OutputSender    one output: connect, shape, send, and connect again after a loss; time is an argument of its `step`,
                    which its thread calls at the output's rate with the loop's newest tick; the loop never waits
    Outputs         all outputs of a run

    phase        motion goes to                     when
    live         the motion of the newest tick      the run moves
    neutral      0                                  before the first tick, at the end; an avatar also in a halt
    held         its present value                  a halt, if the output moves a machine

A change to another phase takes `EASE_S`, from the motion shown so far. `Output.open` leaves its peer at neutral, so a
start and a return begin there.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from sfms_robot.errors import OutputError, first_line
from sfms_robot.frames import CHANNEL_INDEX, NEUTRAL, Floats, ListenerEvent
from sfms_robot.motion.limits import JerkLimiter, JointLimits, LimiterState, difference
from sfms_robot.ports import ChannelLimit, Facts, Observer, Output, OutputFrame, Tick
from sfms_robot.signals.minimum_jerk import ease

EASE_S: Final = 1.0
PAUSES_S: Final = (1.0, 10.0)  # first pause between two tries to connect, and the longest; doubled each time
PROVEN_S: Final = 0.5  # a connection counts after this time without an error: UDP reports a lost peer late
RAMP_S: Final = 0.05  # time in which a limited channel reaches its highest acceleration
LAST_S: Final = 4.0  # longest time for the end of all outputs: an `open` in progress, then the easing
_WINDOW_S: Final = 1.0  # time over which frames a second are counted
_MOST_EVENTS: Final = 64  # events that wait for their beginning, at most
_STILL: Final = 1e-4  # motion smaller than this is neutral

logger = logging.getLogger(__name__)

Phase = Literal["live", "neutral", "held"]


@dataclass(frozen=True, kw_only=True)
class Shown:
    """Motion that an output shows.

    Attributes:
        motion: (58,) of the last step.
        phase, since_s, origin: what motion goes to, since when, and from where (58,).
        before, here: (58,) two samples of the reference of limited channels.
        limiter: state of limited channels; None where there are none.
    """

    motion: Floats
    phase: Phase
    since_s: float
    origin: Floats
    before: Floats
    here: Floats
    limiter: LimiterState | None = None


class MotionShaper:
    """Easing between phases, then one limiter of position, speed and acceleration for channels that have limits."""

    def __init__(self, limits: Mapping[str, ChannelLimit], rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._columns = [CHANNEL_INDEX[channel] for channel in limits]
        self._limiter = None
        if limits:
            low, high, speed, acceleration = np.array(list(limits.values()), np.float64).T
            jerk = acceleration / RAMP_S
            self._limiter = JerkLimiter(JointLimits(low, high, speed, acceleration, jerk), self._period_s)

    def start(self, now_s: float) -> Shown:
        """Return the state of an output at neutral."""
        return Shown(
            motion=NEUTRAL,
            phase="neutral",
            since_s=now_s,
            origin=NEUTRAL,
            before=NEUTRAL,
            here=NEUTRAL,
            limiter=None if self._limiter is None else self._limiter.start(np.zeros(len(self._columns))),
        )

    def step(self, target: Floats, phase: Phase, now_s: float, shown: Shown) -> Shown:
        """Return the state one period later. `target` (58,): the motion of the phase "live"."""
        if phase != shown.phase:
            shown = replace(shown, phase=phase, since_s=now_s, origin=shown.motion)
        ahead = shown.motion
        if phase != "held":
            aim = target if phase == "live" else np.zeros_like(target)
            aim = np.where(np.isfinite(aim), aim, shown.motion)
            share = np.float32(ease((now_s - shown.since_s) / EASE_S))
            ahead = shown.origin + share * (aim - shown.origin)
        if self._limiter is None or shown.limiter is None:
            return replace(shown, motion=ahead)
        motion = ahead.copy()
        if phase == "held":
            motion[self._columns], limiter = self._limiter.brake(shown.limiter)
            return replace(shown, motion=motion, before=motion, here=motion, limiter=limiter)
        before, here, next_ = np.stack([shown.before, shown.here, ahead])[:, self._columns].astype(np.float64)
        reference = difference(before, here, next_, self._period_s)
        motion[self._columns], limiter = self._limiter.step(reference, shown.limiter)
        return replace(shown, motion=motion, before=shown.here, here=ahead, limiter=limiter)


class OutputSender:
    """One output: `step` connects or sends, once a period. `joints`: names for `Tick.goals_rad`.

    Attributes:
        name: KIND:ADDRESS, in messages and in `why` of a degraded run.
        lost: whether the peer is away.
        shown: motion that the output shows; None while it is not connected.
        thread: thread that calls `step` with the newest tick, once it is started.
        closing: set to end the thread, which then eases to neutral and disconnects.
    """

    def __init__(self, output: Output, joints: Sequence[str] = ()) -> None:
        self.output = output
        self.name = f"{output.kind}:{output.peer}"
        self.lost = False
        self.shown: Shown | None = None
        self._shaper = MotionShaper(output.limits, output.rate_hz)
        self._pause_s, self._retry_s, self._opened_s = PAUSES_S[0], -np.inf, 0.0
        self._problem: str | None = None
        self._counts = {"frames": 0, "losses": 0}
        self._window = (0.0, 0, 0.0)  # start, frames by then, frames a second of the window before
        self._joints = tuple(joints)
        self._tick: Tick | None = None
        self._events = deque[ListenerEvent](maxlen=_MOST_EVENTS)
        self.closing = threading.Event()
        self.thread = threading.Thread(target=self._work, name=f"output {output.kind}", daemon=True)

    @property
    def settled(self) -> bool:
        """True if nothing is left to ease: the output is neutral, held, or away."""
        shown = self.shown
        return shown is None or shown.phase == "held" or bool(np.abs(shown.motion).max() < _STILL)

    def step(self, frame: OutputFrame | None, now_s: float, ending: bool = False) -> None:
        """Send a frame, or connect. `frame`: None before the first tick. Never raises; blocks as the output does."""
        frame = frame or OutputFrame(time_s=0.0, motion=NEUTRAL)
        phase: Phase = "neutral" if ending or frame.state in ("starting", "halted") else "live"
        if frame.state == "halted" and self.output.moves:  # also at the end of a halted run
            phase = "held"
        if self.shown is None and (ending or phase == "held" or now_s < self._retry_s):
            return  # connecting would move a halted machine
        try:
            if self.shown is None:
                self.output.open()
                self.shown, self._opened_s = self._shaper.start(now_s), now_s
                self._window = now_s, self._counts["frames"] + 1, 0.0  # it begins with the first frame
            self.shown = self._shaper.step(frame.motion, phase, now_s, self.shown)
            self.output.send(replace(frame, motion=self.shown.motion), now_s)
        except Exception as error:  # any kind: it may be a plug-in
            self._lose(error, now_s)
        else:
            self._sent(now_s)

    def statistics(self) -> Facts:
        """Return state, peer, frames, frames a second and losses, and the output's own figures. From any thread."""
        state = "lost" if self.lost else "connecting" if self.shown is None else "sending"
        return {
            "kind": self.output.kind,
            "peer": self.output.peer,
            "state": state,
            **self._counts,
            "frames_per_s": round(self._window[2], 1) if state == "sending" else 0.0,
            "problem": self._problem,
            **self._asked(self.output.statistics),
        }

    def close(self) -> None:
        """Disconnect the output."""
        self._asked(self.output.close)

    def _asked(self, method: Callable[[], Facts | None]) -> Facts:
        """Return the result of a method of the output; empty if it returns none or raises."""
        try:
            return method() or {}
        except Exception:  # any kind: it may be a plug-in
            logger.info("output %s raised", self.name, exc_info=True)
            return {}

    def _sent(self, now_s: float) -> None:
        self._counts["frames"] += 1
        began_s, before, _ = self._window
        if now_s - began_s >= _WINDOW_S:
            frames = self._counts["frames"]
            self._window = now_s, frames, (frames - before) / (now_s - began_s)
        if now_s - self._opened_s > PROVEN_S:
            self._pause_s = PAUSES_S[0]
            if self.lost:
                self.lost, self._problem = False, None
                logger.info("output %s: connected again", self.name)

    def _lose(self, error: Exception, now_s: float) -> None:
        expected = isinstance(error, (OutputError, OSError))
        text = first_line(error)
        self._problem = text if expected else f"{type(error).__name__}: {text}"
        if not expected:
            logger.info("output %s raised", self.name, exc_info=True)
        if not self.lost:
            self._counts["losses"] += 1
            logger.warning("output %s: %s; it is tried again, the run continues", self.name, self._problem)
        self.lost, self.shown = True, None
        self.close()
        self._retry_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, PAUSES_S[1])

    def tick(self, seen: Tick) -> None:
        self._tick = seen

    def event(self, event: ListenerEvent) -> None:
        """Queue an event that the listener has decided. From any thread."""
        self._events.append(event)

    def frame(self) -> OutputFrame | None:
        """Return the frame of the newest tick; None before the first."""
        if (seen := self._tick) is None:
            return None
        waiting = [self._events.popleft() for _ in range(len(self._events))]
        self._events.extend(event for event in waiting if event.start_s > seen.time_s)
        return OutputFrame(
            time_s=seen.time_s,
            motion=seen.motion,
            state=seen.state,
            events=tuple(event for event in waiting if event.start_s <= seen.time_s),
            goals_rad=seen.goals_rad,
            joints=self._joints,
        )

    def _work(self) -> None:
        period_s = 1.0 / self.output.rate_hz
        due_s = time.monotonic()
        while not self.closing.wait(max(0.0, due_s - time.monotonic())):
            now_s = time.monotonic()
            self.step(self.frame(), now_s)
            due_s = max(due_s + period_s, now_s + period_s / 2)  # frames missed by a late one are not made up for
        last_s, frame = time.monotonic() + LAST_S, self.frame()
        while not self.settled and (now_s := time.monotonic()) < last_s:
            self.step(frame, now_s, ending=True)
            time.sleep(max(0.0, now_s + period_s - time.monotonic()))
        self.close()


class Outputs(Observer):
    """All outputs of a run. Its construction starts to connect to them.

    Attributes:
        names: KIND:ADDRESS of each.
    """

    def __init__(self, outputs: Sequence[Output], joints: Sequence[str] = ()) -> None:
        self.senders = [OutputSender(output, joints) for output in outputs]
        self.names = tuple(each.name for each in self.senders)
        for each in self.senders:
            each.thread.start()

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of outputs whose peer is away."""
        return tuple(each.name for each in self.senders if each.lost)

    def tick(self, seen: Tick) -> None:
        for each in self.senders:
            each.tick(seen)

    def event(self, event: ListenerEvent) -> None:
        """Pass an event that the listener has decided to all outputs. From any thread."""
        for each in self.senders:
            each.event(event)

    def statistics(self) -> list[Facts]:
        """Return the figures of each output, as `OutputSender.statistics` does."""
        return [each.statistics() for each in self.senders]

    def close(self) -> None:
        """Lead all outputs to neutral and disconnect them, at the same time. Blocks `LAST_S` at most. Idempotent."""
        for each in self.senders:
            each.closing.set()
        until_s = time.monotonic() + LAST_S
        for each in self.senders:
            each.thread.join(max(0.0, until_s - time.monotonic()))
