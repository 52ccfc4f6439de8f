"""A run in a thread of its own: begin it, ask it to end, wait for it, and learn what went wrong."""

from __future__ import annotations

import atexit
import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any, Final

from sfms_robot.config import Head, load_head
from sfms_robot.errors import BusError, ConfigError, ModelError, PortError, RobotError
from sfms_robot.frames import SpeakerFrame
from sfms_robot.ports import Observer, Tick
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.safety import Interrupt

log = logging.getLogger(__name__)
_KINDS: Final = {kind.exit_code: kind for kind in (PortError, BusError, ModelError)}

Report = Mapping[str, Any]


class FirstTick(Observer):
    """An observer that knows the newest tick, and tells when there is one."""

    def __init__(self) -> None:
        self.came = threading.Event()
        self.seen: Tick | None = None
        self.ticks = 0
        self.frames = 0

    def tick(self, seen: Tick) -> None:
        self.seen = seen
        self.ticks += 1
        self.came.set()

    def heard(self, frame: SpeakerFrame) -> None:
        self.frames += 1


class Background:
    """`work` in a thread: it runs a head until the interrupt is asked, tells the observer, and returns its report.

    A program that ends without `stop` is stopped at its exit: the head comes to rest first.

    Attributes:
        progress: the newest tick.
        halt: emergency stop.
    """

    def __init__(self, work: Callable[[Interrupt, HaltLatch, Observer], Report]) -> None:
        self._work = work
        self._interrupt = Interrupt()
        self.halt = HaltLatch()
        self._thread = threading.Thread(target=self._run, name="robot", daemon=True)
        self._error: Exception | None = None
        self._raised = False
        self._stopping = False
        self.progress = FirstTick()
        self.report: Report | None = None

    @property
    def state(self) -> str:
        """Of the run, see docs/safety.md."""
        if self._error is not None:
            return "fault"
        if self.report is not None:
            return "stopped"
        if self._stopping:
            return "stopping"
        seen = self.progress.seen
        return "starting" if seen is None else seen.state

    @property
    def running(self) -> bool:
        """Torque is on, and nobody has asked it to stop."""
        ended = self._error is not None or self.report is not None or self._stopping
        return self.progress.came.is_set() and not ended

    def start(self) -> None:
        """Returns with the first tick, all torque on. Raises what kept it from that, as RobotError."""
        atexit.register(self.stop)
        self._thread.start()
        try:
            self.progress.came.wait()
        except BaseException:  # Ctrl-C: nobody will hold this object to stop it
            self.stop()
            raise
        if not self._thread.is_alive() or self.report is not None or self._error is not None:
            self._end()

    def wait(self, limit_s: float | None = None) -> bool:
        """Until the run has ended by itself, or for `limit_s`: whether it has."""
        self._thread.join(limit_s)
        return not self._thread.is_alive()

    def stop(self) -> None:
        """Come to rest, torque off. Blocks until then; raises once what went wrong meanwhile, as RobotError.

        A Ctrl-C while it blocks releases at once.
        """
        if self._thread.is_alive() and not self._stopping:
            self._stopping = True
            self._interrupt.ask()
        self._end()

    def release(self) -> None:
        """Torque off now, without coming to rest first. From any thread; does not wait. Raises nothing."""
        self._stopping = True
        self._interrupt.ask()
        self._interrupt.ask()

    def check(self) -> None:
        """Raise what has ended the run, if something has; once."""
        if self._error is not None and not self._raised:
            self._raised = True
            raise self._error

    def _end(self) -> None:
        try:
            self._thread.join()
        except KeyboardInterrupt:
            self.release()
            raise
        atexit.unregister(self.stop)
        self.check()

    def _run(self) -> None:
        try:
            self.report = self._work(self._interrupt, self.halt, self.progress)
            if self.report["exit"] == "failed":
                kind = _KINDS.get(self.report.get("exit_code", 1), RobotError)
                self._error = kind(self.report["error"])
        except RobotError as error:
            self._error = error
        except Exception as error:
            log.exception("the run ends by an error that nobody expected")
            self._error = RobotError(f"{type(error).__name__}: {error}")
            self._error.__cause__ = error
        finally:
            self.progress.came.set()


def head_name(head: Head | str) -> str:
    """Return the name or folder of a head that a program loaded, as a run opens it.

    What belongs to one build (its calibration, what is stored in its servos) lies beside the head's file, so a head
    runs from there. Raises ConfigError for one that was changed since it was loaded, or was made without a file.
    """
    if isinstance(head, str):
        return head
    if head.folder is None or load_head(str(head.folder)) != head:
        raise ConfigError(
            f"head {head.name!r} is not what its file says: write it to a folder as head.yaml and name that folder"
        )
    return str(head.folder)
