"""`serve --metrics PORT`: figures for Prometheus at http://127.0.0.1:PORT/metrics, by prometheus_client."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from sfms_robot.app.loopback_server import Answer, Document, LoopbackServer
from sfms_robot.endpoint import HIGHEST_PORT, LOOPBACK, port_number
from sfms_robot.errors import ConfigError, MissingExtra, PortError

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


class MetricsServer:
    """Holds its port from construction until it is left; answers from `serve` on.

    Args:
        wanted: a port, "0" for any that is free; HOST:PORT beyond loopback.

    Raises ConfigError, MissingExtra, PortError.
    """

    def __init__(self, wanted: str) -> None:
        try:
            import prometheus_client  # noqa: F401
        except ImportError as error:
            raise MissingExtra.of("--metrics", "remote") from error
        self._host, self._port = _address(wanted)
        self._taken = wanted
        self.url = ""

    def __enter__(self) -> MetricsServer:
        try:
            self._server = LoopbackServer(self._port, _Answer, "metrics", host=self._host)
        except OSError as error:
            raise PortError(f"--metrics {self._taken}: {error.strerror or error}") from error
        self.url = f"{self._server.url}metrics"
        return self

    def serve(self, statistics: Document) -> None:
        """Answer with these from now on."""
        self._server.document = statistics
        self._server.begin()

    def __exit__(self, *_: object) -> None:
        self._server.close()


class _Answer(Answer):
    def do_GET(self) -> None:
        from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

        self.answer(200, generate_latest(_Collector(self.server.document)), CONTENT_TYPE_LATEST)


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


def _address(wanted: str) -> tuple[str, int]:
    host, _, number = wanted.rpartition(":")
    port = port_number(number)
    if port is None:
        raise ConfigError(f"--metrics {wanted}: is no TCP port (0 to {HIGHEST_PORT}, 0 for a free one, or HOST:PORT)")
    return host or LOOPBACK, port
