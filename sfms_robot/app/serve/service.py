"""`sfms-robot serve`: a listener for many heads, over zenoh (`listeners.remote` has the keys).

Each core has one process that steps batches (`batch_process`); streams are distributed among the processes. A request
for a stream goes to the process with the fewest streams, and its frames go there until it leaves. Each process has the
weights in memory. A process that dies while it serves is reported and started again: robots whose streams it had are
notified that they are unknown, and join again.

Messages arrive in threads of zenoh, and are passed on to the processes.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from functools import partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.app.progress import bar
from sfms_robot.app.serve.batch_process import Served
from sfms_robot.data import Report
from sfms_robot.endpoint import HIGHEST_PORT, host_and_port
from sfms_robot.errors import ConfigError, ModelError, PacketError, RobotError, optional
from sfms_robot.frames import FRAME_S
from sfms_robot.listeners.capacity import Capacity
from sfms_robot.listeners.remote import listen_key
from sfms_robot.listeners.remote_messages import Join, Notice, parse_words, words_message
from sfms_robot.listeners.stream_server import DEADLINE_S, Figures, report
from sfms_robot.network import Router, check_name, check_zenoh, close_session, serve_session, session_config
from sfms_robot.ports import Document, Facts
from sfms_robot.processes import Child, Ended, cores

if TYPE_CHECKING:
    import zenoh

    from sfms_robot.viewer.web_server import LocalServer

FIGURES_LIMIT_S: Final = 2.0  # longest wait for the figures of a process; after that its last ones are used
CLOSE_LIMIT_S: Final = 1.0

Send = Callable[[str, bytes], None]
Reply = Callable[[bytes], None]

log = logging.getLogger(__name__)

# Name, description, and key in the statistics of `StreamServer`, where times are in milliseconds instead of seconds.
_GAUGES: Final = (
    ("heads", "Heads that are listened for", "heads"),
    ("heads_most", "Heads that could be answered in time", "most_heads"),
    ("deadline_seconds", "Promised from a frame to its plan", "deadline_ms"),
    ("plan_delay_p50_seconds", "Median from a frame to its plan, of the last plans", "delay_ms.p50"),
    ("plan_delay_p99_seconds", "99th percentile of the same", "delay_ms.p99"),
    ("batch_size_p50", "Median of the heads in a batch", "batch_size.p50"),
    ("batch_size_p99", "99th percentile of the same", "batch_size.p99"),
    ("cost_scale", "How much longer batches take than measured at the start", "cost_scale"),
)
_COUNTERS: Final = (
    ("plans", "Plans made", "plans"),
    ("deadline_misses", "Plans later than the deadline", "deadline_misses"),
    ("batches", "Batches stepped", "batches"),
    ("steps", "Frames stepped, over all heads", "steps"),
    ("frames_skipped", "Frames left out, since too many were waiting", "skipped_frames"),
    ("frames_lost", "Frames that never came", "lost_frames"),
    ("refused", "Robots that were refused", "refused"),
    ("malformed", "Messages that could not be read", "malformed"),
)


class WorkerPool:
    """The processes of a server: messages in, plans out. Serves from construction (some seconds) until `close`.

    Args:
        served: the listener, and how it is served.
        send: sends one message to one stream; called from any of the pool's threads, must not block.
        processes: number of processes; None: one for each core.

    Attributes:
        hop: frames from one plan to the next, the same for all.
        capacities: costs of batches in each process, measured while all were at work.
        most: number of heads that are answered within the deadline.
        problem: reason why it cannot continue; None as long as it can.

    Raises ConfigError for an unknown listener or hop, ModelError for a listener that cannot be loaded.
    """

    def __init__(self, served: Served, send: Send, processes: int | None = None) -> None:
        self._served, self._send = served, send
        self._changed = threading.Condition()
        self._numbers = itertools.count()
        self._closing = False
        self._figures: Sequence[Figures] = ()
        self.hop = 0
        self.problem: RobotError | None = None
        self._workers = [_Worker(served, self._take)]
        try:
            self._wait(lambda: self.hop > 0)
            self._served = replace(served, hop=self.hop)
            self._workers += [_Worker(self._served, self._take) for _ in range(1, processes or cores())]
            self._wait(lambda: all(each.capacity for each in self._workers))
        except BaseException:
            self.close()
            raise
        self.capacities = [each.capacity for each in self._workers if each.capacity is not None]
        self.most = sum(each.most(DEADLINE_S) for each in self.capacities)

    def receive(self, stream: str, message: bytes) -> None:
        """Pass on a message of a stream. From any thread; never blocks."""
        worker = next((each for each in self._workers if stream in each.clients), None)
        if worker is None:
            self._send(stream, words_message(Notice("unknown")))
        else:
            worker.child.send((stream, message, time.monotonic()))

    def join(self, message: bytes, reply: Reply) -> None:
        """Pass on a request for a stream. From any thread.

        `reply` is called from one of the pool's threads, or never: a robot without an answer sends its request again.
        """
        client = None
        with suppress(PacketError):  # the process refuses the message
            if isinstance(words := parse_words(message), Join):
                client = words.client
        with self._changed:
            serving = [each for each in self._workers if each.capacity is not None]
            if not serving:
                return
            known = [each for each in serving if client in each.clients_to_be()]
            worker = min(known or serving, key=lambda each: len(each.clients_to_be()))
            number = next(self._numbers)
            worker.requests[number] = (client, reply)
        worker.child.send((None, message, number))

    def statistics(self) -> Facts:
        """Return the figures of all processes together (`stream_server.report`), from any thread but the pool's own."""
        number = next(self._numbers)
        with self._changed:
            serving = [each for each in self._workers if each.capacity is not None]
            for each in serving:
                each.child.send(number)
            self._changed.wait_for(lambda: all(each.counted >= number for each in serving), FIGURES_LIMIT_S)
            self._figures = [each.figures for each in serving if each.figures is not None] or self._figures
        return report(self._figures)

    def close(self) -> None:
        """End the processes, even while they compute. Idempotent."""
        with self._changed:
            self._closing = True
        for each in self._workers:
            each.child.close(CLOSE_LIMIT_S)

    def _wait(self, done: Callable[[], bool]) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self.problem is not None or done())
            if self.problem is not None:
                raise self.problem

    def _take(self, worker: _Worker, message: Any) -> None:
        """Handle a message of a process, in the thread that reads it."""
        kind: str
        value: Any
        kind, value = ("ended", message.code) if isinstance(message, Ended) else message
        if kind == "send":
            for stream, plan in value:
                self._send(stream, plan)
            return
        with self._changed:
            match kind:
                case "answer":
                    _, reply = worker.requests.pop(value[0])
                case "clients":
                    worker.clients = value
                case "figures":
                    worker.counted, worker.figures = value
                case "loaded":
                    self.hop = self.hop or value  # the first process measured it while no other was at work
                    worker.child.send(self.hop)
                case "ready":
                    worker.capacity = value
                case "error":
                    self.problem = self.problem or value
                case "ended":
                    self._replace(worker, value)
            self._changed.notify_all()
        if kind == "answer":
            reply(value[1])

    def _replace(self, worker: _Worker, code: int) -> None:
        """Start another process in place of one that has ended; set `problem` if that process never served."""
        if self._closing:
            return
        if worker.capacity is None:
            self.problem = self.problem or ModelError(
                f"{self._served.listener}: a process of the server ended with exit code {code} at once"
            )
            return
        log.error("a process of the server ended with exit code %d: %d heads join again", code, len(worker.clients))
        self._workers[self._workers.index(worker)] = _Worker(self._served, self._take)


class _Worker:
    """One process of the pool.

    Attributes:
        capacity: None until it serves.
        clients: clients of its streams, by stream.
        requests: unanswered requests for a stream, by number: the client, and the function that replies.
        figures: the newest figures, requested by the number `counted`.
    """

    def __init__(self, served: Served, take: Callable[[_Worker, Any], None]) -> None:
        self.capacity: Capacity | None = None
        self.clients: Mapping[str, str] = {}
        self.requests: dict[int, tuple[str | None, Reply]] = {}
        self.counted = -1
        self.figures: Figures | None = None
        self.child = Child("sfms_robot.app.serve.batch_process:main", served, name="serve", take=partial(take, self))

    def clients_to_be(self) -> set[str | None]:
        """Return the clients that it has, or will have."""
        return {*self.clients.values(), *(client for client, _ in self.requests.values())}


def serve(
    served: Served,
    say: Callable[[str], None],
    *,
    router: Path | None,
    insecure: bool,
    metrics: str | None,
    processes: int | None,
) -> Report:
    """Serve until Ctrl-C, SIGTERM or SIGHUP raises KeyboardInterrupt, and return the figures. Blocks until then.

    Args:
        served: the listener, and how it is served.
        say: prints a line for people.
        router: zenoh's configuration; None: loopback.
        insecure: allow endpoints beyond loopback without TLS.
        metrics: [HOST:]PORT of /metrics; None: none.
        processes: number of processes; None: one for each core.

    Raises ConfigError, MissingExtra, ModelError, PortError.
    """
    from sfms_robot.runtime.observers import ServiceManager

    check_zenoh()
    import zenoh

    name = check_name(served.name, "listener")
    config = session_config("serve", Router(router, insecure))
    service_manager = ServiceManager()
    with ExitStack() as stack:
        figures = None if metrics is None else stack.enter_context(closing(metrics_server(metrics)))
        session = serve_session(config)
        stack.callback(close_session, session)
        now: Report = {
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": zenoh.Priority.REAL_TIME,
            "express": True,
        }
        with bar(f"loading {name}, and measuring how many heads it answers in time"):
            pool = WorkerPool(
                served, lambda to, message: session.put(listen_key(name, to, "down"), message, **now), processes
            )
        stack.callback(pool.close)

        def join(query: zenoh.Query) -> None:
            if query.payload is not None:
                pool.join(query.payload.to_bytes(), lambda answer: query.reply(listen_key(name, "join"), answer))

        def receive(sample: zenoh.Sample) -> None:
            pool.receive(str(sample.key_expr).split("/")[-2], sample.payload.to_bytes())

        session.declare_queryable(listen_key(name, "join"), join)
        session.declare_subscriber(listen_key(name, "*", "up"), receive)
        if figures is not None:
            figures.begin(pool.statistics)
            say(f"metrics: {figures.url}")
        say(
            f"{name}: a plan every {pool.hop * FRAME_S * 1e3:.0f} ms for up to {pool.most} heads, each answered within "
            f"{DEADLINE_S * 1e3:.0f} ms, by {len(pool.capacities)} processes"
        )
        service_manager.ready(f"{name}: up to {pool.most} heads")
        with suppress(KeyboardInterrupt):
            while pool.problem is None:
                time.sleep(service_manager.every_s)
                service_manager.alive()
        service_manager.stopping()
        if pool.problem is not None:
            raise pool.problem
        return dict(pool.statistics())


# --- figures for Prometheus -----------------------------------------------------------------------------------------


def metrics_server(wanted: str) -> LocalServer:
    """Bind the port of `serve --metrics [HOST:]PORT`: figures for Prometheus, by prometheus_client.

    `wanted`: a port, "0" for any that is free; HOST:PORT beyond loopback. Raises ConfigError, MissingExtra, PortError.
    """
    with optional("--metrics"):
        from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import Route

    from sfms_robot.viewer.web_server import LocalServer

    place = host_and_port(wanted)
    if place is None:
        valid = f"0 to {HIGHEST_PORT}, 0 for a free one, HOST:PORT"
        raise ConfigError(f"--metrics {wanted}: not a TCP port (valid: {valid})")

    def routes(statistics: Document) -> list[Route]:
        def metrics(request: Request) -> Response:
            return Response(generate_latest(_Collector(statistics)), media_type=CONTENT_TYPE_LATEST)

        return [Route("/{path:path}", metrics)]

    server = LocalServer("--metrics", routes, *place)
    server.url += "metrics"
    return server


@dataclass(frozen=True)
class _Collector:
    """The statistics as Prometheus reads them."""

    statistics: Document

    def collect(self) -> Iterable[Any]:
        """Yield one metric for each figure that the statistics hold now."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        statistics = self.statistics()
        families = [(GaugeMetricFamily, each) for each in _GAUGES] + [(CounterMetricFamily, each) for each in _COUNTERS]
        for family, (name, text, place) in families:
            value: Any = reduce(lambda found, key: found[key], place.split("."), statistics)
            if value is not None:
                metric = family(f"sfms_{name}", text, labels=["listener", "server"])
                factor = 1e-3 if name.endswith("_seconds") else 1.0
                metric.add_metric([statistics["listener"], statistics["server"]], float(value) * factor)
                yield metric
