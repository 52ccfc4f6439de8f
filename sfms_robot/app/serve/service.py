"""`sfms-robot serve`: a listener for many heads, over zenoh (`listeners.zenoh_link` has the keys).

Messages come in threads of zenoh's, and go on to the processes that step (`worker_pool`).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfms_robot.app.serve.batch_process import Served
from sfms_robot.app.serve.metrics import MetricsServer
from sfms_robot.app.serve.worker_pool import WorkerPool
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.serving.stream_server import DEADLINE_S
from sfms_robot.listeners.zenoh_link import ROOT, down_key, join_key
from sfms_robot.network import Router, check_name, check_zenoh, close_session, serve_session, session_config

if TYPE_CHECKING:
    import zenoh


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
        metrics = stack.enter_context(MetricsServer(options.metrics)) if options.metrics is not None else None
        server = os.uname().nodename
        served = Served(options.listener, name, server, options.engine, options.hop, options.everybody)
        service = ZenohService(served, config, options.processes)
        stack.callback(service.close)
        pool = service.pool
        if metrics is not None:
            metrics.serve(pool.statistics)
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
