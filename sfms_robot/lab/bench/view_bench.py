"""The page beside the servo loop: what three who look cost, and how soon a halt from the page is on the wire.

    without    nobody looks, and the run tells its page nothing
    with       it tells the page everything, and three plain WebSocket clients in a process of their own read all of it

Windows of the default head's run on emulated servos, by turns and within one run: two runs that do the same work differ
by several times what a page costs. What looking costs is the processor time of the page's process, of the loop's thread
while it tells the page, and of the threads that send. Whole windows differ by chance more than by that; beside it
stands what the run's process took in each window with clients, less the mean of its two neighbours. The listener, the
servos and the clients have processes of their own and are not counted. A halt counts from the click, a message that
leaves a fourth client, until the goals of the first braking tick are written.
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
from sfms_robot.app.session import Document, run
from sfms_robot.config import load_head
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.lab.bench.measure import HEAD, Told, machine, row
from sfms_robot.lab.bench.procfs import processor_time_s
from sfms_robot.ports import Observer, Tick
from sfms_robot.processes import Child, ParentPipe
from sfms_robot.sources.registry import DEFAULT_SPEAKER
from sfms_robot.viewer.page_process import THREAD, PageProcess

SETTLE_S: Final = 4.0
PAUSE_S: Final = 1.0  # after a turn: who comes gets a hello, who goes says good-bye
WINDOW_S: Final = 4.0
PAIRS: Final = 10
HALTS: Final = 8
CLIENTS: Final = 3
MOST_CPU: Final = 3.0  # % of a core
MOST_HALT_MS: Final = 100.0
_BETWEEN_S: Final = 2.3  # a halt, and the head is led back into the face; no multiple of a tick
_LIMIT_S: Final = 60.0
_CLOSE_S: Final = 5.0


@dataclass(frozen=True)
class Window:
    """`WINDOW_S` of a run: processor time [% of a core] of its process, of what it does for the page, and of the page's
    process, and ticks that came late."""

    looked_at: bool
    run_share: float
    telling_share: float
    page_share: float
    late: int


def measure(say: Callable[[str], None]) -> Told:
    """Both runs, two and a half minutes. Linux only. Raises ConfigError elsewhere, BusError when a run ends early."""
    if not Path("/proc/self/stat").is_file():
        raise ConfigError("bench view: processor time of the page's process is read from /proc (Linux)")
    say(f"{PAIRS} times {PAUSE_S + WINDOW_S:g} s with {CLIENTS} clients, and without a page before and after")
    windows = _windows()
    say(f"{HALTS} halts")
    figures = cost_figures(windows) | {
        "view.halt": row(_halts(), [MOST_HALT_MS], "ms", "what there is time for"),
        "machine": machine(),
    }
    cost, apart, late = figures["cost"], figures["run_apart"], figures["late_ticks"]
    rows = Told.of_rows({name: figures[name] for name in ("view.cpu", "view.halt")}).table
    lines = [
        f"{CLIENTS} clients: {cost['share']:.2f} % of a core: the page's process {cost['page_share']:.2f}, telling it "
        f"{cost['telling_share']:.2f}",
        f"the run's process beside that without a page: {apart['median']:+.2f} (half of the windows "
        f"{apart['quartiles'][0]:+.2f} to {apart['quartiles'][1]:+.2f})",
        f"late ticks: {late['with']}, without a page {late['without']}",
    ]
    return Told(figures, rows, lines)


def cost_figures(windows: Sequence[Window]) -> dict[str, Any]:
    """What looking costs. `windows` are without and with clients by turns; the first and the last are without."""
    before, looked, after = windows[:-2:2], windows[1::2], windows[2::2]
    apart = [
        one.run_share - (left.run_share + right.run_share) / 2
        for left, one, right in zip(before, looked, after, strict=True)
    ]
    page, telling = (
        float(np.mean(shares)) for shares in zip(*[(w.page_share, w.telling_share) for w in looked], strict=True)
    )
    whole = [one.run_share + one.page_share for one in looked]
    return {
        "view.cpu": row(whole, [one.run_share for one in windows[::2]], "% of a core", "the same run without a page"),
        "cost": {
            "share": round(page + telling, 3), "page_share": round(page, 3), "telling_share": round(telling, 3),
            "unit": "% of a core", "clients": CLIENTS, "wanted": MOST_CPU,
        },
        "run_apart": {
            "median": round(float(np.median(apart)), 3),
            "quartiles": [round(float(each), 3) for each in np.percentile(apart, [25, 75])], "unit": "% of a core",
        },
        "late_ticks": {
            "without": sum(one.late for one in windows[2::2]),  # as many windows as with
            "with": sum(one.late for one in looked),
        },
    }  # fmt: skip


class _Turns(Observer):
    """Tells an observer what happens while `on`.

    Attributes:
        settled: set once the run is under way.
        spent_s: processor time of the loop's thread in `inner`.
    """

    def __init__(self, inner: Observer) -> None:
        self.on, self.settled, self.spent_s = False, threading.Event(), 0.0
        self._inner = inner

    def tick(self, seen: Tick) -> None:
        if seen.time_s >= SETTLE_S:
            self.settled.set()
        self._tell(self._inner.tick, seen)

    def heard(self, frame: SpeakerFrame) -> None:
        self._tell(self._inner.heard, frame)

    def planned(self, plan: Plan) -> None:
        self._tell(self._inner.planned, plan)

    def _tell(self, hear: Callable[[Any], None], what: object) -> None:
        if self.on:
            began_s = time.thread_time()
            hear(what)
            self.spent_s += time.thread_time() - began_s


class _Halted(Observer):
    """Says when the run was under way, and when the first braking goals were written.

    Attributes:
        halted: set at the first tick that brakes, which was at `halted_s` of `time.monotonic`.
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
        if seen.time_s >= SETTLE_S:
            self.settled.set()


def _windows() -> list[Window]:
    """One run, without and with clients by turns."""
    found: list[Window] = []
    page = begin_page("0")
    assert page is not None
    with closing(page), _readers() as look:
        page.wait()
        page.say("begin", scene=HEAD)
        watcher = PageObserver(page, list(load_head(HEAD).joints))
        turns = _Turns(watcher)

        @contextmanager
        def sampled(document: Document, *_: object) -> Iterator[None]:
            watcher.document = document
            by_turns = threading.Thread(target=_sample, args=(document, turns, page, look, found), daemon=True)
            by_turns.start()
            yield

        duration_s = SETTLE_S + (2 * PAIRS + 1) * (PAUSE_S + WINDOW_S) + PAUSE_S
        _finished(run(_options(duration_s), sampled, observers=[turns]))
    if len(found) < 2 * PAIRS + 1:
        raise BusError(f"the run ended after {len(found)} of {2 * PAIRS + 1} windows")
    return found


def _sample(
    document: Document, turns: _Turns, page: PageProcess, look: Callable[[str | None], None], found: list[Window]
) -> None:
    """The windows of a run, in a thread of their own."""
    if not turns.settled.wait(_LIMIT_S):
        return
    for number in range(2 * PAIRS + 1):
        turns.on = number % 2 == 1
        look(page.url if turns.on else None)
        time.sleep(PAUSE_S)
        late, began_s, before_s = _late(document), time.monotonic(), _spent_s(turns, page)
        time.sleep(WINDOW_S)
        share = 100 / (time.monotonic() - began_s)
        run_s, telling_s, page_s = (now - before for now, before in zip(_spent_s(turns, page), before_s, strict=True))
        found.append(Window(turns.on, share * run_s, share * telling_s, share * page_s, _late(document) - late))
    look(None)


def _options(duration_s: float) -> RunOptions:
    return RunOptions(head=HEAD, audio=DEFAULT_SPEAKER, duration_s=duration_s)


def _halts() -> list[float]:
    """How long each halt took [ms], of a run with a page that others look at too."""
    options = _options(SETTLE_S + (HALTS + 1) * _BETWEEN_S + 1)
    page = begin_page("0")
    assert page is not None
    clicks_ms: list[float] = []
    with closing(page), page_session(page, options) as pages, _readers() as look:
        look(page.url)
        watch = _Halted()
        clicker = threading.Thread(target=_click, args=(page.url, watch, clicks_ms), daemon=True)
        clicker.start()
        _finished(pages.run(observers=[watch]))
        clicker.join(_LIMIT_S)
    return clicks_ms


def _click(url: str, watch: _Halted, clicks_ms: list[float]) -> None:
    """Halt again and again."""
    if not watch.settled.wait(_LIMIT_S):
        return
    with suppress(WebSocketException), _visitor(url) as visitor:
        reader = threading.Thread(target=_read_all, args=(visitor,), daemon=True)
        reader.start()
        for _ in range(HALTS):
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


def _spent_s(turns: _Turns, page: PageProcess) -> tuple[float, float, float]:
    """Processor time so far: of this process, of what it does for the page, and of the page's process."""
    senders = [each.native_id for each in threading.enumerate() if each.name.startswith(THREAD)]
    sending_s = sum(processor_time_s(os.getpid(), thread) for thread in senders)
    return time.process_time(), turns.spent_s + sending_s, processor_time_s(page.process_id)


def _late(document: Document) -> int:
    """Ticks that came late so far."""
    late: int = document()["tick"]["late"]
    return late


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
        visitors = [] if url is None else [_visitor(url) for _ in range(CLIENTS)]
        for visitor in visitors:
            threading.Thread(target=_read_all, args=(visitor,), daemon=True).start()
