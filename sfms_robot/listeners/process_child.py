"""The child of a `ListenerProcess`: it loads what it is told, measures itself, and listens until its pipe ends.

What goes over the pipes is in `process`. A listener that is loaded is not yet fast: it builds its graphs while the head
eases in, tries whether more than one thread is faster, and measures what a plan takes on this machine. What it did not
hear meanwhile it hears then, as fast as it can.
"""

from __future__ import annotations

import os
import pickle
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any, Final

import numpy as np

from sfms_robot.child_process import cores, messages, take_pipes
from sfms_robot.config.hop import Probe
from sfms_robot.config.listener import Calmness
from sfms_robot.errors import RobotError
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, SpeakerFrame
from sfms_robot.listeners.inbox import Inbox, calmed
from sfms_robot.ports import Listener

NICE: Final = 5  # below the servo loop, which needs a core for a fraction of a millisecond, but at once
AWAKE_S: Final = 0.25
PROBE_S: Final = 0.5
PROBE_PLANS: Final = 12


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
    listen(at_hop(listener, _hop(hops)), seed, inbox, plans, hops)


def _hop(hops: queue.SimpleQueue[int]) -> int:
    """Wait for the hop, awake a few times a second: for the parent, a child that uses no processor time hangs."""
    while True:
        with suppress(queue.Empty):
            return hops.get(timeout=AWAKE_S)


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


def threads() -> int:
    """That the child may use: one core is the servo loop's."""
    return max(1, cores() - 1)
