"""A listener in its own process: the same `step`, one mailbox each way.

In one process torch and the servo loop share a lock, and ticks slip by tens of milliseconds. So the child owns the
model and its threads (cores - 1); the loop only drops frames into a queue (a thread of the queue does the writing,
`push` never blocks) and picks up the plans that have arrived. A child that dies is a ModelError at the next poll.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

from sfms_robot.errors import ModelError, RobotError
from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.ports import Listener

START_LIMIT_S = 60.0  # importing torch on a small board with a cold disk
CLOSE_LIMIT_S = 2.0


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
            kind, value, step_ms = self._plans.recv()
        except EOFError:
            self._child.join(CLOSE_LIMIT_S)
            raise ModelError(f"the listener process died (exit code {self._child.exitcode})") from None
        if kind == "error":
            raise ModelError(value)
        if kind != "plan":
            return None
        self._step_ms.append(step_ms)
        return value  # type: ignore[no-any-return]


def _serve(build: Callable[[], Listener], seed: int, frames: Any, plans: Connection) -> None:
    """The child: load, then one step per frame until None comes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle: the head must reach rest first
    import torch

    torch.set_num_threads(max(1, (os.cpu_count() or 2) - 1))
    try:
        listener = build()
    except RobotError as error:
        plans.send(("error", str(error), None))
        return
    memory = listener.start(seed)
    plans.send(("ready", None, None))
    while (frame := frames.get()) is not None:
        began_s = time.perf_counter()
        plan, memory = listener.step(frame, memory)
        if plan is not None:
            plans.send(("plan", plan, (time.perf_counter() - began_s) * 1e3))
