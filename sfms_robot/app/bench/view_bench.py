"""The page beside the servo loop: what three who look cost, and how soon a halt from the page is on the wire.

    without    the default head on emulated servos listens; no page
    with       the same, and three plain WebSocket clients in a process of their own read every picture

Both in turn, several times: what else a computer does changes a run's share by more than a page does. Processor time is
that of the run's process and of the page's, once a second, and medians are compared; the listener, the servos and the
clients have processes of their own and are not counted. A halt counts from the click, a message that leaves a fourth
client, until the goals of the first braking tick are written.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from sfms_robot.app.bench.measure import HEAD, Told, machine, row
from sfms_robot.app.bench.procfs import processor_time_s
from sfms_robot.app.listen.page_session import page_session
from sfms_robot.app.listen.preflight import begin_page
from sfms_robot.app.session import RunOptions, run
from sfms_robot.child_process import take_pipes
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.ports import Observer, Tick
from sfms_robot.sources.speakers import DEFAULT_SPEAKER

SETTLE_S: Final = 4.0
WINDOW_S: Final = 8
ROUNDS: Final = 3
HALTS: Final = 8
CLIENTS: Final = 3
MOST_CPU: Final = 3.0  # % of a core
MOST_HALT_MS: Final = 100.0
_BETWEEN_S: Final = 2.3  # a halt, and the head is led back into the face; no multiple of a tick
_LIMIT_S: Final = 60.0
_CHILD: Final = "from sfms_robot.app.bench.view_bench import clients; clients()"


def measure(say: Callable[[str], None]) -> Told:
    """All runs, two and a half minutes. Linux only. Raises ConfigError elsewhere, BusError when a run ends early."""
    if not Path("/proc/self/stat").is_file():
        raise ConfigError("bench view: processor time of the page's process is read from /proc (Linux)")
    without, viewed, page_shares = [], [], []
    late = {"without": 0, "with": 0}  # not counting a halt that ends: torque comes on again, which blocks
    for number in range(1, ROUNDS + 1):
        say(f"{number} of {ROUNDS}: {WINDOW_S} s without a page")
        plain = _Watch()
        late["without"] += _finished(run(_options(SETTLE_S + WINDOW_S + 1), observers=[plain]))["tick"]["late"]
        without += plain.shares
        say(f"{number} of {ROUNDS}: {WINDOW_S} s with {CLIENTS} clients")
        watch, told, _ = _viewed(0)
        late["with"] += told["tick"]["late"]
        viewed += watch.shares
        page_shares += watch.page_shares
    say(f"{HALTS} halts")
    _, _, clicks_ms = _viewed(HALTS)
    figures: dict[str, Any] = {
        "view.cpu": row(viewed, without, "% of a core", "the same run without a page"),
        "view.halt": row(clicks_ms, [MOST_HALT_MS], "ms", "what there is time for"),
    }
    cost = float(np.median(viewed) - np.median(without))
    figures |= {
        "cost": {"share": round(cost, 3), "unit": "% of a core", "clients": CLIENTS, "wanted": MOST_CPU},
        "late_ticks": late,
        "machine": machine(),
    }
    rows = Told.of_rows({name: figures[name] for name in ("view.cpu", "view.halt")}).table
    lines = [
        f"{CLIENTS} clients: {cost:.2f} % of a core, of which the page's process {np.median(page_shares):.2f}",
        f"late ticks: {late['with']}, without a page {late['without']}",
    ]
    return Told(figures, rows, lines)


class _Watch(Observer):
    """Processor time [% of a core] of each second of the window, and when the first braking goals were written.

    Attributes:
        shares: of this process and `page`, the number of another; page_shares: of that alone.
        halted: set at the first tick that brakes, which was at `halted_s` of `time.monotonic`.
    """

    def __init__(self, page: int | None = None) -> None:
        self.shares: list[float] = []
        self.page_shares: list[float] = []
        self.listening, self.halted, self.measured = threading.Event(), threading.Event(), threading.Event()
        self.halted_s = 0.0
        self._page = page
        self._state = ""
        threading.Thread(target=self._sample, name="sampler", daemon=True).start()

    def tick(self, seen: Tick) -> None:
        if seen.state != self._state:
            self._state = seen.state
            if seen.state == "halted":
                self.halted_s = time.monotonic()
                self.halted.set()
        if seen.time_s >= SETTLE_S:
            self.listening.set()

    def _sample(self) -> None:
        if not self.listening.wait(_LIMIT_S):
            return
        before_s, ours, theirs = time.monotonic(), _own_s(), _other_s(self._page)
        for _ in range(WINDOW_S):
            time.sleep(1.0)
            now_s, own, other = time.monotonic(), _own_s(), _other_s(self._page)
            self.shares.append(100 * (own - ours + other - theirs) / (now_s - before_s))
            self.page_shares.append(100 * (other - theirs) / (now_s - before_s))
            before_s, ours, theirs = now_s, own, other
        self.measured.set()


def _options(duration_s: float) -> RunOptions:
    return RunOptions(head=HEAD, audio=DEFAULT_SPEAKER, duration_s=duration_s)


def _viewed(halts: int) -> tuple[_Watch, dict[str, Any], list[float]]:
    """The run with a page: what was seen, its report, and how long each halt took [ms]."""
    options = _options(SETTLE_S + WINDOW_S + 1 + (halts and (halts + 1) * _BETWEEN_S + 1))
    page = begin_page("0")
    assert page is not None
    clicks_ms: list[float] = []
    with closing(page), page_session(page, options) as pages:
        watch = _Watch(page.process_id)
        with _reading(page.url):
            clicker = threading.Thread(target=_click, args=(page.url, watch, halts, clicks_ms), daemon=True)
            clicker.start()
            report = _finished(pages.run(observers=[watch]))
            clicker.join(_LIMIT_S)
    return watch, report, clicks_ms


def _click(url: str, watch: _Watch, halts: int, clicks_ms: list[float]) -> None:
    """Halt again and again, once processor time was measured."""
    if not halts or not watch.measured.wait(_LIMIT_S):
        return
    with suppress(WebSocketException), _visitor(url) as visitor:
        reader = threading.Thread(target=_read_all, args=(visitor,), daemon=True)
        reader.start()
        for _ in range(halts):
            watch.halted.clear()
            clicked_s = time.monotonic()
            visitor.send('{"type": "halt"}')
            if not watch.halted.wait(1.0):
                return
            clicks_ms.append((watch.halted_s - clicked_s) * 1e3)
            visitor.send('{"type": "resume"}')
            time.sleep(_BETWEEN_S)


def _finished(report: dict[str, Any]) -> dict[str, Any]:
    if report["exit"] != "done":
        raise BusError(f"the run ended by itself: {report['exit']} {report['error'] or ''}")
    return report


def _own_s() -> float:
    return time.process_time()


def _other_s(process: int | None) -> float:
    """Processor time of a process; 0 of none."""
    return 0.0 if process is None else processor_time_s(process)


@contextmanager
def _reading(url: str) -> Iterator[None]:
    """Clients that read all there is, in a process of their own, while inside."""
    with subprocess.Popen([sys.executable, "-P", "-c", _CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdin is not None
        child.stdin.write(json.dumps(url).encode() + b"\n")
        child.stdin.flush()
        try:
            yield
        finally:
            child.stdin.close()


def _visitor(url: str) -> ClientConnection:
    return connect(url.replace("http", "ws", 1) + "ws", compression=None)


def _read_all(visitor: ClientConnection) -> None:
    with suppress(WebSocketException):
        while True:
            visitor.recv()


def clients() -> None:
    """The clients' process: reads until its pipe ends."""
    incoming, _ = take_pipes()
    url = json.loads(incoming.readline())
    for _ in range(CLIENTS):
        threading.Thread(target=_read, args=(url,), daemon=True).start()
    incoming.read()


def _read(url: str) -> None:
    with _visitor(url) as visitor:
        _read_all(visitor)
