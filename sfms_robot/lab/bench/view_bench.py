"""`bench view` and `bench outputs`: the cost of showing a run elsewhere.

`bench view`: the cost of three visitors of the page, and the delay of a halt from the page.

The default head runs on emulated servos with its page, and three plain WebSocket clients in a separate process read all
that the page sends. The cost is the processor time of the page's process and of the threads of the run that send to it,
for each window. The loop's own part, some microseconds of packing 25 times a second, and the processes of listener,
servos and clients are not counted. The delay of a halt is the time from the click, a message of a fourth client, until
the goals of the first braking tick are written.

`bench outputs`: late ticks of a run with four outputs and of one without, and the processor time of the output threads.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Final

from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from sfms_robot.app.listen.page_session import page_session
from sfms_robot.app.options import RunOptions, begin_page
from sfms_robot.app.session import run
from sfms_robot.endpoint import LOOPBACK
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.lab.bench.measure import HEAD, BenchResult, Say, processor_time_s, row
from sfms_robot.ports import Observer, Tick
from sfms_robot.processes import Child, ParentPipe
from sfms_robot.sources.registry import DEFAULT_SPEAKER
from sfms_robot.viewer.page_process import THREAD

_SETTLE_S: Final = 5.0
_WINDOW_S: Final = 4.0
_WINDOWS: Final = 10
_HALTS: Final = 8
_CLIENTS: Final = 3
_MOST_CPU: Final = 3.0  # % of a core
_MOST_OUTPUTS_CPU: Final = 5.0  # % of a core
_MOST_HALT_MS: Final = 100.0
_BETWEEN_S: Final = 2.3  # time for a halt and the return to the face; not a multiple of a tick
_LIMIT_S: Final = 60.0
_CLOSE_S: Final = 5.0


def measure(say: Say) -> BenchResult:
    """Measure a run with clients; takes a minute and a half. Linux only.

    Raises ConfigError elsewhere, BusError when the run ends early.
    """
    if not Path("/proc/self/stat").is_file():
        raise ConfigError("bench view: processor time of the page's process is read from /proc (Linux)")
    say(f"{_WINDOWS} times {_WINDOW_S:g} s with {_CLIENTS} clients, then {_HALTS} halts")
    duration_s = _SETTLE_S + _WINDOWS * _WINDOW_S + (_HALTS + 1) * _BETWEEN_S + 1
    page = begin_page("0")
    assert page is not None
    shares: list[float] = []
    halts_ms: list[float] = []
    watch = _Watch()

    def visit() -> None:
        if watch.settled.wait(_LIMIT_S):
            shares.extend(
                _share(lambda: processor_time_s(page.process_id) + _threads_s(THREAD)) for _ in range(_WINDOWS)
            )
            halts_ms.extend(_halts_ms(page.url, watch))

    options = RunOptions(head=HEAD, audio=DEFAULT_SPEAKER, duration_s=duration_s)
    with closing(page), page_session(page, options) as pages:
        readers = Child(f"{__name__}:clients", page.url, name="clients")
        visitor = threading.Thread(target=visit, daemon=True)
        visitor.start()
        report = pages.run(observers=[watch])
        visitor.join(_LIMIT_S)
        readers.close(_CLOSE_S)
    if report["exit"] != "done" or len(halts_ms) < _HALTS:
        raise BusError(f"bench view: the run ended early: {report['exit']} {report['error'] or ''}")
    cost = row(shares, [_MOST_CPU], f"% of a core, {_CLIENTS} clients", "the share that is allowed")
    halt = row(halts_ms, [_MOST_HALT_MS], "ms", "the time that is allowed")
    late = report["tick"]["late"]
    lines = [f"{late} of {report['ticks']} ticks late"]
    return BenchResult.of_rows({"view.cpu": cost, "view.halt": halt}, lines, late_ticks=late)


def outputs(say: Say) -> BenchResult:
    """Measure a run without outputs, then with four, one of them read by clients; takes a minute and a half.

    The processor time is that of the outputs' threads. Linux only. Raises ConfigError, BusError.
    """
    shares: list[float] = []
    watch = _Watch()
    with ExitStack() as stack:
        places = []
        for _ in range(4):
            receiver = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
            receiver.bind((LOOPBACK, 0))  # packets that nothing reads are dropped by the system
            places.append(receiver.getsockname()[1])
        kinds = ("json", "vmc", "vmc-single", "live-link")
        chosen = tuple(f"{kind}:{port}" for kind, port in zip(kinds, places, strict=True))

        def read() -> None:
            if watch.settled.wait(_LIMIT_S):
                readers = Child(f"{__name__}:clients", f"http://{LOOPBACK}:{places[0]}/", name="clients")
                shares.extend(_share(lambda: _threads_s("output")) for _ in range(_WINDOWS))
                readers.close(_CLOSE_S)

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        late = []
        for four, observers in (((), []), (chosen, [watch])):
            say(f"{_WINDOWS} times {_WINDOW_S:g} s with {len(four)} outputs")
            options = RunOptions(
                head=HEAD, audio=DEFAULT_SPEAKER, duration_s=_SETTLE_S + (_WINDOWS + 1) * _WINDOW_S, outputs=four
            )
            report = run(options, observers=observers)
            if report["exit"] != "done":
                raise BusError(f"bench outputs: the run ended early: {report['exit']} {report['error'] or ''}")
            late.append(100 * report["tick"]["late"] / report["ticks"])
        reader.join(_LIMIT_S)
    cost = row(shares, [_MOST_OUTPUTS_CPU], "% of a core, 4 outputs", "the share that is allowed")
    lines = [f"{late[1]:.3g} % of ticks late with four outputs, {late[0]:.3g} % without"]
    return BenchResult.of_rows({"outputs.cpu": cost}, lines, late_percent=late[1], late_percent_without=late[0])


class _Watch(Observer):
    """An observer that detects when the run has settled, and the first braking tick of each halt.

    Attributes:
        halted: Set at that tick; `halted_s` is its time on `time.monotonic`.
    """

    def __init__(self) -> None:
        self.settled, self.halted = threading.Event(), threading.Event()
        self.halted_s = 0.0
        self._state = ""

    def tick(self, seen: Tick) -> None:
        if seen.state != self._state and seen.state == "halted":
            self.halted_s = time.monotonic()
            self.halted.set()
        self._state = seen.state
        if seen.time_s >= _SETTLE_S:
            self.settled.set()


def _threads_s(name: str) -> float:
    """Return the processor time of the threads of this process whose names begin with `name`."""
    found = [each.native_id for each in threading.enumerate() if each.name.startswith(name)]
    return sum(processor_time_s(os.getpid(), each) for each in found)


def _share(used_s: Callable[[], float]) -> float:
    """Return the processor time that `used_s` counts over one window, in % of a core. Blocks."""
    began_s, before_s = time.monotonic(), used_s()
    time.sleep(_WINDOW_S)
    return 100 * (used_s() - before_s) / (time.monotonic() - began_s)


def _halts_ms(url: str, watch: _Watch) -> Iterator[float]:
    """Halt and resume the run `_HALTS` times; yield the delay of each halt. Ends early when the run does."""
    with suppress(WebSocketException), _visitor(url) as visitor:
        threading.Thread(target=_read_all, args=(visitor,), daemon=True).start()
        for _ in range(_HALTS):
            watch.halted.clear()
            clicked_s = time.monotonic()
            visitor.send('{"type": "halt"}')
            if not watch.halted.wait(1.0):
                return
            yield (watch.halted_s - clicked_s) * 1e3
            visitor.send('{"type": "resume"}')
            time.sleep(_BETWEEN_S)


# --- clients --------------------------------------------------------------------------------------------------------


def _visitor(url: str) -> ClientConnection:
    return connect(url.replace("http", "ws", 1) + "ws", compression=None)


def _read_all(visitor: ClientConnection) -> None:
    with suppress(WebSocketException):
        while True:
            visitor.recv()


def clients() -> None:
    """Read the page whose address is the first message, in the clients' process, until its pipe ends."""
    parent = ParentPipe()
    url = parent.receive()
    for _ in range(_CLIENTS):
        threading.Thread(target=_read_all, args=(_visitor(url),), daemon=True).start()
    parent.receive()
