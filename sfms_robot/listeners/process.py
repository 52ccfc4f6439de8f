"""A listener in a process of its own: the same `step`, frames one way, plans the other, over two pipes.

In one process networks and the servo loop share a lock, and ticks slip by tens of milliseconds. So the child owns the
model and its threads (cores - 1 at most), and the servo process loads neither torch nor onnxruntime for it. It ends
when its pipe does, so it never outlives its parent, whatever killed that.

The child says of every frame that it is done. One that is silent for `HUNG_S` is named as hung; after `RESTART_S`, or
when it died, it is started anew and listens from then on, while the head goes on by itself. Too many of those in a
minute and it stays down.

A machine that cannot keep up must not answer what was said seconds ago: when more than half a second is waiting, the
listener goes on at the newest frame. What it did not hear is counted, and said once.

A listener that is loaded is not yet fast: it builds its graphs while the head eases in, tries whether more than one
thread is faster, and measures what a plan takes on this machine. By that, and by how late the source has been for half
a second, its hop is chosen. What it did not hear meanwhile it hears then, as fast as it can. Every ten seconds the
choice is held against what has been measured since: a hop that does not fit any more gives way to a shorter one, and
never to a longer one, so that it settles.

    parent -> child    pickle: (name, seed, calmness, engine), then SpeakerFrame after SpeakerFrame; between them an
                       int: the hop, which it waits for and which may change; whenever somebody asks for it, another
                       Calmness
    child -> parent    pickle: (kind, value, number)
        loaded         nothing is wrong with it; value names its engine
        probed         value is a `Probe`; it waits for its hop
        ready          it listens
        done, plan     a frame was taken; for a plan, value is the answer and number the ms that it took
        skipped        number frames were left out
        error          it cannot listen, and value says why
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import IO, Any, Final

import numpy as np

from sfms_robot.child_process import end_child, messages, start_child, take_pipes
from sfms_robot.config.calmness import Calmness
from sfms_robot.config.hop import HopChoice, Latencies, choose_hop
from sfms_robot.errors import ModelError, RobotError
from sfms_robot.frames import FRAME_HZ, FRAME_S, FRAME_SAMPLES, Plan, SpeakerFrame
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.lateness import Lateness
from sfms_robot.ports import Listener
from sfms_robot.signals.quantiles import Quantiles

MOST_WAITING: Final = FRAME_HZ // 2  # frames
CATCH_UP: Final = 0.5  # frames that must be waiting less after each, while it catches up: twice the person's pace
NICE: Final = 5  # below the servo loop, which needs a core for a fraction of a millisecond, but at once
START_LIMIT_S: Final = 60.0  # importing torch on a small board with a cold disk
CLOSE_LIMIT_S: Final = 0.2
HUNG_S: Final = 1.0
RESTART_S: Final = 3.0
RESTARTS: Final = 5  # in a minute; more than that is no accident
PROBE_S: Final = 0.5
PROBE_PLANS: Final = 12
REVIEW_S: Final = 10.0
SETTLED_FRAMES: Final = FRAME_HZ // 2  # after so many a source has measured how late it is
_MINUTE_S: Final = 60.0

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Probe:
    """What a listener measured of itself: frames of a plan, hops that it can be run with, and what a plan takes."""

    horizon: int
    hop: int
    hops: tuple[int, ...]
    step_p50_s: float
    step_p99_s: float


class ListenerProcess:
    """`ports.PlanFeed` over a child process that starts at once; `wait_loaded` waits until it can be relied upon.

    Args:
        name: what `registry.load_listener` takes: a shipped listener, a folder, or a kind of another package.
        seed: of the stream.
        calmness: how often a listener that decides events does what.
        engine: what its networks are computed by.
    """

    def __init__(self, name: str, seed: int, calmness: Calmness | None = None, engine: EngineName = "auto") -> None:
        self._name, self._seed, self._calmness, self._wanted = name, seed, calmness, engine
        self._engine: str | None = None
        self._step_ms = Quantiles()
        self._lateness = Lateness()
        self._skipped = 0
        self._restarted_s: list[float] = []
        self._restarts = 0
        self._state = "starting"
        self._waits_since_s: float | None = None  # for the answer to the oldest frame that has none yet
        self._unanswered = 0
        self._latencies: Callable[[Probe], Latencies] | None = None
        self._probe: Probe | None = None  # that is to be answered with a hop
        self._choice: HopChoice | None = None
        self._probed: Probe | None = None  # what the choice in force was made by
        self._review_s = math.inf
        self._pushed = 0
        self._child = _Child(name, seed, calmness, engine)

    def calm(self, calmness: Calmness) -> None:
        """From the next frames on. Never blocks; a listener that decides nothing takes no notice."""
        self._calmness = calmness
        self._child.tell(calmness)

    def wait_loaded(self, limit_s: float = START_LIMIT_S) -> None:
        """Block until the listener is loaded. Raises ModelError with its own message when it cannot be."""
        if self._state != "starting":
            return
        kind, value, _ = self._child.next(limit_s)
        if kind == "loaded":
            self._state, self._engine = "building", value
            return
        self.close()
        raise ModelError(value or f"the listener process was not loaded after {limit_s:g} s")

    def choose_hop_by(self, source_latency_s: Callable[[], float], lead_s: float, tick_s: float) -> None:
        """Choose the hop when it is known what a plan takes here, for a source that is so late, a loop of `tick_s` and
        leads up to `lead_s`. Without this call the listener keeps its own.
        """
        self._latencies = lambda probe: Latencies(
            probe.horizon, source_latency_s(), probe.step_p50_s, probe.step_p99_s, lead_s, tick_s
        )

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        """Never blocks; what a child that does not listen leaves behind is dropped, oldest first, and counted."""
        if self._state in ("starting", "given up"):
            return
        self._pushed += 1
        self._tell_hop()
        self._skipped += self._child.send(frame)
        self._unanswered += 1
        self._waits_since_s = now_s if self._waits_since_s is None else self._waits_since_s

    def poll(self, now_s: float) -> Sequence[Plan]:
        """Plans that came. Never blocks, never raises: a child that died or hangs is started anew."""
        plans = []
        while (message := self._child.message()) is not None:
            plan = self._take(*message, now_s)
            if plan is not None:
                plans.append(plan)
        self._supervise(now_s)
        self._review(now_s)
        return plans

    @property
    def lost(self) -> bool:
        """Hung, being started anew, given up, or always too late."""
        away = self._state in ("hung", "given up") or (self._restarts > 0 and self._state != "listening")
        return away or self._lateness.lasting

    def statistics(self) -> Mapping[str, Any]:
        """`state` (starting, building, listening, late, hung, given up), `engine` in words, `restarts`,
        `skipped_frames`, `step_ms`, `hop` and `budget_ms` (see `config.hop`), None as long as no hop was chosen.
        """
        return {
            "state": self._lateness.named(self._state),
            "engine": self._engine,
            "restarts": self._restarts,
            "skipped_frames": self._skipped,
            "step_ms": self._step_ms.report(p50=50, p99=99),
            "hop": None if self._choice is None else self._choice.hop,
            "budget_ms": None if self._choice is None else self._choice.budget_ms,
        }

    def close(self) -> None:
        """End the child; blocks for `CLOSE_LIMIT_S` at most. Idempotent."""
        self._child.close()

    def _take(self, kind: str, value: Any, number: float, now_s: float) -> Plan | None:
        if kind == "error":
            log.error("the listener cannot go on: %s", value)
        elif kind == "skipped":
            if not self._skipped:
                log.warning("the listener is slower than the person: it leaves frames out to keep up")
            self._skipped += int(number)
            self._answered(int(number), now_s)
        elif kind == "loaded":
            self._state, self._engine = "building", value
        elif kind == "probed":
            self._probe = value
            self._tell_hop()
        elif kind == "ready":
            if self._restarts:
                log.warning("the listener is back")
            self._state, self._waits_since_s = "listening", now_s if self._unanswered else None
            self._review_s = now_s + REVIEW_S
        else:
            self._answered(1, now_s)
            if self._state == "hung":
                log.warning("the listener goes on")
                self._state = "listening"
            if kind == "plan":
                self._step_ms.add(number)
                self._lateness.came(value, now_s)
                return value  # type: ignore[no-any-return]
        return None

    def _tell_hop(self) -> None:
        """Answer a probe, as soon as that can be."""
        probe = self._probe
        if probe is None or (self._latencies is not None and self._pushed < SETTLED_FRAMES):
            return
        self._probe = None
        if self._latencies is None:
            self._child.tell(probe.hop)
            return
        before, self._choice = self._choice, choose_hop(probe.hops, self._latencies(probe))
        self._probed = probe
        self._child.tell(self._choice.hop)
        if self._choice.given_up and (before is None or before.given_up is None):
            log.warning("a plan every %d frames: %s", self._choice.hop, self._choice.given_up)

    def _review(self, now_s: float) -> None:
        """A shorter hop, where the one in force does not fit what is measured by now."""
        if now_s < self._review_s or self._state != "listening":
            return
        self._review_s = now_s + REVIEW_S
        if self._choice is None or self._probed is None or self._latencies is None or not len(self._step_ms):
            return
        hop, steps_s = self._choice.hop, [self._step_ms.at(percent) * 1e-3 for percent in (50, 99)]
        measured = self._latencies(replace(self._probed, step_p50_s=steps_s[0], step_p99_s=steps_s[1]))
        if not measured.fits(hop):
            choice = choose_hop([each for each in self._probed.hops if each <= hop], measured)
            if choice.hop != hop:
                log.info("a plan every %d frames, %d before, by what is measured", choice.hop, hop)
                self._choice = choice
                self._child.tell(choice.hop)

    def _answered(self, frames: int, now_s: float) -> None:
        self._unanswered = max(0, self._unanswered - frames)
        self._waits_since_s = now_s if self._unanswered else None

    def _supervise(self, now_s: float) -> None:
        if self._state == "given up":
            return
        if self._child.ended:
            self._restart("died", now_s)
        elif self._state in ("listening", "hung") and self._waits_since_s is not None:
            silent_s = now_s - self._waits_since_s
            if silent_s > RESTART_S:
                self._restart(f"has not answered for {silent_s:.1f} s", now_s)
            elif silent_s > HUNG_S and self._state != "hung":
                log.warning("the listener has not answered for %.1f s", silent_s)
                self._state = "hung"

    def _restart(self, why: str, now_s: float) -> None:
        self._child.kill()
        self._restarted_s = [at_s for at_s in self._restarted_s if now_s - at_s < _MINUTE_S]
        if len(self._restarted_s) >= RESTARTS:
            log.error("the listener %s again, %d times in a minute: the head goes on without it", why, RESTARTS)
            self._state = "given up"
            return
        log.warning("the listener %s: started anew", why)
        self._restarted_s.append(now_s)
        self._restarts += 1
        self._state, self._waits_since_s, self._unanswered, self._probe = "starting", None, 0, None
        self._lateness = Lateness()
        self._child = _Child(self._name, self._seed + self._restarts, self._calmness, self._wanted)


class _Child:
    """One interpreter, and the two threads that talk to it; nothing here blocks but `next` and `close`."""

    def __init__(self, name: str, seed: int, calmness: Calmness | None, engine: EngineName) -> None:
        self._process = start_child("sfms_robot.listeners.process:main")
        self._frames: deque[Any] = deque([(name, seed, calmness, engine)])
        self._urgent: deque[int | Calmness] = deque()
        self._changed = threading.Condition()
        self._messages: queue.SimpleQueue[tuple[str, Any, float]] = queue.SimpleQueue()
        self.ended = False
        self._closing = False
        self._named = False  # what to load was sent: it goes before all
        for work in (self._write, self._read):
            threading.Thread(target=work, name=f"listener {work.__name__}", daemon=True).start()

    def send(self, frame: SpeakerFrame) -> int:
        """Queue a frame; the number of older ones dropped for it."""
        with self._changed:
            self._frames.append(frame)
            dropped = max(0, len(self._frames) - MOST_WAITING)
            for _ in range(dropped):
                self._frames.popleft()
            self._changed.notify()
        return dropped

    def tell(self, value: int | Calmness) -> None:
        """It goes before all frames that wait, and is never dropped."""
        with self._changed:
            self._urgent.append(value)
            self._changed.notify()

    def message(self) -> tuple[str, Any, float] | None:
        try:
            return self._messages.get_nowait()
        except queue.Empty:
            return None

    def next(self, limit_s: float) -> tuple[str, Any, float]:
        """The next message; ("error", None, 0) when none comes in time."""
        try:
            return self._messages.get(timeout=limit_s)
        except queue.Empty:
            return "error", None, 0.0

    def kill(self) -> None:
        """Returns at once, also where the child is stopped; the reader sees to the rest."""
        self._process.kill()
        self._hang_up()

    def close(self) -> None:
        self._hang_up()
        end_child(self._process, CLOSE_LIMIT_S)

    def _hang_up(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify()

    def _write(self) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._closing or self._frames or (self._urgent and self._named))
                    if self._closing:
                        break
                    item = (self._urgent if self._urgent and self._named else self._frames).popleft()
                    self._named = True
                pickle.dump(item, pipe, protocol=5)
                pipe.flush()
            pipe.close()
        except (BrokenPipeError, OSError, ValueError):
            return  # it died: the reader sees that too, and says so

    def _read(self) -> None:
        pipe = self._process.stdout
        assert pipe is not None
        with pipe:
            for message in messages(pipe):
                self._messages.put(message)
            code = self._process.wait()
        self._messages.put(("error", f"the listener process died (exit code {code})", 0.0))
        self.ended = True


def threads() -> int:
    """That the child may use: one core is the servo loop's."""
    return max(1, (os.cpu_count() or 2) - 1)


# --- the child ------------------------------------------------------------------------------------------------------


def main() -> None:
    """Load what the first message names, then listen until the pipe ends."""
    frames, plans = take_pipes()
    inbox, hops = Inbox(), queue.SimpleQueue[int]()
    try:
        name, seed, calmness, engine = pickle.load(frames)
    except (EOFError, pickle.UnpicklingError):
        return  # the parent ended before it said what to load
    threading.Thread(target=_receive, args=(frames, inbox, hops), daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(NICE)
    try:
        from sfms_robot.listeners.registry import at_hop, build_graphs, engine_name, hops_of, load_listener

        listener = load_listener(name, graphs=False, calmness=calmness, engine=engine, threads=1)
        _say(plans, "loaded", engine_name(listener))
        build_graphs(listener)
        choices = hops_of(listener)
        if use_threads(at_hop(listener, min(choices)), threads()):
            _say(plans, "loaded", engine_name(listener))
        p50_s, p99_s = plan_times_s(at_hop(listener, min(choices)))
        _say(plans, "probed", Probe(listener.horizon, listener.hop, tuple(choices), p50_s, p99_s))
    except RobotError as error:
        _say(plans, "error", str(error))
        return
    listen(at_hop(listener, hops.get()), seed, inbox, plans, hops)


def use_threads(listener: Listener, most: int) -> bool:
    """Let a listener's networks use one thread or `most`, whichever makes plans faster here; whether that is `most`.

    Blocks for half of `PROBE_S` each where there is a choice.
    """
    from sfms_robot.listeners.registry import engine_name, set_threads

    if most == 1 or engine_name(listener) is None:
        return False

    planned_s = {}
    for count in (1, most):
        set_threads(listener, count)
        planned_s[count], _ = plan_times_s(listener, PROBE_S / 2)
    if planned_s[1] <= planned_s[most]:
        set_threads(listener, 1)
    return planned_s[most] < planned_s[1]


def plan_times_s(
    listener: Listener, limit_s: float = PROBE_S, wait: Callable[[float], object] = time.sleep
) -> tuple[float, float]:
    """Median and 99th percentile of what a plan takes, on silence; a step without one counts where no plan was made.

    At the pace of a run: between two frames caches cool, and a plan takes half as long again. Blocks for `limit_s`, or
    `PROBE_PLANS` plans, and one step more.
    """
    silence = np.zeros(FRAME_SAMPLES, np.float32)
    memory = listener.start(0)
    planned_s: list[float] = []
    other_s: list[float] = []
    began_s = time.perf_counter()
    while len(planned_s) < PROBE_PLANS and (not other_s + planned_s or time.perf_counter() - began_s < limit_s):
        step_s = time.perf_counter()
        plan, memory = listener.step(SpeakerFrame((len(planned_s) + len(other_s) + 1) * FRAME_S, silence), memory)
        taken_s = time.perf_counter() - step_s
        (other_s if plan is None else planned_s).append(taken_s)
        wait(max(0.0, FRAME_S - taken_s))
    p50_s, p99_s = np.percentile(planned_s or other_s, [50, 99])
    return float(p50_s), float(p99_s)


def _receive(frames: IO[bytes], inbox: Inbox, hops: queue.SimpleQueue[int]) -> None:
    """Frames into the inbox. The end of the pipe is the end of this process, whatever it computes."""
    for item in messages(frames):
        if isinstance(item, int):
            hops.put(item)
        elif isinstance(item, Calmness):
            inbox.calmness = item
        else:
            inbox.put(item)
    os._exit(0)


def listen(
    listener: Listener, seed: int, inbox: Inbox, plans: IO[bytes], hops: queue.SimpleQueue[int] | None = None
) -> None:
    """One step per frame until None comes; tells when it is ready, what it answers, and what it left out."""
    from sfms_robot.listeners.registry import at_hop

    memory = listener.start(seed)
    _say(plans, "ready")
    while (frame := inbox.next()) is not None:
        if inbox.skipped:
            _say(plans, "skipped", None, inbox.skipped)
        memory = calmed(listener, memory, inbox)
        while hops is not None and not hops.empty():
            listener = at_hop(listener, hops.get())
        began_s = time.perf_counter()
        plan, memory = listener.step(frame, memory)
        taken_ms = (time.perf_counter() - began_s) * 1e3
        _say(plans, "done" if plan is None else "plan", plan, taken_ms)


def _say(plans: IO[bytes], kind: str, value: Any = None, number: float = 0.0) -> None:
    pickle.dump((kind, value, number), plans, protocol=5)
    plans.flush()


def calmed(listener: Listener, memory: Any, inbox: Inbox) -> Any:
    """The memory after what was asked for since the last frame; a listener that decides nothing takes no notice."""
    calmness, inbox.calmness = inbox.calmness, None
    change = getattr(listener, "calmed", None)
    return memory if calmness is None or change is None else change(memory, calmness)


class Inbox:
    """Frames in the order in which they came, until None does; the newest alone when too many are waiting.

    Those that came before the first one was asked for do not count as too many, as long as they become fewer at the
    pace of somebody who catches up.

    Attributes:
        skipped: frames left out before the last one given.
        calmness: asked for since `calmed` looked; None: none.
    """

    def __init__(self, most: int = MOST_WAITING) -> None:
        self._queue: queue.SimpleQueue[SpeakerFrame | None] = queue.SimpleQueue()
        self._most = most
        self._allowed: float | None = None  # to wait, while it catches up with those of before
        self._waiting: deque[SpeakerFrame | None] = deque()
        self.skipped = 0
        self.calmness: Calmness | None = None

    def put(self, frame: SpeakerFrame | None) -> None:
        self._queue.put(frame)

    def next(self) -> SpeakerFrame | None:
        """Blocks until there is one. None, the end, is neither left out nor waits for what came before it."""
        if not self._waiting:
            self._waiting.append(self._queue.get())
        while not self._queue.empty():
            self._waiting.append(self._queue.get())
        if None in self._waiting:
            return None
        waiting = len(self._waiting)
        self._allowed = waiting + self._most if self._allowed is None else self._allowed - CATCH_UP
        self.skipped = waiting - 1 if waiting > max(self._most, self._allowed) else 0
        for _ in range(self.skipped):
            self._waiting.popleft()
        return self._waiting.popleft()
