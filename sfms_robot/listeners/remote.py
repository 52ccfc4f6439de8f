"""A listener in its own process: the same `step`, one mailbox each way.

In one process torch and the servo loop share a lock, and ticks slip by tens of milliseconds. So the child owns the
model and its threads (cores - 1); the loop only drops frames into a queue (a thread of the queue does the writing,
`push` never blocks) and picks up the plans that have arrived. A child that dies is a ModelError at the next poll.

A machine that cannot keep up must not answer what was said seconds ago: when more than half a second is waiting, the
listener goes on at the newest frame. What it did not hear is counted, and said once.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import queue
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

from sfms_robot.errors import ModelError, RobotError
from sfms_robot.frames import FRAME_HZ, Plan, SpeakerFrame
from sfms_robot.ports import Listener

MOST_WAITING = FRAME_HZ // 2  # frames
NICE = 5  # below the servo loop, which needs a core for a fraction of a millisecond, but at once
START_LIMIT_S = 60.0  # importing torch on a small board with a cold disk
CLOSE_LIMIT_S = 2.0

log = logging.getLogger(__name__)


class RemoteFeed:
    """ports.PlanFeed over a child process. `build` must be importable by the child (a module-level function)."""

    def __init__(self, build: Callable[[], Listener], seed: int) -> None:
        """Start the child and wait until its listener is ready.

        Raises ModelError with the child's own message when it cannot load the model.
        """
        context = multiprocessing.get_context("spawn")
        self._frames = context.Queue()
        self._plans, child_end = context.Pipe(duplex=False)
        self._step_ms: list[float] = []
        self._unheard = 0
        self._child = context.Process(target=_serve, args=(build, seed, self._frames, child_end), daemon=True)
        self._child.start()
        child_end.close()
        try:
            if not self._plans.poll(START_LIMIT_S):
                raise ModelError(f"the listener process was not ready after {START_LIMIT_S:g} s")
            self._receive()
        except BaseException:
            self.close()
            raise

    def push(self, frame: SpeakerFrame, now_s: float) -> None:
        self._frames.put(frame)

    def poll(self, now_s: float) -> Sequence[Plan]:
        plans = []
        while self._plans.poll():
            message = self._receive()
            if message is not None:
                plans.append(message)
        return plans

    def step_times_ms(self) -> Sequence[float]:
        return self._step_ms

    def unheard(self) -> int:
        return self._unheard

    def close(self) -> None:
        self._frames.put(None)
        self._child.join(CLOSE_LIMIT_S)
        if self._child.is_alive():
            self._child.kill()
            self._child.join()
        self._frames.close()
        self._frames.cancel_join_thread()
        self._plans.close()

    def _receive(self) -> Plan | None:
        try:
            kind, value, number = self._plans.recv()
        except EOFError:
            self._child.join(CLOSE_LIMIT_S)
            raise ModelError(f"the listener process died (exit code {self._child.exitcode})") from None
        if kind == "error":
            raise ModelError(value)
        if kind == "unheard":
            if not self._unheard:
                log.warning("the listener is slower than the person: it leaves frames out to keep up")
            self._unheard += number
        if kind != "plan":
            return None
        self._step_ms.append(number)
        return value  # type: ignore[no-any-return]


def threads() -> int:
    """Of torch in the child: one core is the servo loop's."""
    return max(1, (os.cpu_count() or 2) - 1)


def _serve(build: Callable[[], Listener], seed: int, frames: Any, plans: Connection) -> None:
    """The child: load, then listen."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle: the head must reach rest first
    os.nice(NICE)
    import torch

    torch.set_num_threads(threads())
    try:
        listener = build()
    except RobotError as error:
        plans.send(("error", str(error), None))
        return
    listen(listener, seed, Inbox(frames), plans)


def listen(listener: Listener, seed: int, inbox: Inbox, plans: Connection) -> None:
    """One step per frame until there are none; tells when it is ready, plans with their times, and what it left out."""
    memory = listener.start(seed)
    plans.send(("ready", None, None))
    while (frame := inbox.next()) is not None:
        if inbox.unheard:
            plans.send(("unheard", None, inbox.unheard))
        began_s = time.perf_counter()
        plan, memory = listener.step(frame, memory)
        if plan is not None:
            plans.send(("plan", plan, (time.perf_counter() - began_s) * 1e3))


class Inbox:
    """Frames in the order in which they came, until None does; the newest alone when too many are waiting.

    Attributes:
        unheard: frames left out before the last one given.
    """

    def __init__(self, frames: Any, most: int = MOST_WAITING) -> None:
        """`frames`: a queue, with `get` and `get_nowait`."""
        self._frames, self._most = frames, most
        self._waiting: deque[SpeakerFrame | None] = deque()
        self.unheard = 0

    def next(self) -> SpeakerFrame | None:
        """Waits for one. None, the end, is neither left out nor waits for what came before it."""
        if not self._waiting:
            self._waiting.append(self._frames.get())
        while True:
            try:
                self._waiting.append(self._frames.get_nowait())
            except queue.Empty:
                break
        if None in self._waiting:
            return None
        self.unheard = len(self._waiting) - 1 if len(self._waiting) > self._most else 0
        for _ in range(self.unheard):
            self._waiting.popleft()
        return self._waiting.popleft()
