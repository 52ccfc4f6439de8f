"""One process of `sfms-robot serve`: a `StreamServer`, its model, and the one thread that steps its batches.

Most of what a frame costs is Python, so a core is a process: threads of one would wait for one another. It ends when
its pipe does. All times are `time.monotonic`, which processes of one machine share.

    parent -> child    pickle: lists; of all their items the first is a `Served`, the second one an int, the hop; then
        (stream, message, came_s)    for one of its streams
        (None, message, number)      of somebody who asks for a stream
        int                          asks for figures by that number
    child -> parent    pickle: (kind, value)
        loaded     the hop that a robot would choose by what a plan takes here; it waits for its hop
        ready      its `Capacity`: it serves
        clients    {stream: client} whenever those that it holds have changed; before the answer that tells of one
        answer     (number, message) to somebody who asked for a stream
        send       [(stream, message)]
        figures    (number, `Figures`)
        error      a `RobotError`: it cannot serve
"""

from __future__ import annotations

import logging
import os
import pickle
import queue
import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import IO, Any, Final

from sfms_robot.child_process import messages, take_pipes
from sfms_robot.config.hop import Latencies, choose_hop
from sfms_robot.errors import ConfigError, RobotError
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.process_child import plan_times_s
from sfms_robot.listeners.serving.capacity import measure_capacity
from sfms_robot.listeners.serving.stream_server import StreamServer
from sfms_robot.ports import Listener

LEAD_S: Final = 0.080  # longest lead of a joint, for the hop that a robot would choose
TICK_S: Final = 0.010
LOOK_S: Final = 1.0  # for streams that went away

Say = Callable[[str, Any], None]
Inbox = queue.SimpleQueue[list[Any]]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Served:
    """What is served, and how.

    Attributes:
        listener: shipped name or folder; engine: what computes its networks.
        name: that robots ask for.
        server: what this server is called.
        hop: None for the one that a robot would choose by what a plan takes here.
        everybody: admit without asking what it costs.
    """

    listener: str
    name: str
    server: str = "server"
    engine: EngineName = "auto"
    hop: int | None = None
    everybody: bool = False


def main() -> None:
    """Load, measure, then serve until the pipe ends."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # whoever stops all processes of a service: the parent sees to it
    incoming, outgoing = take_pipes()
    inbox: Inbox = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(incoming, inbox), daemon=True).start()

    def say(kind: str, value: Any) -> None:
        pickle.dump((kind, value), outgoing, protocol=5)
        outgoing.flush()

    (served,) = inbox.get()
    try:
        listener = _loaded(served)
        say("loaded", listener.hop)
        (hop,) = inbox.get()
        from sfms_robot.listeners.registry import at_hop

        listener = at_hop(listener, hop)
        capacity = measure_capacity(listener)
    except RobotError as error:
        say("error", error)
        return
    say("ready", capacity)
    _serve(StreamServer(listener, served.name, None if served.everybody else capacity, served.server), inbox, say)


def _receive(incoming: IO[bytes], inbox: Inbox) -> None:
    """The end of the pipe is the end of this process, whatever it computes."""
    for items in messages(incoming):
        inbox.put(items)
    os._exit(0)


def _loaded(served: Served) -> Listener:
    """At the hop it would be served with; blocks for some seconds. Raises ConfigError, ModelError."""
    from sfms_robot.listeners.registry import at_hop, hops_of, load_listener

    listener = load_listener(served.listener, engine=served.engine, threads=1)
    hops = hops_of(listener)
    if served.hop is not None:
        if served.hop not in hops:
            raise ConfigError(f"--hop {served.hop}: listener {served.listener!r} has {', '.join(map(str, hops))}")
        return at_hop(listener, served.hop)
    p50_s, p99_s = plan_times_s(at_hop(listener, min(hops)))
    return at_hop(listener, choose_hop(hops, Latencies(listener.horizon, 0.0, p50_s, p99_s, LEAD_S, TICK_S)).hop)


def _serve(server: StreamServer, inbox: Inbox, say: Say) -> None:
    """Take what came, step what is due, for ever."""
    held: Mapping[str, str] = {}
    while True:
        notices, answers, asked = _take(server, _waiting(inbox, 0.0 if server.waits else LOOK_S))
        server.expire(time.monotonic())
        clients = server.clients
        if clients != held:
            held = clients
            say("clients", clients)
        for answer in answers:
            say("answer", answer)
        for number in asked:
            say("figures", (number, server.figures()))
        messages = notices + _stepped(server)
        if messages:
            say("send", messages)


def _take(server: StreamServer, items: list[Any]) -> tuple[list[tuple[str, bytes]], list[tuple[int, bytes]], list[int]]:
    """What the server has to say at once to streams, to those who asked for one, and numbers that ask for figures."""
    notices: list[tuple[str, bytes]] = []
    answers: list[tuple[int, bytes]] = []
    asked: list[int] = []
    for item in items:
        if isinstance(item, int):
            asked.append(item)
            continue
        stream, message, value = item
        if stream is None:
            answers.append((value, server.join(message, time.monotonic())))
        else:
            notices += [(stream, each) for each in server.receive(stream, message, value)]
    return notices, answers, asked


def _stepped(server: StreamServer) -> list[tuple[str, bytes]]:
    """What one batch makes; nothing where none waits, and where a listener of somebody else's fails."""
    batch = server.batch()
    if batch is None:
        return []
    began_s = time.monotonic()
    try:
        answers = server.step(batch)
    except Exception:
        log.exception("a batch of %d streams failed: they are given up", len(batch.streams))
        server.failed(batch)
        return []
    return server.finish(batch, answers, began_s, time.monotonic())


def _waiting(inbox: Inbox, limit_s: float) -> list[Any]:
    """All that came; waits for something for so long."""
    items: list[Any] = []
    try:
        if limit_s:
            items += inbox.get(timeout=limit_s)
        while True:
            items += inbox.get_nowait()
    except queue.Empty:
        return items
