"""`sfms-robot serve`: a listener for many heads, over zenoh (`listeners.zenoh_link` has the keys).

Messages come in threads of zenoh's, and go on to the processes that step (`worker_pool`).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.app.serve.batch_process import Served
from sfms_robot.app.serve.worker_pool import WorkerPool
from sfms_robot.endpoint import HIGHEST_PORT, LOOPBACK, port_number
from sfms_robot.errors import ConfigError, optional
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.serving.stream_server import DEADLINE_S
from sfms_robot.listeners.zenoh_link import ROOT, down_key, join_key
from sfms_robot.network import Router, check_name, check_zenoh, close_session, serve_session, session_config

if TYPE_CHECKING:
    import zenoh

    from sfms_robot.viewer.web_server import Document, LocalServer

_MS: Final = 1e-3

# Name, kind, what it says, where in the statistics of `StreamServer`, and the factor to the unit of the name.
_FIGURES: Final[tuple[tuple[str, str, str, tuple[str, ...], float], ...]] = (
    ("heads", "gauge", "Heads that are listened for", ("heads",), 1.0),
    ("heads_most", "gauge", "Heads that could be answered in time", ("most_heads",), 1.0),
    ("plans", "counter", "Plans made", ("plans",), 1.0),
    ("deadline_misses", "counter", "Plans later than the deadline", ("deadline_misses",), 1.0),
    ("deadline_seconds", "gauge", "Promised from a frame to its plan", ("deadline_ms",), _MS),
    ("plan_delay_p50_seconds", "gauge", "Median from a frame to its plan, of the last plans", ("delay_ms", "p50"), _MS),
    ("plan_delay_p99_seconds", "gauge", "99th percentile of the same", ("delay_ms", "p99"), _MS),
    ("batches", "counter", "Batches stepped", ("batches",), 1.0),
    ("steps", "counter", "Frames stepped, over all heads", ("steps",), 1.0),
    ("batch_size_p50", "gauge", "Median of the heads in a batch", ("batch_size", "p50"), 1.0),
    ("batch_size_p99", "gauge", "99th percentile of the same", ("batch_size", "p99"), 1.0),
    ("frames_skipped", "counter", "Frames left out, since too many were waiting", ("skipped_frames",), 1.0),
    ("frames_lost", "counter", "Frames that never came", ("lost_frames",), 1.0),
    ("refused", "counter", "Robots that were refused", ("refused",), 1.0),
    ("malformed", "counter", "Messages that could not be read", ("malformed",), 1.0),
    ("cost_scale", "gauge", "How much longer batches take than measured at the start", ("cost_scale",), 1.0),
)


@dataclass(frozen=True)
class ServeOptions:
    """The flags of `sfms-robot serve`.

    Attributes:
        listener: shipped name or folder.
        name: that robots ask for, zenoh/NAME; None: the listener's.
        zenoh: zenoh's configuration; None: loopback.
        metrics: TCP port of /metrics; None: none.
        hop: None for the one that a robot would choose by what a plan takes here.
        processes: that step; None: one for each core.
        everybody: admit without asking what it costs.
        engine: what the listener's networks are computed by.
        insecure: allow endpoints beyond loopback without TLS.
    """

    listener: str = "sfms-small"
    name: str | None = None
    zenoh: Path | None = None
    metrics: str | None = None
    hop: int | None = None
    processes: int | None = None
    everybody: bool = False
    engine: EngineName = "auto"
    insecure: bool = False


class ZenohService:
    """A `WorkerPool` on the keys of what it serves. From construction, which blocks for some seconds, until `close`.

    Raises PortError, and as `WorkerPool`.
    """

    def __init__(self, served: Served, config: zenoh.Config, processes: int | None) -> None:
        self._name = served.name
        self._session = serve_session(config)
        try:
            self.pool = WorkerPool(served, self._publish, processes)
        except BaseException:
            close_session(self._session)
            raise
        self._session.declare_queryable(join_key(self._name), self._on_join)
        self._session.declare_subscriber(f"{ROOT}/{self._name}/*/up", self._on_frame)

    def close(self) -> None:
        """Idempotent."""
        self.pool.close()
        close_session(self._session)

    def _on_join(self, query: zenoh.Query) -> None:
        payload = query.payload
        if payload is not None:
            self.pool.join(payload.to_bytes(), lambda answer: query.reply(join_key(self._name), answer))

    def _on_frame(self, sample: zenoh.Sample) -> None:
        stream = str(sample.key_expr).split("/")[-2]
        self.pool.receive(stream, sample.payload.to_bytes())

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
    config = session_config("serve", Router(options.zenoh, options.insecure))
    service_manager = ServiceManager()
    with ExitStack() as stack:
        metrics = None if options.metrics is None else stack.enter_context(closing(metrics_server(options.metrics)))
        server = os.uname().nodename
        served = Served(options.listener, name, server, options.engine, options.hop, options.everybody)
        service = ZenohService(served, config, options.processes)
        stack.callback(service.close)
        pool = service.pool
        if metrics is not None:
            metrics.begin(pool.statistics)
            say(f"metrics: {metrics.url}")
        say(
            f"{name}: a plan every {pool.hop} frames, up to {pool.most} heads in {DEADLINE_S * 1e3:.0f} ms here, "
            f"by {len(pool.capacities)} processes"
        )
        service_manager.ready(f"{name}: up to {pool.most} heads")
        while pool.problem is None and not over.wait(service_manager.every_s):
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

    host, _, number = wanted.rpartition(":")
    port = port_number(number)
    if port is None:
        raise ConfigError(f"--metrics {wanted}: is no TCP port (0 to {HIGHEST_PORT}, 0 for a free one, or HOST:PORT)")

    def routes(statistics: Document) -> list[Route]:
        def metrics(request: Request) -> Response:
            return Response(generate_latest(_Collector(statistics)), media_type=CONTENT_TYPE_LATEST)

        return [Route("/{path:path}", metrics)]

    server = LocalServer("--metrics", routes, host or LOOPBACK, port)
    server.url += "metrics"
    return server


class _Collector:
    """The statistics as Prometheus reads them."""

    def __init__(self, statistics: Document) -> None:
        self._statistics = statistics

    def collect(self) -> Iterable[Any]:
        """Yield one metric for each figure that the statistics hold now."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        told = self._statistics()
        for name, kind, text, keys, factor in _FIGURES:
            value: Any = told
            for key in keys:
                value = value[key]
            if value is None:
                continue
            family = CounterMetricFamily if kind == "counter" else GaugeMetricFamily
            metric = family(f"sfms_{name}", text, labels=["listener", "server"])
            metric.add_metric([told["listener"], told["server"]], float(value) * factor)
            yield metric
