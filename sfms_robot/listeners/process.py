"""A listener in a process of its own: the same `step`, frames one way, plans the other, over two pipes.

In one process networks and the servo loop share a lock, and ticks slip by tens of milliseconds. So the child owns the
model and its threads (cores - 1 at most), and the servo process loads neither torch nor onnxruntime for it. It ends
when its pipe does, so it never outlives its parent, whatever killed that.

The child says of every frame that it is done. Until it listens, its main thread's processor time is the sign of life:
loading from a slow disk uses some all the time, a child that is stopped or waits for a lock uses none. A child without
a sign for `HUNG_S` is named as hung, and restarted after the limit of its phase; the head continues without it. After
`RESTARTS` in a minute it stays down.

    phase      no sign of life           restarted after it lasts    or after, in all
    starting   no processor time         `LOAD_RESTART_S`            `PHASE_LIMIT_S`
    building   no processor time         `RESTART_S`                 `PHASE_LIMIT_S`
    listening  an answer is due          `RESTART_S`                 -

Where the system does not report processor time (`_Child.worked_ns`), only `PHASE_LIMIT_S` limits the first two.

What a slow machine did not hear (`inbox`) is counted, and said once.

By what a plan takes on this machine, which the child measures (`process_child`), and by how late the source has been
for half a second, its hop is chosen. Every ten seconds the choice is held against what has been measured since: a hop
that does not fit any more gives way to a shorter one, and never to a longer one, so that it settles.

    parent -> child    pickle: (name, seed, calmness, engine), then SpeakerFrame after SpeakerFrame; between them an
                       int: the hop, which it waits for and which may change; at any time another Calmness
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
import pickle
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from sfms_robot.child_process import end_child, messages, start_child
from sfms_robot.config.hop import HopChoice, Latencies, Probe, choose_hop
from sfms_robot.config.listener import Calmness
from sfms_robot.errors import ModelError
from sfms_robot.frames import FRAME_HZ, Plan, SpeakerFrame
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.inbox import MOST_WAITING
from sfms_robot.signals.quantiles import Quantiles

START_LIMIT_S: Final = 60.0  # importing torch on a small board with a cold disk
CLOSE_LIMIT_S: Final = 0.2
HUNG_S: Final = 1.0
RESTART_S: Final = 3.0
LOAD_RESTART_S: Final = 10.0  # starting: a listener of another package may wait for a network or a device
PHASE_LIMIT_S: Final = START_LIMIT_S  # a child that computes and gets nowhere
RESTARTS: Final = 5  # in a minute; more than that is no accident
REVIEW_S: Final = 10.0
_LOOK_S: Final = 0.1  # at a child that loads, while nothing else runs
SETTLED_FRAMES: Final = FRAME_HZ // 2  # after so many a source has measured how late it is
_MINUTE_S: Final = 60.0

log = logging.getLogger(__name__)


class ListenerProcess:
    """`ports.PlanFeed` over a child process that starts at once; `wait_loaded` waits until it can be relied upon.

    Args:
        name: what `registry.load_listener` takes: a shipped listener, a folder, or a kind of another package.
        seed: of the stream.
        calmness: how often a listener that decides events does what.
        engine: what its networks are computed by.
        clock: seconds, for `wait_loaded`; `push` and `poll` are given theirs.
    """

    def __init__(
        self,
        name: str,
        seed: int,
        calmness: Calmness | None = None,
        engine: EngineName = "auto",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name, self._seed, self._calmness, self._wanted = name, seed, calmness, engine
        self._engine: str | None = None
        self._step_ms = Quantiles()
        self._lateness = Lateness()
        self._skipped = 0
        self._restarted_s: list[float] = []
        self._restarts = 0
        self._state = "starting"
        self._hung = False
        self._waits_since_s: float | None = None  # for a sign of life, or the answer to the oldest frame without one
        self._phase_since_s: float | None = None  # starting or building, other than for us
        self._worked_ns = 0
        self._clock = clock
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
        """Block until the listener is loaded, and restart a child that hangs.

        Raises ModelError with the child's own message where it cannot be loaded.
        """
        began_s = self._clock()
        while self._state == "starting" and self._clock() - began_s <= limit_s:
            message = self._child.message(_LOOK_S)
            if message is None:
                if not self._child.ended:  # one that ended has left a message why
                    self._supervise(self._clock())
            elif message[0] == "error":
                self.close()
                raise ModelError(message[1])
            else:
                self._take(*message, began_s)
        if self._state in ("starting", "given up"):
            self.close()
            raise ModelError(f"the listener process was not loaded after {limit_s:g} s")
        self._restarted_s.clear()  # times of another clock than those of `poll`

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
        """Return plans that came. Never blocks, never raises: a child that died or hangs is restarted."""
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
        """Return whether it hangs, restarts, is given up, or always comes too late."""
        away = self._state == "given up" or (self._restarts > 0 and self._state != "listening")
        return self._hung or away or self._lateness.lasting

    def statistics(self) -> Mapping[str, Any]:
        """Return `state` (starting, building, listening, late, hung, given up), `engine` in words, `restarts`,
        `skipped_frames`, `step_ms`, `hop` and `budget_ms` (see `config.hop`), None as long as no hop was chosen.
        """
        return {
            "state": "hung" if self._hung else self._lateness.named(self._state),
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
            self._waits_since_s = self._phase_since_s = None
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
        """Name a child without a sign of life, and restart it after the limit of its phase."""
        if self._state == "given up":
            return
        if self._child.ended:
            self._restart("died", now_s)
            return
        if self._state != "listening" and self._loads_too_long(now_s):
            self._restart(f"is {self._state} for {PHASE_LIMIT_S:g} s", now_s)
            return
        silent_s = 0.0 if self._waits_since_s is None else now_s - self._waits_since_s
        if silent_s > (LOAD_RESTART_S if self._state == "starting" else RESTART_S):
            self._restart(f"has not answered for {silent_s:.1f} s", now_s)
        elif (silent_s > HUNG_S) != self._hung:
            self._hung = not self._hung
            if self._hung:
                log.warning("the listener (%s) has not answered for %.1f s", self._state, silent_s)
            else:
                log.info("the listener answers again")

    def _loads_too_long(self, now_s: float) -> bool:
        """Look for a sign of life of a child that starts or builds; whether that has lasted too long in all."""
        worked_ns = self._child.worked_ns()
        if self._waits_since_s is None or not worked_ns or worked_ns != self._worked_ns:
            self._waits_since_s, self._worked_ns = now_s, worked_ns
        if self._phase_since_s is None or self._probe is not None:  # a child with a probe waits for us
            self._phase_since_s = now_s
        return now_s - self._phase_since_s > PHASE_LIMIT_S

    def _restart(self, why: str, now_s: float) -> None:
        self._child.kill()
        self._restarted_s = [at_s for at_s in self._restarted_s if now_s - at_s < _MINUTE_S]
        self._hung = False
        if len(self._restarted_s) >= RESTARTS:
            log.error("the listener %s again, %d times in a minute: the head continues without it", why, RESTARTS)
            self._state = "given up"
            return
        log.warning("the listener %s: restarted", why)
        self._restarted_s.append(now_s)
        self._restarts += 1
        self._state, self._waits_since_s, self._phase_since_s, self._unanswered = "starting", None, None, 0
        self._probe = None
        self._lateness = Lateness()
        self._child = _Child(self._name, self._seed + self._restarts, self._calmness, self._wanted)


class _Child:
    """One interpreter and its two threads; nothing here blocks except `close`, and `message` with a limit."""

    def __init__(self, name: str, seed: int, calmness: Calmness | None, engine: EngineName) -> None:
        self._process = start_child("sfms_robot.listeners.process_child:main")
        self._frames: deque[Any] = deque([(name, seed, calmness, engine)])
        self._urgent: deque[int | Calmness] = deque()
        self._changed = threading.Condition()
        self._messages: queue.SimpleQueue[tuple[str, Any, float]] = queue.SimpleQueue()
        self.ended = False
        self._closing = False
        self._named = False  # what to load was sent: it goes before all
        self._threads = [
            threading.Thread(target=work, name=f"listener {work.__name__}", daemon=True)
            for work in (self._write, self._read)
        ]
        for thread in self._threads:
            thread.start()

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

    def message(self, limit_s: float = 0.0) -> tuple[str, Any, float] | None:
        """Return the next message, or None when none comes within `limit_s`."""
        try:
            return self._messages.get(timeout=limit_s)
        except queue.Empty:
            return None

    def worked_ns(self) -> int:
        """Return the processor time of its main thread so far; 0 where the system (Linux) does not report it."""
        try:
            return int(Path(f"/proc/{self._process.pid}/schedstat").read_text().split()[0])
        except (OSError, ValueError):
            return 0

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
        # It may have died, which the reader sees too, and says so. What could not be sent is dropped with the pipe:
        # `close` fails over it once more, and has closed the file all the same.
        with suppress(BrokenPipeError, OSError, ValueError), closing(pipe):
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._closing or self._frames or (self._urgent and self._named))
                    if self._closing:
                        break
                    item = (self._urgent if self._urgent and self._named else self._frames).popleft()
                    self._named = True
                pickle.dump(item, pipe, protocol=5)
                pipe.flush()

    def _read(self) -> None:
        pipe = self._process.stdout
        assert pipe is not None
        with pipe:
            for message in messages(pipe):
                self._messages.put(message)
            code = self._process.wait()
        self._messages.put(("error", f"the listener process died (exit code {code})", 0.0))
        self.ended = True


# --- Lateness ---------------------------------------------------------------------------------------------------------
#
# A listener on a computer that is too slow answers, and always too late to be shown.

LATE_S: Final = 1.0


class Lateness:
    """A judge of plans: in time to be shown, or not.

    Attributes:
        lasting: for `LATE_S` every plan has come after the last of its own frames. The first one in time ends it.
    """

    def __init__(self) -> None:
        self.lasting = False
        self._since_s: float | None = None  # of the first late one in a row

    def named(self, state: str) -> str:
        """Return "late" for a listening state whose plans are never in time, else `state`."""
        return "late" if self.lasting and state == "listening" else state

    def came(self, plan: Plan, now_s: float) -> None:
        """Take a plan that arrived at `now_s`, by the clock of its frames."""
        if now_s <= plan.times_s[-1]:
            if self.lasting:
                log.warning("the listener's plans are in time again")
            self.lasting, self._since_s = False, None
            return
        self._since_s = now_s if self._since_s is None else self._since_s
        if not self.lasting and now_s - self._since_s >= LATE_S:
            log.warning("the listener's plans come too late to be shown: the head goes on without them")
            self.lasting = True
