"""The processes that step (`batch_process`), one for each core, and the streams dealt among them.

Whoever asks for a stream gets the process with the fewest; its frames go there until it leaves. Weights are in memory
once for each. A process that dies while it serves is named and started anew: robots whose streams it had are told that
they are unknown, and join again.
"""

from __future__ import annotations

import itertools
import logging
import pickle
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from sfms_robot.app.serve.batch_process import Served
from sfms_robot.child_process import cores, end_child, messages, start_child
from sfms_robot.errors import ModelError, PacketError, RobotError
from sfms_robot.listeners.remote_messages import Join, Notice, parse_words, words_message
from sfms_robot.listeners.serving.capacity import Capacity
from sfms_robot.listeners.serving.stream_server import DEADLINE_S, Figures, report

FIGURES_LIMIT_S: Final = 2.0  # what a process says of itself is waited for, else the last that it said counts
CLOSE_LIMIT_S: Final = 1.0

Send = Callable[[str, bytes], None]
Answer = Callable[[bytes], None]

log = logging.getLogger(__name__)


class WorkerPool:
    """Messages in, plans out. Serves from construction, which blocks for some seconds, until `close`.

    Args:
        served: what is served.
        send: one message to one stream; called from any of the pool's threads, must not block.
        processes: None for one for each core.

    Attributes:
        hop: frames from one plan to the next, the same for all.
        capacities: what batches cost in each process, measured while all were at work.
        problem: why it cannot go on; None as long as it can.

    Raises ConfigError for a listener or a hop that is none, ModelError for one that cannot be loaded.
    """

    def __init__(self, served: Served, send: Send, processes: int | None = None) -> None:
        self._served, self._send = served, send
        self._changed = threading.Condition()
        self._numbers = itertools.count()
        self._closing = False
        self._figures: Sequence[Figures] = ()
        self.hop = 0
        self.problem: RobotError | None = None
        self._workers = [_Worker(served, self._told)]
        try:
            self._wait(lambda: self.hop > 0)
            self._served = replace(served, hop=self.hop)
            more = [_Worker(self._served, self._told) for _ in range(1, processes or cores())]
            self._workers += more
            self._wait(lambda: all(each.capacity for each in self._workers))
        except BaseException:
            self.close()
            raise
        self.capacities = [each.capacity for each in self._workers if each.capacity is not None]

    @property
    def most(self) -> int:
        """Heads that are answered within the deadline."""
        return sum(each.most(DEADLINE_S) for each in self.capacities)

    def receive(self, stream: str, message: bytes) -> None:
        """From any thread; never blocks."""
        worker = next((each for each in self._workers if stream in each.clients), None)
        if worker is None:
            self._send(stream, words_message(Notice("unknown")))
        else:
            worker.put((stream, message, time.monotonic()))

    def join(self, message: bytes, answer: Answer) -> None:
        """From any thread; `answer` is called from one of the pool's, or never: who gets none asks again."""
        client = _client(message)
        with self._changed:
            serving = [each for each in self._workers if each.capacity is not None]
            if not serving:
                return
            known = [each for each in serving if client in each.asked_for]
            worker = min(known or serving, key=lambda each: len(each.asked_for))
            number = next(self._numbers)
            worker.asked[number] = (client, answer)
        worker.put((None, message, number))

    def statistics(self) -> Mapping[str, Any]:
        """Of all processes together (`serving.figures`), from any thread but the pool's own."""
        number = next(self._numbers)
        with self._changed:
            asked = [each for each in self._workers if each.capacity is not None]
            for each in asked:
                each.put(number)
            self._changed.wait_for(lambda: all(each.told >= number for each in asked), FIGURES_LIMIT_S)
            self._figures = [each.figures for each in asked if each.figures is not None] or self._figures
        return report(self._figures)

    def close(self) -> None:
        """Ends whatever they compute. Idempotent."""
        with self._changed:
            self._closing = True
        for each in self._workers:
            each.put(None)
        for each in self._workers:
            each.end()

    def _wait(self, done: Callable[[], bool]) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self.problem is not None or done())
            if self.problem is not None:
                raise self.problem

    def _told(self, worker: _Worker, kind: str, value: Any) -> None:
        """What a process says, in the thread that reads it."""
        if kind == "send":
            for stream, message in value:
                self._send(stream, message)
            return
        with self._changed:
            if kind == "answer":
                _, answer = worker.asked.pop(value[0])
            elif kind == "clients":
                worker.clients = value
            elif kind == "figures":
                worker.told, worker.figures = value
            elif kind == "loaded":
                self.hop = self.hop or value  # of the first: it measured while nothing else was at work
                worker.put(self.hop)
            elif kind == "ready":
                worker.capacity = value
            elif kind == "error":
                self.problem = self.problem or value
            elif kind == "ended":
                self._ended(worker, value)
            self._changed.notify_all()
        if kind == "answer":
            answer(value[1])

    def _ended(self, worker: _Worker, code: int) -> None:
        if self._closing:
            return
        if worker.capacity is None:
            error = ModelError(f"{self._served.listener}: a process of the server ended with exit code {code} at once")
            self.problem = self.problem or error
            return
        log.error("a process of the server ended with exit code %d: %d heads join again", code, len(worker.clients))
        self._workers[self._workers.index(worker)] = _Worker(self._served, self._told)


class _Worker:
    """One process, and the two threads that talk to it.

    Attributes:
        capacity: None until it serves.
        clients: whose streams it holds, by stream.
        asked: who asked it for a stream and has no answer yet, by number.
        figures: the last that it told, by the number `told`.
    """

    def __init__(self, served: Served, told: Callable[[_Worker, str, Any], None]) -> None:
        self.capacity: Capacity | None = None
        self.clients: Mapping[str, str] = {}
        self.asked: dict[int, tuple[str | None, Answer]] = {}
        self.told = -1
        self.figures: Figures | None = None
        self._say = told
        self._items: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._process: subprocess.Popen[bytes] = start_child("sfms_robot.app.serve.batch_process:main")
        self.put(served)
        for work in (self._write, self._read):
            threading.Thread(target=work, name=f"serve {work.__name__}", daemon=True).start()

    @property
    def asked_for(self) -> set[str | None]:
        """Clients that it has, or will have."""
        return {*self.clients.values(), *(client for client, _ in self.asked.values())}

    def put(self, item: Any) -> None:
        """To the process; None hangs up. Never blocks."""
        self._items.put(item)

    def end(self) -> None:
        end_child(self._process, CLOSE_LIMIT_S)

    def _write(self) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        try:
            with pipe:
                while True:
                    items = [self._items.get()]
                    while not self._items.empty():
                        items.append(self._items.get())
                    if None in items:
                        return
                    pickle.dump(items, pipe, protocol=5)
                    pipe.flush()
        except (OSError, ValueError):
            return  # it died: the reader sees that too, and says so

    def _read(self) -> None:
        pipe = self._process.stdout
        assert pipe is not None
        with pipe:
            for message in messages(pipe):
                self._say(self, *message)
            code = self._process.wait()
        self._say(self, "ended", code)


def _client(message: bytes) -> str | None:
    """Who asks; None for a message that the process will refuse."""
    try:
        said = parse_words(message)
    except PacketError:
        return None
    return said.client if isinstance(said, Join) else None
