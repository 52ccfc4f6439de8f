"""A listener in a child process: the same `step`, frames one way, plans the other. Both ends are in this file.

In one process, networks and the servo loop would share a lock, and ticks would be late by tens of milliseconds. So the
child owns the model and its threads (cores - 1 at most), and the servo process loads neither torch nor onnxruntime.

While the head eases in, the loaded listener tries whether more than one thread is faster, and measures the duration of
a plan on this machine. From that, and from the delay of the source over half a second, the parent chooses the hop.
Every ten seconds the choice is compared with newer measurements: a hop that does not fit any more is replaced by a
shorter one, never by a longer one, so that it settles.

`processes.LIMITS["listener"]` sets when a child counts as hung and when it is restarted. Signs of life:

    starting, loading   processor time of its main thread: loading from a slow disk uses some all the time, a child that
                        is stopped or waits for a lock uses none. If the system does not report it, always alive.
    running             an answer to each frame

    parent -> child     (name, seed, calmness, engine), then one SpeakerFrame after another; between them an
                        int: the hop, which the child waits for and which may change; at any time another Calmness
    child -> parent     (kind, value)
        loaded          the listener is loaded; value names its engine
        probed          value is a `Probe`; the child waits for its hop
        ready           the child listens
        step            a frame was processed; value is a `thread.Stepped`
        error           the child cannot listen; value is the reason
"""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from sfms_robot.config.hop import HopChoice, Latencies, Probe, choose_hop
from sfms_robot.config.listener import Calmness
from sfms_robot.errors import ModelError, RobotError
from sfms_robot.frames import FRAME_HZ, FRAME_S, SILENCE, Plan, SpeakerFrame
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.thread import CLOSE_LIMIT_S, MOST_WAITING, Inbox, Lateness, Stepped, listen
from sfms_robot.ports import Facts, Listener
from sfms_robot.processes import LIMITS, START_LIMIT_S, Child, Ended, ParentPipe, Supervised, cores, give_way
from sfms_robot.signals.quantiles import Quantiles

REVIEW_S: Final = 10.0
SETTLED_FRAMES: Final = FRAME_HZ // 2  # after this many frames a source has measured its delay
_LOOK_S: Final = 0.1  # longest time between two checks of a child that loads, while nothing else runs
# Names of phases in statistics.
_STATES: Final = {"backing off": "starting", "loading": "building", "running": "listening"}

NICE: Final = 5  # lower priority than the servo loop, which needs a core for a fraction of a millisecond, but at once
AWAKE_S: Final = 0.02
PROBE_S: Final = 0.5
PROBE_PLANS: Final = 12

log = logging.getLogger(__name__)


class ListenerProcess:
    """A `ports.PlanFeed` over a child process that starts at once; `wait_loaded` waits until it is loaded.

    Args:
        name: as for `registry.load_listener`: a shipped listener, a folder, or a kind of another package.
        seed: seed of the stream.
        calmness: rates of the events of a listener that decides them.
        engine: engine that computes its networks.
        clock: returns seconds, for `wait_loaded`; `push` and `poll` get the time as an argument.
    """

    def __init__(
        self,
        name: str,
        seed: int,
        calmness: Calmness | None = None,
        engine: EngineName = "auto",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name, self._calmness, self._wanted, self._clock = name, calmness, engine, clock
        self._seeds = itertools.count(seed)  # a restarted child gets another seed
        self._engine: str | None = None
        self._step_ms = Quantiles()
        self._skipped = self._pushed = 0
        self._worked_ns = 0
        self._answered = False  # since the last check
        self._failure: str | None = None
        self._latencies: Callable[[Probe], Latencies] | None = None
        self._choice: HopChoice | None = None
        self._probed: Probe | None = None  # the measurements that the current choice is based on
        self._review_s = math.inf
        self._supervised = Supervised("listener", LIMITS["listener"], self._start)

    def calm(self, calmness: Calmness) -> None:
        """Use other rates from the next frames on. Never blocks; a listener that decides no events ignores them."""
        self._calmness = calmness
        self._supervised.child.send(calmness)

    def wait_loaded(self, limit_s: float = START_LIMIT_S) -> None:
        """Block until the listener is loaded, and restart a child that hangs.

        Raises ModelError with the child's own message if it cannot be loaded.
        """
        began_s = self._clock()
        while self._supervised.phase in ("starting", "backing off") and self._clock() - began_s <= limit_s:
            message = self._supervised.child.receive(_LOOK_S)
            if message is not None:
                self._take(message, began_s)
            if self._failure is not None:
                self.close()
                raise ModelError(self._failure)
            self._check(self._clock())
        if self._supervised.phase not in ("loading", "running"):
            self.close()
            raise ModelError(f"the listener process was not loaded after {limit_s:g} s")

    def choose_hop_by(self, source_latency_s: Callable[[], float], lead_s: float, tick_s: float) -> None:
        """Choose the hop once the duration of a plan here is known. Without this call the listener keeps its own.

        Args:
            source_latency_s: returns the current delay of the source.
            lead_s: longest lead of a joint.
            tick_s: period of the loop.
        """
        self._latencies = lambda probe: Latencies(
            horizon=probe.horizon,
            source_s=source_latency_s(),
            step_p50_s=probe.step_p50_s,
            step_p99_s=probe.step_p99_s,
            lead_s=lead_s,
            tick_s=tick_s,
        )

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        """Send a frame. Never blocks; of frames that a child does not read, the oldest are dropped and counted."""
        if self._supervised.phase not in ("loading", "running"):
            return
        self._pushed += 1
        self._send_hop()
        self._lateness.gave(frame, now_s)
        dropped = self._supervised.child.offer(frame)
        self._skipped += dropped
        self._unanswered += 1 - dropped

    def poll(self, now_s: float) -> Sequence[Plan]:
        """Return plans that have arrived. Never blocks, never raises: a child that died or hangs is restarted."""
        plans = []
        while (message := self._supervised.child.receive()) is not None:
            plan = self._take(message, now_s)
            if plan is not None:
                plans.append(plan)
        self._check(now_s)
        self._review(now_s)
        return plans

    @property
    def lost(self) -> bool:
        """Return whether the listener hangs, restarts, was given up, or is always too late."""
        return self._supervised.away or self._lateness.lasting

    def statistics(self) -> Facts:
        """Return `state` (starting, building, listening, late, hung, given up), `engine` in words, `restarts`,
        `skipped_frames`, `step_ms`, `hop` and `budget_ms` (see `config.hop`), None as long as no hop was chosen.
        """
        phase = self._supervised.phase
        state = "hung" if self._supervised.hung else self._lateness.named(_STATES.get(phase, phase))
        return {
            "state": state,
            "engine": self._engine,
            "restarts": self._supervised.restarts,
            "skipped_frames": self._skipped,
            "step_ms": self._step_ms.report(p50=50, p99=99),
            "hop": self._choice and self._choice.hop,
            "budget_ms": self._choice and self._choice.budget_ms,
        }

    def close(self) -> None:
        """End the child; blocks for twice `CLOSE_LIMIT_S` at most. Idempotent."""
        self._supervised.child.close(CLOSE_LIMIT_S)

    def _start(self) -> Child:
        self._unanswered = 0
        self._probe: Probe | None = None  # the probe that is to be answered with a hop
        self._lateness = Lateness()
        order = (self._name, next(self._seeds), self._calmness, self._wanted)
        return Child(f"{__name__}:main", order, name="listener", kept=MOST_WAITING)

    def _take(self, message: Any, now_s: float) -> Plan | None:
        if isinstance(message, Ended):
            self._failure = f"the listener process died (exit code {message.code})"
            return None
        kind, value = message
        if kind == "error":
            self._failure = value
        elif kind == "loaded":
            self._engine = value
            self._supervised.enter("loading")
        elif kind == "probed":
            self._probe = value
            self._send_hop()
        elif kind == "ready":
            self._supervised.enter("running")
            self._review_s = now_s + REVIEW_S
        else:
            answer: Stepped = value
            if answer.left_out and not self._skipped:
                log.warning("the listener is slower than the person: it leaves frames out to keep up")
            self._skipped += answer.left_out
            self._unanswered = max(0, self._unanswered - 1 - answer.left_out)
            self._answered = True
            if answer.plan is not None:
                self._step_ms.add(answer.taken_ms)
                self._lateness.came(answer.plan, now_s)
            return answer.plan
        return None

    def _check(self, now_s: float) -> None:
        if self._probe is not None:
            self._supervised.phase_s = 0.0  # the child waits for its hop
        if self._supervised.phase == "running":
            alive = self._answered or not self._unanswered
        else:
            before_ns, self._worked_ns = self._worked_ns, self._supervised.child.worked_ns()
            alive = not self._worked_ns or self._worked_ns != before_ns
        self._answered, failure, self._failure = False, self._failure, None
        self._supervised.check(now_s, alive, failure)

    def _send_hop(self) -> None:
        """Answer a probe with a hop, as soon as the source has settled."""
        probe = self._probe
        if probe is None or (self._latencies is not None and self._pushed < SETTLED_FRAMES):
            return
        self._probe = None
        if self._latencies is None:
            self._supervised.child.send(probe.hop)
            return
        before, self._choice = self._choice, choose_hop(probe.hops, self._latencies(probe))
        self._probed = probe
        self._supervised.child.send(self._choice.hop)
        if self._choice.given_up and (before is None or before.given_up is None):
            log.warning(
                "this computer is slow for the listener, which plans every %d frames of 40 ms: %s",
                self._choice.hop,
                self._choice.given_up,
            )

    def _review(self, now_s: float) -> None:
        """Choose a shorter hop if the current one does not fit the newest measurements."""
        if now_s < self._review_s or self._supervised.phase != "running":
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
                self._supervised.child.send(choice.hop)


# --- Child ------------------------------------------------------------------------------------------------------------


def main() -> None:
    """Load the listener of the first message, then listen until the pipe ends."""
    parent, inbox = ParentPipe(), Inbox()
    name, seed, calmness, engine = parent.receive()

    def sort(message: int | Calmness | SpeakerFrame) -> None:
        if isinstance(message, int):
            inbox.hop = message
        elif isinstance(message, Calmness):
            inbox.calmness = message
        else:
            inbox.put(message)

    parent.forward(sort)
    give_way(NICE)
    try:
        from sfms_robot.listeners.registry import at_hop, engine_name, hops_of, load_listener

        listener = load_listener(name, calmness=calmness, engine=engine, threads=1)
        parent.send(("loaded", engine_name(listener)))
        hops = hops_of(listener)
        quickest = at_hop(listener, min(hops))
        if use_threads(quickest, threads()):
            parent.send(("loaded", engine_name(listener)))
        p50_s, p99_s = plan_times_s(quickest)
        probe = Probe(horizon=listener.horizon, hop=listener.hop, hops=hops, step_p50_s=p50_s, step_p99_s=p99_s)
        parent.send(("probed", probe))
    except RobotError as error:
        parent.send(("error", str(error)))
        return
    while inbox.hop is None:  # wakes repeatedly: a child that uses no processor time counts as hung
        time.sleep(AWAKE_S)
    listen(listener, seed, inbox, parent.send)


def threads() -> int:
    """Return the number of threads that the child may use: one core is left to the servo loop."""
    return max(1, cores() - 1)


def use_threads(listener: Listener, most: int) -> bool:
    """Set a listener's networks to one thread or `most`, whichever is faster here; return True for `most`.

    Blocks for half of `PROBE_S` for each of the two, if there is a choice.
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
    """Return median and 99th percentile of the duration of a plan, on silence; of all steps if no plan was made.

    Steps come at the pace of a run: caches are overwritten between two frames, and a plan takes half as long again.
    Blocks for `limit_s`, or `PROBE_PLANS` plans, and one step more.
    """
    memory = listener.start(0)
    planned_s: list[float] = []
    other_s: list[float] = []
    began_s = time.perf_counter()
    while len(planned_s) < PROBE_PLANS and (not other_s + planned_s or time.perf_counter() - began_s < limit_s):
        step_s = time.perf_counter()
        plan, memory = listener.step(SpeakerFrame((len(planned_s) + len(other_s) + 1) * FRAME_S, SILENCE), memory)
        taken_s = time.perf_counter() - step_s
        (other_s if plan is None else planned_s).append(taken_s)
        wait(max(0.0, FRAME_S - taken_s))
    p50_s, p99_s = np.percentile(planned_s or other_s, [50, 99])
    return float(p50_s), float(p99_s)
