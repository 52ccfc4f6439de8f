"""A panel of a run on the terminal: its status four times a second, and keys that halt, resume and end the run.

None of this runs in the loop's thread: one thread draws, one reads keys, and log lines wait for the thread that draws.
Nothing is shown if stderr is not a terminal, or while another program has the terminal.
"""

from __future__ import annotations

import logging
import logging.handlers
import os
import queue
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from datetime import timedelta
from typing import Any, Final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sfms_robot.app.listen.knobs import STEP, RunControls
from sfms_robot.ports import Facts
from sfms_robot.runtime.halt import resume_here

try:
    import termios
    import tty
except ImportError:  # Windows
    termios = None  # type: ignore[assignment]

PERIOD_S: Final = 0.25
JOIN_S: Final = 1.0  # longest wait for a thread; a stopped terminal (Ctrl-S) blocks it, and the run ends without it
_QUIET_DB: Final = -60.0  # level of an empty meter; 0 is full scale
_METER: Final = 20  # width in characters, fewer on a narrow terminal
_BEGINS: Final = {"frame_to_wire": "picture and sound", "speech_to_wire": "speech begins"}
_FAULTS: Final = 4  # most faults that are named; the others are counted
_COLORS: Final[Mapping[str, str]] = {
    "starting": "cyan",
    "idle": "blue",
    "listening": "green",
    "speaking": "magenta",
    "degraded": "yellow",
    "halted": "bold white on red",
    "stopping": "cyan",
    "stopped": "dim",
    "fault": "bold red",
}
_KEYS: Final = "space halt, r resume, + - intensity, q end, ? help"
_HELP: Final = (
    "space, h, Esc: emergency stop; r: resume after one; + and -: intensity of all regions, a tenth; "
    "q: come to rest and end; Ctrl-C twice: torque off at once"
)
_NO_KEYS: Final = "no keys here: Ctrl-C ends the run"
_ESCAPE: Final = "\x1b"
_LOOK_S: Final = 0.2  # period of the check whether this program has come to the foreground
_LOCAL: Final = 3  # place in the list of `tcgetattr`


@contextmanager
def live_panel(run: RunControls) -> Iterator[None]:
    """Show the panel while inside, and restore the terminal afterwards. Main thread only."""
    console = Console(stderr=True)
    if not console.is_terminal or console.is_dumb_terminal:
        yield
        return
    single = termios is not None and sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()
    found = Keyboard(sys.stdin.fileno()) if single else None
    with ExitStack() as stack:
        screen = stack.enter_context(_drawing(console, run, found is not None))
        stack.enter_context(_suspending(screen, found))  # from before the terminal is taken until it is restored
        if found is not None:
            stack.enter_context(reading_keys(found, lambda key: _pressed(key, screen, run)))
        yield


def _pressed(key: str, screen: _Screen, run: RunControls) -> None:
    if key in (" ", "h", _ESCAPE):
        run.halt.close("key")
    elif key == "r":
        resume_here(run.halt)
    elif key == "q" and not run.interrupt():  # a key that is held down interrupts once, and does not release torque
        run.interrupt.ask()
    elif key in "+=-":  # "=" is the key of "+" without shift
        run.knobs.turn_all(-STEP if key == "-" else STEP)
    elif key == "?":
        screen.help = not screen.help
    screen.look.set()


class _Screen:
    """The panel and the log lines above it. `draw` is called in one thread, `erase` in any.

    Attributes:
        help: True shows the meaning of every key.
        look: set to draw at once.
    """

    def __init__(self, console: Console, run: RunControls, keys: bool) -> None:
        self.help = False
        self.look = threading.Event()
        self.lines = queue.SimpleQueue[logging.LogRecord]()
        self._console, self._run, self._keys = console, run, keys
        self._live = Live(
            console=console,
            auto_refresh=False,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
            vertical_overflow="crop",
        )
        self.lock = threading.RLock()  # a signal handler may interrupt the thread that holds it

    def draw(self) -> None:
        """Print the new log lines, and below them the status of the run."""
        with self.lock:
            for line in self.logged():
                self._console.print(line, markup=False, highlight=False, soft_wrap=True)
            if not in_background(self._console.file.fileno()):
                keys = _NO_KEYS if not self._keys else _HELP if self.help else _KEYS
                self._live.update(view(self._run.document(), self._console, keys, self._run.interrupt()))
                self._live.start()
                self._live.refresh()

    def erase(self) -> None:
        """Remove the panel, and show the cursor again."""
        with self.lock:
            self._live.update("")
            self._live.stop()

    def logged(self) -> Iterator[str]:
        """Yield the log lines that have not been printed yet."""
        with suppress(queue.Empty):
            while True:
                yield self.lines.get_nowait().getMessage()


@contextmanager
def _drawing(console: Console, run: RunControls, keys: bool) -> Iterator[_Screen]:
    """Draw in a thread while inside. The thread also erases, since a second Ctrl-C interrupts the main thread."""
    screen, over = _Screen(console, run, keys), threading.Event()

    def work() -> None:
        try:
            while not over.is_set():
                screen.draw()
                screen.look.wait(PERIOD_S)
                screen.look.clear()
        finally:
            screen.erase()

    thread = threading.Thread(target=work, name="panel", daemon=True)
    with _logging_to(screen):
        try:
            thread.start()
            yield screen
        finally:
            over.set()
            screen.look.set()
            if thread.ident is not None:
                thread.join(JOIN_S)


@contextmanager
def _logging_to(screen: _Screen) -> Iterator[None]:
    """Queue log lines for stderr while inside, for the thread that draws: a line inside the panel would break it."""
    root = logging.getLogger()
    usual = [each for each in root.handlers if isinstance(each, logging.StreamHandler) and each.stream is sys.stderr]
    queued = []
    for before in usual:
        after = logging.handlers.QueueHandler(screen.lines)
        after.setLevel(before.level)
        after.setFormatter(before.formatter)
        queued.append(after)
        root.removeHandler(before)
        root.addHandler(after)
    try:
        yield
    finally:
        for before, after in zip(usual, queued, strict=True):
            root.removeHandler(after)
            root.addHandler(before)
        for line in screen.logged():
            sys.stderr.write(line + "\n")


@contextmanager
def _suspending(screen: _Screen, found: Keyboard | None) -> Iterator[None]:
    """Restore the terminal at Ctrl-Z; the threads that draw and read take it again in the foreground."""
    if not hasattr(signal, "SIGTSTP"):
        yield
        return

    def suspend(*_: object) -> None:
        with screen.lock, found.lent() if found is not None else nullcontext():
            screen.erase()
            os.kill(os.getpid(), signal.SIGSTOP)

    before = signal.signal(signal.SIGTSTP, suspend)
    try:
        yield
    finally:
        signal.signal(signal.SIGTSTP, before)


# --- the lines of the panel -----------------------------------------------------------------------------------------


def view(document: Facts, console: Console, keys: str, ending: bool = False) -> RenderableType:
    """Return a status document as lines no wider than the terminal. `ending`: the run was interrupted."""
    rows = Table.grid(padding=(0, 1))
    rows.add_column(style="dim", no_wrap=True)
    rows.add_column()
    meter = max(4, min(_METER, console.width - 22))
    person, tick = document.get("person") or {}, document.get("tick") or {}
    attention, hottest = person.get("attention"), document.get("hottest")
    seen = "  seen" if person.get("seen") else ""
    rates = "" if not tick else "in virtual time"
    if tick.get("achieved_hz") is not None:
        rates = f"{tick['achieved_hz']:.1f} of {tick['target_hz']:g} a second, {tick['late']} late"
    for name, text in (
        ("", document.get("note")),
        (
            "person",
            _level(person.get("voice_db"), meter, console)
            + (seen if attention is None else f"  attention {attention:.0%}"),
        ),
        ("robot", _level(person.get("own_voice_db"), meter, console)),
        (
            "face",
            ", ".join(
                f"{count} {name.removesuffix('s') if count == 1 else name}"
                for name, count in (document.get("motion") or {}).items()
            ),
        ),
        ("intensity", _intensity(document.get("intensity") or {})),
        ("goals", rates),
        ("answers", _latency(document.get("latency_ms") or {})),
        ("hottest", hottest and f"{hottest['joint']} {hottest['temperature_C']:.0f} C"),
        ("outputs", ", ".join(map(_output, document.get("outputs") or ()))),
        ("faults", _faults(document.get("faults") or {})),
    ):
        if text:
            rows.add_row(name, Text(text, style="red" if name == "faults" else ""))
    return Group(_title(document, ending), rows, Text(keys, style="dim"))


def _title(document: Facts, ending: bool) -> Text:
    state = "stopping" if ending else str(document["state"])
    why = ", ".join(document.get("why") or ())
    time_s, duration_s = document.get("time_s") or 0.0, document.get("duration_s")
    clock = " of ".join(str(timedelta(seconds=int(each))) for each in (time_s, duration_s) if each is not None)
    names = "  ".join(str(document[key]) for key in ("head", "listener") if key in document)
    return Text.assemble(
        (f" {state} ", _COLORS.get(state, "")), f" {why} " if why else "", f" {clock}  ", (names, "dim")
    )


def _level(level_db: float | None, width: int, console: Console) -> str:
    bar = level_bar(_QUIET_DB if level_db is None else level_db, width, "#." if console.options.ascii_only else "█░")
    return bar + ("  no sound" if level_db is None else f" {level_db:5.0f} dB")


def level_bar(level_db: float, width: int, glyphs: str) -> str:
    """Return a meter from -60 dB to full scale; `glyphs`: the characters of its full and its empty part."""
    filled = round(width * min(1.0, max(0.0, 1.0 - level_db / _QUIET_DB)))
    return glyphs[0] * filled + glyphs[1] * (width - filled)


def _intensity(regions: Mapping[str, float]) -> str:
    """Return the regions whose intensity is not 1; one number if all are equal."""
    if len(regions) > 1 and len(set(regions.values())) == 1 and 1.0 not in regions.values():
        return f"{next(iter(regions.values())):g}"
    return ", ".join(f"{region} {value:g}" for region, value in regions.items() if value != 1.0)


def _output(sent: Facts) -> str:
    rate = f"{sent['frames_per_s']:.0f} a second" if sent["state"] == "sending" else sent["state"]
    return f"{sent['kind']}:{sent['peer']} {rate}"


def _latency(latency_ms: Mapping[str, Mapping[str, float | None]]) -> str:
    """Return the medians in words."""
    parts = []
    for name, ms in latency_ms.items():
        middle = next((value for value in ms.values() if value is not None), None)
        if middle is not None:
            parts.append(f"{middle:.0f} ms after {_BEGINS.get(name, name.replace('_', ' '))}")
    return ", ".join(parts)


def _faults(faults: Mapping[str, str]) -> str:
    named = [f"{joint} {fault}" for joint, fault in list(faults.items())[:_FAULTS]]
    more = len(faults) - len(named)
    return "; ".join([*named, f"and {more} more"] if more else named)


# --- single keys during a run ---------------------------------------------------------------------------------------


class Keyboard:
    """The terminal of a file descriptor: `take` it for single keys, `give_back` for lines. Usable from any thread.

    No Enter is needed, nothing is echoed, and the terminal is restored afterwards. It is in cbreak mode while this
    program is in its foreground, so Ctrl-C, Ctrl-\\ and Ctrl-Z stay signals. In the background the terminal belongs to
    other programs: it is not changed, and nothing is read. After `leave` it cannot be taken again.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._usual: list[Any] | None = None
        self._left = False
        self._lock = threading.RLock()  # a signal handler may interrupt the thread that holds it

    def take(self) -> bool:
        """Switch to single keys; return False in the background. Called repeatedly: a shell may change it."""
        with self._lock:
            if self._left or in_background(self._fd):
                return False
            found = termios.tcgetattr(self._fd)
            if found[_LOCAL] & termios.ICANON:
                self._usual = found
                tty.setcbreak(self._fd, termios.TCSANOW)
            return True

    def give_back(self) -> None:
        """Restore the mode that was found. Idempotent."""
        with self._lock:
            if self._usual is not None and not in_background(self._fd):
                termios.tcsetattr(self._fd, termios.TCSANOW, self._usual)
            self._usual = None

    def leave(self) -> None:
        with self._lock:
            self._left = True
            self.give_back()

    @contextmanager
    def lent(self) -> Iterator[None]:
        """Give the terminal back while inside; no thread can take it meanwhile."""
        with self._lock:
            self.give_back()
            yield

    def wait(self, over: int) -> str | None:
        """Block until keys are pressed or `_LOOK_S` is over; return the keys, or "". None once `over` is readable.

        A sequence of several bytes (an arrow, Alt with a key) counts as a single Esc, with which it begins.
        """
        ready, _, _ = select.select([over, self._fd] if self.take() else [over], [], [], _LOOK_S)
        if over in ready:
            return None
        if self._fd not in ready:
            return ""
        read = os.read(self._fd, 64).decode("ascii", "replace")
        return None if not read else _ESCAPE if _ESCAPE in read else read


def in_background(fd: int) -> bool:
    """Return whether the terminal `fd` belongs to another program now. False if no shell controls it."""
    try:
        return hasattr(os, "tcgetpgrp") and os.tcgetpgrp(fd) != os.getpgrp()
    except OSError:
        return False


@contextmanager
def reading_keys(found: Keyboard, pressed: Callable[[str], object]) -> Iterator[None]:
    """Call `pressed(key)` in a separate thread, for every key while inside."""
    ours, theirs = os.pipe()  # readable at the end

    def work() -> None:
        try:
            while (keys := found.wait(ours)) is not None:
                for key in keys:
                    pressed(key)
        except (OSError, termios.error):  # the terminal was closed
            return

    thread = threading.Thread(target=work, name="keys", daemon=True)
    try:  # begins here, since a signal may end the program before the first key
        thread.start()
        yield
    finally:
        os.close(theirs)
        if thread.ident is not None:
            thread.join(JOIN_S)
        found.leave()
        os.close(ours)
