"""One process of `sfms-robot serve`: a `StreamServer`, its model, and the one thread that steps its batches.

Most of the cost of a frame is Python code, so each core has a process: threads of one process would wait for one
another. All times are `time.monotonic`, which processes of one machine share.

    parent -> child    a `Served`, then an int: the hop, for which the child waits; then
        (stream, message, came_s)    for one of its streams
        (None, message, number)      a request for a stream
        int                          a request for figures, by that number
    child -> parent    (kind, value)
        loaded     the hop that a robot would choose for the duration of a plan here; the child waits for its hop
        ready      its `Capacity`: it serves
        clients    {stream: client} whenever its streams have changed; before the answer that names a new stream
        answer     (number, message) to a request for a stream
        send       [(stream, message)]
        figures    (number, `Figures`)
        error      a `RobotError`: it cannot serve
"""

from __future__ import annotations

import logging
import queue
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from sfms_robot.config.hop import Latencies, choose_hop
from sfms_robot.errors import ConfigError, ModelError, RobotError
from sfms_robot.listeners.capacity import GPU_SIZES, SIZES, measure_capacity
from sfms_robot.listeners.engine import Device, EngineName
from sfms_robot.listeners.process import plan_times_s
from sfms_robot.listeners.stream_server import StreamServer
from sfms_robot.processes import ParentPipe

LEAD_S: Final = 0.080  # longest lead of a joint, for the hop that a robot would choose
TICK_S: Final = 0.010
LOOK_S: Final = 1.0  # period of the search for streams that have gone

Say = Callable[[tuple[str, Any]], None]

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Served:
    """A listener that is served, and the settings of the service.

    Attributes:
        listener: shipped name or folder.
        name: name by which robots request it.
        server: name of this server.
        engine: engine of its networks. device: device of the engine.
        hop: None for the hop that a robot would choose for the duration of a plan here.
        all_heads: admit all heads, whatever they cost.
    """

    listener: str
    name: str
    server: str = "server"
    engine: EngineName = "auto"
    device: Device = "cpu"
    hop: int | None = None
    all_heads: bool = False


def main() -> None:
    """Load, measure, then serve until the pipe ends."""
    parent, inbox = ParentPipe(), queue.SimpleQueue[Any]()
    served: Served = parent.receive()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a service manager sends it to all; the parent ends this process
    parent.forward(inbox.put)
    try:
        from sfms_robot.listeners.registry import at_hop, hops_of, load_listener

        listener = load_listener(served.listener, engine=served.engine, threads=1, device=served.device)
        hops, hop = hops_of(listener), served.hop
        if hop is None:
            p50_s, p99_s = plan_times_s(at_hop(listener, min(hops)))
            latencies = Latencies(
                horizon=listener.horizon, source_s=0.0, step_p50_s=p50_s, step_p99_s=p99_s, lead_s=LEAD_S, tick_s=TICK_S
            )
            hop = choose_hop(hops, latencies).hop
        elif hop not in hops:
            raise ConfigError(
                f"--hop {hop}: not a hop of listener {served.listener!r} (valid: {', '.join(map(str, hops))})"
            )
        parent.send(("loaded", hop))
        listener = at_hop(listener, inbox.get())
        capacity = measure_capacity(listener, SIZES if served.device == "cpu" else GPU_SIZES)
    except (RobotError, MemoryError) as error:
        parent.send(("error", error if isinstance(error, RobotError) else ModelError(f"{served.listener}: {error}")))
        return
    parent.send(("ready", capacity))
    server = StreamServer(listener, served.name, None if served.all_heads else capacity, served.server)
    _serve(server, inbox, parent.send)


def _serve(server: StreamServer, inbox: queue.SimpleQueue[Any], say: Say) -> None:
    """Receive messages and step the batches that are due, without end."""
    held: Mapping[str, str] = {}
    while True:
        messages: list[tuple[str, bytes]] = []
        answers: list[tuple[int, bytes]] = []
        for item in _waiting(inbox, 0.0 if server.waits else LOOK_S):
            if isinstance(item, int):
                say(("figures", (item, server.figures())))
                continue
            stream, message, value = item
            if stream is None:
                answers.append((value, server.join(message, time.monotonic())))
            else:
                messages += [(stream, each) for each in server.receive(stream, message, value)]
        server.expire(time.monotonic())
        clients = server.clients
        if clients != held:
            held = clients
            say(("clients", clients))
        for answer in answers:
            say(("answer", answer))
        messages += _stepped(server)
        if messages:
            say(("send", messages))


def _stepped(server: StreamServer) -> list[tuple[str, bytes]]:
    """Step one batch and return its messages; none if no frame waits, or if the listener fails."""
    batch = server.batch()
    if batch is None:
        return []
    began_s = time.monotonic()
    try:
        answers = server.step(batch)
    except MemoryError as error:
        log.warning("%s; half as many from now on", error)
        server.too_many(batch)
        return []
    except Exception:
        log.exception("a batch of %d streams failed: they join again", len(batch))
        server.failed(batch)
        return []
    return server.finish(batch, answers, began_s, time.monotonic())


def _waiting(inbox: queue.SimpleQueue[Any], limit_s: float) -> list[Any]:
    """Return all messages that have come; wait up to `limit_s` for the first one."""
    items = []
    try:
        if limit_s:
            items.append(inbox.get(timeout=limit_s))
        while True:
            items.append(inbox.get_nowait())
    except queue.Empty:
        return items
