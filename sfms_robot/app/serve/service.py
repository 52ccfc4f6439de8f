"""`sfms-robot serve`: a listener for many heads, over zenoh (`listeners.zenoh_link` has the keys).

Messages come in threads of zenoh's and are laid down; `WORKERS` threads take turns: one puts a batch together and keeps
its results under the lock, and steps without it, so that a second batch is stepped meanwhile.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.app.serve.metrics import MetricsServer
from sfms_robot.config.hop import Latencies, choose_hop
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.process import plan_times_s
from sfms_robot.listeners.serving.capacity import Capacity, measure_capacity
from sfms_robot.listeners.serving.stream_server import DEADLINE_S, StreamServer
from sfms_robot.listeners.zenoh_link import ROOT, down_key, join_key
from sfms_robot.network import check_name, check_zenoh, close_session, serve_session, session_config
from sfms_robot.ports import Listener

if TYPE_CHECKING:
    import zenoh

LEAD_S: Final = 0.080  # longest lead of a joint, for the hop that a robot would choose
TICK_S: Final = 0.010
LOOK_S: Final = 1.0  # for streams that went away

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ServeOptions:
    """The flags of `sfms-robot serve`.

    Attributes:
        listener: shipped name or folder.
        name: that robots ask for, zenoh/NAME; None: the listener's.
        zenoh: zenoh's configuration; None: loopback.
        metrics: TCP port of /metrics; None: none.
        hop: None for the one that a robot would choose by what a plan takes here.
        workers: threads that step; None: as many as there are cores, two at most.
        everybody: admit without asking what it costs.
        engine: what the listener's networks are computed by.
    """

    listener: str = "sfms-small"
    name: str | None = None
    zenoh: Path | None = None
    metrics: str | None = None
    hop: int | None = None
    workers: int | None = None
    everybody: bool = False
    engine: EngineName = "auto"


def served_listener(options: ServeOptions) -> tuple[Listener, Capacity]:
    """Loaded, at the hop it will be served with, and measured; blocks for some seconds.

    Raises ConfigError, ModelError.
    """
    from sfms_robot.listeners.registry import at_hop, hops_of, load_listener

    listener = load_listener(options.listener, engine=options.engine, threads=1)  # others step batches of their own
    hops = hops_of(listener)
    if options.hop is not None:
        from sfms_robot.errors import ConfigError

        if options.hop not in hops:
            raise ConfigError(f"--hop {options.hop}: listener {options.listener!r} has {', '.join(map(str, hops))}")
        listener = at_hop(listener, options.hop)
    else:
        p50_s, p99_s = plan_times_s(at_hop(listener, min(hops)))
        listener = at_hop(
            listener, choose_hop(hops, Latencies(listener.horizon, 0.0, p50_s, p99_s, LEAD_S, TICK_S)).hop
        )
    return listener, measure_capacity(listener)


class BatchWorkers:
    """Threads around a `StreamServer`: messages in, batches stepped, messages out.

    Args:
        send: one message to one stream; called from any of the threads, must not block.
    """

    def __init__(self, server: StreamServer, send: Callable[[str, bytes], None], workers: int) -> None:
        self.server, self._send = server, send
        self._changed = threading.Condition()
        self._frames: deque[tuple[str, bytes, float]] = deque()
        self._joins: deque[tuple[bytes, Callable[[bytes], None]]] = deque()
        self._over = False
        self._threads = [
            threading.Thread(target=self._work, name=f"batches {index}", daemon=True) for index in range(workers)
        ]
        for thread in self._threads:
            thread.start()

    def receive(self, stream: str, message: bytes) -> None:
        """From any thread."""
        with self._changed:
            self._frames.append((stream, message, time.monotonic()))
            self._changed.notify()

    def join(self, message: bytes, answer: Callable[[bytes], None]) -> None:
        """From any thread; `answer` is called from one of the workers'."""
        with self._changed:
            self._joins.append((message, answer))
            self._changed.notify()

    def statistics(self) -> Mapping[str, Any]:
        """As of `StreamServer`, from any thread."""
        with self._changed:
            return self.server.statistics()

    def close(self) -> None:
        """Ends after the steps at hand. Idempotent."""
        with self._changed:
            self._over = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _work(self) -> None:
        while True:
            said: list[tuple[Callable[[bytes], None], bytes]] = []
            notices: list[tuple[str, bytes]] = []
            with self._changed:
                self._changed.wait_for(lambda: self._over or self._frames or self._joins or self._waits(), LOOK_S)
                if self._over:
                    return
                now_s = time.monotonic()
                while self._joins:
                    message, answer = self._joins.popleft()
                    said.append((answer, self.server.join(message, now_s)))
                while self._frames:
                    stream, message, came_s = self._frames.popleft()
                    notices += [(stream, each) for each in self.server.receive(stream, message, came_s)]
                self.server.expire(now_s)
                batch = self.server.batch()
            for answer, message in said:
                answer(message)
            for stream, message in notices:
                self._send(stream, message)
            if batch is None:
                continue
            began_s = time.monotonic()
            try:
                answers = self.server.step(batch)
            except Exception:
                log.exception("a batch of %d streams failed: they are given up", len(batch.streams))
                with self._changed:
                    self.server.failed(batch)
                continue
            with self._changed:
                messages = self.server.finish(batch, answers, began_s, time.monotonic())
            for stream, message in messages:
                self._send(stream, message)

    def _waits(self) -> bool:
        return self.server.waits


class ZenohService:
    """A `StreamServer` on the keys of `name`. Serves from construction until `close`. Raises PortError."""

    def __init__(self, server: StreamServer, name: str, config: zenoh.Config, workers: int) -> None:
        self._name = name
        self._session = serve_session(config)
        self._publishers: dict[str, zenoh.Publisher] = {}
        self.workers = BatchWorkers(server, self._publish, workers)
        self._session.declare_queryable(join_key(name), self._on_join)
        self._session.declare_subscriber(f"{ROOT}/{name}/*/up", self._on_frame)

    def close(self) -> None:
        """Idempotent."""
        self.workers.close()
        close_session(self._session)

    def _on_join(self, query: zenoh.Query) -> None:
        payload = query.payload
        if payload is not None:
            self.workers.join(payload.to_bytes(), lambda answer: query.reply(join_key(self._name), answer))

    def _on_frame(self, sample: zenoh.Sample) -> None:
        stream = str(sample.key_expr).split("/")[-2]
        self.workers.receive(stream, sample.payload.to_bytes())

    def _publish(self, stream: str, message: bytes) -> None:
        import zenoh

        self._session.put(
            down_key(self._name, stream),
            message,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )


def serve(options: ServeOptions, over: threading.Event, say: Callable[[str], None]) -> dict[str, Any]:
    """Serve until `over` is set. Returns the figures. Blocks until then.

    Raises ConfigError, MissingExtra, ModelError, PortError.
    """
    from sfms_robot.runtime.service_notify import ServiceManager

    check_zenoh()
    name = check_name(options.name or Path(options.listener).name, "listener")
    config = session_config("serve", options.zenoh)
    service_manager = ServiceManager()
    with ExitStack() as stack:
        metrics = stack.enter_context(MetricsServer(options.metrics)) if options.metrics is not None else None
        listener, capacity = served_listener(options)
        server = StreamServer(listener, name, None if options.everybody else capacity, os.uname().nodename)
        service = ZenohService(server, name, config, options.workers or min(2, os.cpu_count() or 1))
        stack.callback(service.close)
        if metrics is not None:
            metrics.serve(service.workers.statistics)
            say(f"metrics: {metrics.url}")
        most = capacity.most(DEADLINE_S)
        say(f"{name}: a plan every {listener.hop} frames, up to {most} heads in {DEADLINE_S * 1e3:.0f} ms here")
        service_manager.ready(f"{name}: up to {most} heads")
        while not over.wait(service_manager.every_s):
            service_manager.alive()
        service_manager.stopping()
        return dict(service.workers.statistics())
