"""`bench view`: the cost of three visitors of the page, and the delay of a halt from the page.

    without    no visitor, and the run sends its page no data
    with       it sends the page everything, and three plain WebSocket clients in a separate process read all of it

These are alternating windows within one run of the default head on emulated servos: two runs that do the same work
differ by several times the cost of a page. The cost is the processor time of the page's process, of the loop's thread
while it updates the page, and of the threads that send. Whole windows differ by chance more than by that; the figure
`run_apart` is the time that the run's process took in each window with clients, less the mean of the two neighbours.
The listener, the servos and the clients have separate processes, which are not counted. A halt counts from the click, a
message of a fourth client, until the goals of the first braking tick are written.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from sfms_robot.app.listen.page_observer import PageObserver
from sfms_robot.app.listen.page_session import page_session
from sfms_robot.app.options import RunOptions, begin_page
from sfms_robot.app.session import Document, RunControls, run
from sfms_robot.config import load_head
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.lab.bench.measure import HEAD, BenchResult, machine, processor_time_s, row
from sfms_robot.ports import Observer, Tick
from sfms_robot.processes import Child, ParentPipe
from sfms_robot.sources.registry import DEFAULT_SPEAKER
from sfms_robot.viewer.page_process import THREAD, PageProcess

_SETTLE_S: Final = 4.0
_PAUSE_S: Final = 1.0  # after a change: clients connect or leave
_WINDOW_S: Final = 4.0
_PAIRS: Final = 10
_HALTS: Final = 8
_CLIENTS: Final = 3
_MOST_CPU: Final = 3.0  # % of a core
_MOST_HALT_MS: Final = 100.0
_BETWEEN_S: Final = 2.3  # a halt and the way back to the face; not a multiple of a tick
_LIMIT_S: Final = 60.0
_CLOSE_S: Final = 5.0


@dataclass(frozen=True, kw_only=True)
class Window:
    """`_WINDOW_S` of a run: processor time in % of a core, and late ticks.

    Attributes:
        run_share: Of the run's process.
        telling_share: The part of it that serves the page.
        page_share: Of the page's process.
    """

    run_share: float
    telling_share: float
    page_share: float
    late: int


def measure(say: Callable[[str], None]) -> BenchResult:
    """Measure both runs; takes two and a half minutes. Linux only.

    Raises ConfigError elsewhere, BusError when a run ends early.
    """
    if not Path("/proc/self/stat").is_file():
        raise ConfigError("bench view: processor time of the page's process is read from /proc (Linux)")
    say(f"{_PAIRS} times {_PAUSE_S + _WINDOW_S:g} s with {_CLIENTS} clients, and without a page before and after")
    windows = _windows()
    say(f"{_HALTS} halts")
    figures = cost_figures(windows) | {
        "view.halt": row(_halts(), [_MOST_HALT_MS], "ms", "what there is time for"),
        "machine": machine(),
    }
    cost, apart, late = figures["cost"], figures["run_apart"], figures["late_ticks"]
    rows = BenchResult.of_rows({name: figures[name] for name in ("view.cpu", "view.halt")}).table
    lines = [
        f"{_CLIENTS} clients: {cost['share']:.2f} % of a core: the page's process {cost['page_share']:.2f}, telling it "
        f"{cost['telling_share']:.2f}",
        f"the run's process beside that without a page: {apart['median']:+.2f} (half of the windows "
        f"{apart['quartiles'][0]:+.2f} to {apart['quartiles'][1]:+.2f})",
        f"late ticks: {late['with']}, without a page {late['without']}",
    ]
    return BenchResult(figures, rows, lines)


def cost_figures(windows: Sequence[Window]) -> dict[str, Any]:
    """Return the figures of alternating windows without and with clients; the first and the last are without."""
    looked, without = windows[1::2], windows[::2]
    neighbours = np.array([one.run_share for one in without])
    apart = np.array([one.run_share for one in looked]) - (neighbours[:-1] + neighbours[1:]) / 2
    page, telling = (float(np.mean([getattr(one, name) for one in looked])) for name in ("page_share", "telling_share"))
    whole = [one.run_share + one.page_share for one in looked]
    return {
        "view.cpu": row(whole, neighbours.tolist(), "% of a core", "the same run without a page"),
        "cost": {
            "share": round(page + telling, 3), "page_share": round(page, 3), "telling_share": round(telling, 3),
            "unit": "% of a core", "clients": _CLIENTS, "wanted": _MOST_CPU,
        },
        "run_apart": {
            "median": round(float(np.median(apart)), 3),
            "quartiles": [round(float(each), 3) for each in np.percentile(apart, [25, 75])], "unit": "% of a core",
        },
        "late_ticks": {
            "without": sum(one.late for one in without[1:]),  # as many windows as with
            "with": sum(one.late for one in looked),
        },
    }  # fmt: skip


class _Turns(Observer):
    """Forwards the run to another observer while `on`.

    Attributes:
        settled: Set once the run is under way.
        spent_s: Processor time of the loop's thread in the inner observer.
    """

    def __init__(self, inner: Observer) -> None:
        self.on, self.settled, self.spent_s = False, threading.Event(), 0.0
        self._inner = inner

    def tick(self, seen: Tick) -> None:
        if seen.time_s >= _SETTLE_S:
            self.settled.set()
        self._forward(self._inner.tick, seen)

    def heard(self, frame: SpeakerFrame) -> None:
        self._forward(self._inner.heard, frame)

    def planned(self, plan: Plan) -> None:
        self._forward(self._inner.planned, plan)

    def _forward(self, method: Callable[[Any], None], what: object) -> None:
        if self.on:
            began_s = time.thread_time()
            method(what)
            self.spent_s += time.thread_time() - began_s


class _Halted(Observer):
    """Notes when the run is under way and when the first braking goals were written.

    Attributes:
        halted: Set at the first tick that brakes, at `halted_s` of `time.monotonic`.
    """

    def __init__(self) -> None:
        self.settled, self.halted = threading.Event(), threading.Event()
        self.halted_s = 0.0
        self._state = ""

    def tick(self, seen: Tick) -> None:
        if seen.state != self._state:
            self._state = seen.state
            if seen.state == "halted":
                self.halted_s = time.monotonic()
                self.halted.set()
        if seen.time_s >= _SETTLE_S:
            self.settled.set()


def _windows() -> list[Window]:
    """Run once, and return its windows without and with clients in turn."""
    found: list[Window] = []
    page = begin_page("0")
    assert page is not None
    with closing(page), _readers() as look:
        page.wait()
        page.say("begin", scene=HEAD)
        watcher = PageObserver(page, list(load_head(HEAD).joints))
        turns = _Turns(watcher)

        @contextmanager
        def sampled(controls: RunControls) -> Iterator[None]:
            watcher.document = controls.document
            threading.Thread(target=_sample, args=(controls.document, turns, page, look, found), daemon=True).start()
            yield

        duration_s = _SETTLE_S + (2 * _PAIRS + 1) * (_PAUSE_S + _WINDOW_S) + _PAUSE_S
        _check_finished(run(_options(duration_s), sampled, observers=[turns]))
    if len(found) < 2 * _PAIRS + 1:
        raise BusError(f"bench view: the run ended after {len(found)} of {2 * _PAIRS + 1} windows")
    return found


def _sample(
    document: Document, turns: _Turns, page: PageProcess, look: Callable[[str | None], None], found: list[Window]
) -> None:
    """Measure the windows of a run, in a separate thread."""

    def used() -> tuple[float, float, float]:
        """Return the processor time of this process, of its part for the page, and of the page's process."""
        senders = [each.native_id for each in threading.enumerate() if each.name == THREAD]
        sending_s = sum(processor_time_s(os.getpid(), thread) for thread in senders)
        return time.process_time(), turns.spent_s + sending_s, processor_time_s(page.process_id)

    if not turns.settled.wait(_LIMIT_S):
        return
    for number in range(2 * _PAIRS + 1):
        turns.on = number % 2 == 1
        look(page.url if turns.on else None)
        time.sleep(_PAUSE_S)
        late, began_s, before_s = document()["tick"]["late"], time.monotonic(), used()
        time.sleep(_WINDOW_S)
        share = 100 / (time.monotonic() - began_s)
        run_s, telling_s, page_s = (share * (now - before) for now, before in zip(used(), before_s, strict=True))
        late = document()["tick"]["late"] - late
        found.append(Window(run_share=run_s, telling_share=telling_s, page_share=page_s, late=late))
    look(None)


def _options(duration_s: float) -> RunOptions:
    return RunOptions(head=HEAD, audio=DEFAULT_SPEAKER, duration_s=duration_s)


def _check_finished(report: dict[str, Any]) -> None:
    if report["exit"] != "done":
        raise BusError(f"bench view: the run ended early: {report['exit']} {report['error'] or ''}")


def _halts() -> list[float]:
    """Return the duration of each halt [ms], in a run whose page has other visitors too."""
    options = _options(_SETTLE_S + (_HALTS + 1) * _BETWEEN_S + 1)
    page = begin_page("0")
    assert page is not None
    clicks_ms: list[float] = []
    with closing(page), page_session(page, options) as pages, _readers() as look:
        look(page.url)
        watch = _Halted()
        clicker = threading.Thread(target=_click, args=(page.url, watch, clicks_ms), daemon=True)
        clicker.start()
        _check_finished(pages.run(observers=[watch]))
        clicker.join(_LIMIT_S)
    return clicks_ms


def _click(url: str, watch: _Halted, clicks_ms: list[float]) -> None:
    """Halt and resume the run `_HALTS` times."""
    if not watch.settled.wait(_LIMIT_S):
        return
    with suppress(WebSocketException), _visitor(url) as visitor:
        threading.Thread(target=_read_all, args=(visitor,), daemon=True).start()
        for _ in range(_HALTS):
            watch.halted.clear()
            clicked_s = time.monotonic()
            visitor.send('{"type": "halt"}')
            if not watch.halted.wait(1.0):
                return
            clicks_ms.append((watch.halted_s - clicked_s) * 1e3)
            visitor.send('{"type": "resume"}')
            time.sleep(_BETWEEN_S)


# --- clients --------------------------------------------------------------------------------------------------------


@contextmanager
def _readers() -> Iterator[Callable[[str | None], None]]:
    """Start clients in a process of their own; yield a function that has them read all of a page, or of none."""
    child = Child(f"{__name__}:clients", name="clients")
    try:
        yield child.send
    finally:
        child.close(_CLOSE_S)


def _visitor(url: str) -> ClientConnection:
    return connect(url.replace("http", "ws", 1) + "ws", compression=None)


def _read_all(visitor: ClientConnection) -> None:
    with suppress(WebSocketException):
        while True:
            visitor.recv()


def clients() -> None:
    """Read the page of the newest message, in the clients' process, until its pipe ends."""
    parent, visitors = ParentPipe(), list[ClientConnection]()
    while True:
        url = parent.receive()
        for visitor in visitors:
            visitor.close()
        visitors = [] if url is None else [_visitor(url) for _ in range(_CLIENTS)]
        for visitor in visitors:
            threading.Thread(target=_read_all, args=(visitor,), daemon=True).start()
