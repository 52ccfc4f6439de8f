"""Measurements of a run. Every figure of the report comes from here or from the parts' own counters.

Memory is bounded, so that a run may take days: running figures, quantiles in fixed memory and the last half minute of
three signals of the face.
"""

from __future__ import annotations

import logging
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, Final

import numpy as np

from sfms_robot.frames import FRAME_S, Bools, Doubles, Floats, Plan, SpeakerFrame
from sfms_robot.motion.audit import CommandAudit
from sfms_robot.runtime.clock import TickPace, TickTime
from sfms_robot.runtime.states import RunState
from sfms_robot.signals.events import MOTION_EVENTS
from sfms_robot.signals.quantiles import Quantiles

LATE_SHARE: Final = 0.5  # a tick is late when it starts more than this share of a period behind its deadline
ATTENTIVE: Final = 0.5  # a person with more attention than this counts as looking at the head
SPEECH_RMS: Final = 0.01  # a frame louder than this counts as speech when latency is measured
STATES: Final = 200  # changes of state in the report, the newest ones
_REMEMBERED: Final = 250  # longest queue of speech frames (ten seconds), and of plans, that wait to be measured
_BLOCK_S: Final = 20.0  # length of a block, whose events are counted at once
_MARGIN_S: Final = 8.0  # searched on both sides of a block; no nod is longer

logger = logging.getLogger(__name__)

FindEvents = Callable[[Doubles, float], Sequence[tuple[float, float, float]]]


class EventCounter:
    """Counter of events in an endless signal, a block at a time.

    Args:
        find: signal (N,) and its rate -> events (start_s, end_s, size) in order, as those of `signals.events`.
        worker: executor that counts the blocks; a block takes milliseconds, too long for a tick.

    Blocks overlap, and an event counts in the block that it starts in, so the count is that of the whole signal.
    """

    def __init__(self, find: FindEvents, rate_hz: float, worker: Executor) -> None:
        self._find, self._rate_hz, self._worker = find, rate_hz, worker
        self._block, self._margin = round(_BLOCK_S * rate_hz), round(_MARGIN_S * rate_hz)
        self._values: list[float] = []
        self._before = 0  # leading values, which belong to the block before
        self._counted = 0  # events of whole blocks; used by the worker
        self._search: Future[int] | None = None
        self._whole: Future[int] | None = None  # count up to the end of the block before
        self._wanted = False
        self._so_far = 0

    @property
    def so_far(self) -> int:
        """Events up to the newest search of the unfinished block; requests another. From any thread; never blocks."""
        self._wanted = True
        return self._so_far

    def add(self, value: float) -> None:
        self._values.append(value)
        if self._wanted and (self._search is None or self._search.done()):
            self._wanted = False
            self._search = self._submit(len(self._values))
        last = self._before + self._block
        if len(self._values) >= last + self._margin:
            if self._whole is not None:
                self._whole.result()  # does not block in real time: it had twenty seconds
            self._whole = self._submit(last, whole=True)
            self._values, self._before = self._values[last - self._margin :], self._margin

    def total(self) -> int:
        """Return the events so far, with the unfinished block. Blocks while it is searched."""
        return self._submit(len(self._values)).result()

    def _submit(self, last: int, whole: bool = False) -> Future[int]:
        block = (np.array(self._values), self._before, last, whole)
        try:
            return self._worker.submit(self._count, *block)
        except RuntimeError:  # the interpreter shuts down, and the worker with it, while the head comes to rest
            found = Future[int]()
            found.set_result(self._count(*block))
            return found

    def _count(self, values: Doubles, first: int, last: int, whole: bool) -> int:
        """Search a block and return the events so far. Runs in the worker, after the blocks before."""
        starts = [max(0, round(start_s * self._rate_hz)) for start_s, _, _ in self._find(values, self._rate_hz)]
        self._so_far = self._counted + sum(first <= start < last for start in starts)
        if whole:
            self._counted = self._so_far
        return self._so_far


class RunLog:
    """Figures that the loop records and that are read at the end.

    Other threads may read the quantiles, and `so_far` of `counters`. `period_s`: period of a tick.
    """

    def __init__(self, joints: Sequence[str], period_s: float, audit: CommandAudit) -> None:
        self.joints, self.period_s, self.audit = joints, period_s, audit
        self.pace = TickPace()
        self.ticks = self.late = self.skipped = self.eased = self.refused_plans = 0
        self.frames = 0
        self.judged_frames = 0  # frames with known attention
        self.attentive_frames = 0
        self.late_ms, self.frame_to_wire_ms, self.speech_to_wire_ms = Quantiles(), Quantiles(), Quantiles()
        self.listened_s = 0.0
        self.audited: Any = None  # the state of the audit
        self.state: Any = None  # last state of the loop, with the counters of timeline and limiter
        self.torque_unconfirmed: list[str] = []  # joints whose torque came on and is not confirmed off
        self.detached: Mapping[str, str] = {}  # observers that raised
        self.reported: Sequence[str] = ()  # lost parts that log their own loss
        self.states = deque[tuple[float, RunState]](maxlen=STATES)
        self.state_s = defaultdict[str, float](float)
        self._low_rad = np.full(len(joints), np.inf)  # (J,), as the next two
        self._high_rad = -self._low_rad
        self._travel_rad = np.zeros(len(joints))
        self._last_rad: Doubles | None = None
        self._worked_s = 0.0  # processor time of the loop's thread so far
        self._waiting = deque[Plan](maxlen=_REMEMBERED)
        self._speech_s = deque[float](maxlen=_REMEMBERED)
        worker = ThreadPoolExecutor(1, "event counter")
        worker.submit(int).result()  # start its thread before the loop's thread gets real-time priority
        rate_hz = 1.0 / period_s
        self.counters = {name: EventCounter(kind.find, rate_hz, worker) for name, kind in MOTION_EVENTS.items()}

    def start(self, held_rad: Doubles) -> None:
        """Start the audit where torque came on, `held_rad` (J,)."""
        self.audited = self.audit.start(held_rad)

    def restart(self, joints: Bools, held_rad: Doubles) -> None:
        """Restart the audit of some `joints` (J,) that were away and hold `held_rad` (J,) now."""
        self.audited = self.audit.restart(joints, held_rad, self.audited)

    def heard(self, frame: SpeakerFrame) -> None:
        self.frames += 1
        if frame.attention is not None:
            self.judged_frames += 1
            self.attentive_frames += frame.attention > ATTENTIVE
        if len(frame.audio) and float(np.sqrt(np.mean(frame.audio**2))) > SPEECH_RMS:
            self._speech_s.append(frame.time_s)

    def entered(self, state: RunState, now_s: float) -> None:
        """Record the run's state from `now_s` on."""
        before: tuple[str, ...] = ()
        if self.states:
            since_s, last = self.states[-1]
            before = last.why
            self.state_s[last.name] += now_s - since_s
            if last.name == "halted" and state.name == "starting":
                logger.info("halt released")
        self.states.append((now_s, state))
        reported = {"listener", *self.joints, *self.reported}  # each of these logs its own line, with the reason
        level = logging.WARNING if set(state.why) - reported - set(before) else logging.INFO
        logger.log(level, "%s%s", state.name, f": {', '.join(state.why)}" if state.why else "")

    def ended(self, now_s: float, error: Exception | None) -> None:
        """Record the last state of the run, after torque went off."""
        before = self.states[-1][1] if self.states else RunState("stopping")
        self.entered(before.ended(now_s, None if error is None else str(error)), now_s)

    def planned(self, plan: Plan) -> None:
        self._waiting.append(plan)

    def commanded(self, tick: TickTime, goals_rad: Doubles, asked_rad: Doubles, motion: Floats | None = None) -> None:
        """Record the goals (J,) of the limiter for a reference (J,), sent or not.

        `motion`: the face (58,) that the reference shows; None on the way to rest.
        """
        late_s = tick.late_s + tick.skipped * self.period_s
        self.ticks += 1
        self.late += late_s > LATE_SHARE * self.period_s
        self.late_ms.add(late_s * 1e3)
        before_s, self._worked_s = self._worked_s, time.thread_time()
        self.pace.judge(tick.time_s, late_s, self._worked_s - before_s)
        self.skipped += tick.skipped
        self.audited = self.audit.step(goals_rad, asked_rad, self.audited)
        self._low_rad = np.minimum(self._low_rad, goals_rad)
        self._high_rad = np.maximum(self._high_rad, goals_rad)
        if self._last_rad is not None:
            self._travel_rad = self._travel_rad + np.abs(goals_rad - self._last_rad)
        self._last_rad = goals_rad
        if motion is None:
            self.eased += 1
            return
        self.listened_s = tick.time_s
        for name, kind in MOTION_EVENTS.items():
            self.counters[name].add(float(kind.signal(motion)))

    def wrote(self, wire_s: float, reach_s: float) -> None:
        """Record that a command was on the wire at `wire_s`; it played the timeline up to `reach_s`."""
        while self._waiting and self._waiting[0].times_s[0] <= reach_s:
            made_at_s = self._waiting.popleft().made_at_s
            self.frame_to_wire_ms.add(max(0.0, wire_s - made_at_s) * 1e3)
            while self._speech_s and self._speech_s[0] <= made_at_s:
                first_sample_s = self._speech_s.popleft() - FRAME_S
                self.speech_to_wire_ms.add(max(0.0, wire_s - first_sample_s) * 1e3)

    def attention_report(self) -> dict[str, float | int | None]:
        """Return `attention` of the report: share of the judged frames in which the person looks at the head."""
        share = round(self.attentive_frames / self.judged_frames, 4) if self.judged_frames else None
        return {"share": share, "frames": self.judged_frames}

    def joint_report(self) -> dict[str, dict[str, float]]:
        """Return `joints` of the report: range of the goals of every joint, and the way that they travelled."""
        if self._last_rad is None:
            return {}
        ways = np.stack([self._low_rad, self._high_rad, self._travel_rad], axis=1).round(5).tolist()
        return {
            name: dict(zip(("min_rad", "max_rad", "travel_rad"), each, strict=True))
            for name, each in zip(self.joints, ways, strict=True)
        }
