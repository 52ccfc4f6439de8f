"""A run in its own thread, and the servos of a head without a listener: joint angles in, readings out.

`Servos` is a run whose joint angles come from a program instead of a face, under the same limits. The loop has its own
thread, so servos are written to and polled at their rate whatever the program does, and their watchdogs do not trip.
"""

from __future__ import annotations

import atexit
import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.app.head.pose import NobodyThere
from sfms_robot.app.listen.report import failure
from sfms_robot.app.open_head import open_head
from sfms_robot.app.options import SIM, HeadOptions
from sfms_robot.app.session import drive_head, run_parts
from sfms_robot.config import Head, load_head
from sfms_robot.data import Report
from sfms_robot.errors import BusError, ConfigError, InputError, RobotError
from sfms_robot.frames import POSE, Doubles, Floats, Readings
from sfms_robot.ports import Observer, Tick
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.safety import Interrupt

log = logging.getLogger(__name__)

ARRIVED_RAD: Final = 1e-3  # distance of the sent goal at which it has arrived; the servo itself lags behind
SLACK_RAD: Final = 1e-9  # margin, so that the end of a range, computed twice, is inside it
_LOOK_S: Final = 0.01


# --- a run in its own thread ----------------------------------------------------------------------------------------


class Background(Observer):
    """A run in its own thread: `work` drives a head until `interrupt` is set, with this as observer, and reports.

    If a program ends without `stop`, the run is stopped at its exit: the head comes to rest first.

    Attributes:
        seen: the newest tick.
        interrupt: ends the run. halt: emergency stop.
    """

    def __init__(self, work: Callable[[Background], Report], interrupt: Interrupt, halt: HaltLatch) -> None:
        self._work = work
        self.interrupt, self.halt = interrupt, halt
        self._thread = threading.Thread(target=self._run, name="robot", daemon=True)
        self._error: Exception | None = None
        self._raised = False
        self._stopping = False
        self._came = threading.Event()  # the first tick, or the end of the run
        self.seen: Tick | None = None
        self.report: Report | None = None

    @property
    def state(self) -> str:
        """State of the run, see docs/safety.md."""
        if self._error is not None:
            return "fault"
        if self.report is not None:
            return "stopped"
        if self._stopping:
            return "stopping"
        return "starting" if self.seen is None else self.seen.state

    @property
    def running(self) -> bool:
        """True from the first tick until the end, or until it is stopped."""
        ended = self._error is not None or self.report is not None or self._stopping
        return self._came.is_set() and not ended

    def tick(self, seen: Tick) -> None:
        self.seen = seen
        self._came.set()

    def start(self) -> None:
        """Start; block until the first tick, with all torque on. Raises an error that prevents it, as RobotError."""
        atexit.register(self.stop)
        self._thread.start()
        try:
            self._came.wait()
        except BaseException:  # on Ctrl-C the caller has no object to stop
            self.stop()
            raise
        if not self._thread.is_alive() or self.report is not None or self._error is not None:
            self._end()

    def wait(self, limit_s: float | None = None) -> bool:
        """Block until the run has ended, or for `limit_s`; return whether it has ended."""
        self._thread.join(limit_s)
        return not self._thread.is_alive()

    def stop(self) -> None:
        """Come to rest, switch torque off. Block until then; raise an error of the run once, as RobotError.

        A Ctrl-C meanwhile switches torque off at once.
        """
        if self._thread.is_alive() and not self._stopping:
            self._stopping = True
            self.interrupt.ask()
        self._end()

    def release(self) -> None:
        """Switch torque off now, without coming to rest first. From any thread; does not wait or raise."""
        self._stopping = True
        self.interrupt.ask()
        self.interrupt.ask()

    def check(self) -> None:
        """Raise the error that ended the run, if there is one; once."""
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
            self.report = self._work(self)
            self._error = failure(self.report)
        except RobotError as error:
            self._error = error
        except Exception as error:
            log.exception("internal error: the run ends")
            self._error = RobotError(f"{type(error).__name__}: {error}")
            self._error.__cause__ = error
        finally:
            self._came.set()


class Driven:
    """An object whose `Background` run drives a head; leaving its `with` block stops it.

    An error of the run does not replace an exception that is being raised.
    """

    _run: Background | None = None

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            self.stop()
        except RobotError as failure:
            if error is None:
                raise
            log.error("%s", failure)

    def stop(self) -> None:
        """Ease to rest, switch torque off. Block until then; raise an error of the run once, as RobotError.

        It takes 4 s at most from inside the joints' ranges. A joint that was found far outside takes as long as its
        limits require, up to a minute.
        """
        if self._run is not None:
            self._run.stop()

    def release(self) -> None:
        """Switch torque off now, without coming to rest, in an emergency. From any thread; does not wait or raise."""
        if self._run is not None:
            self._run.release()


def head_name(head: Head | str) -> str:
    """Return the name or folder of a head that a program loaded, as a run opens it.

    Calibration and stored settings of a build belong to the head's file, so a run loads the head from there. Raises
    ConfigError for a head that was changed since it was loaded, or was made without a file.
    """
    if isinstance(head, str):
        return head
    if head.folder is None or load_head(str(head.folder)) != head:
        raise ConfigError(
            f"head {head.name!r} is not what its file says: write it to a folder as head.yaml and name that folder"
        )
    return str(head.folder)


# --- servos without a listener --------------------------------------------------------------------------------------


def open_bus(head: Head | str, port: str = SIM, *, yes: bool = False, without: Sequence[str] = ()) -> Servos:
    """Return the servos of a head, for a `with` block.

    Args:
        head: the result of `load_head`, a shipped name, or a folder.
        port: "sim" for emulated servos, a device, or NAME=DEVICE[,NAME=DEVICE] for a head of several buses.
        yes: hobby servos report no position and jump when they come on; confirms that nothing is in their way.
        without: joints that are left alone.

    Raises ConfigError for an invalid head or port.
    """
    return Servos(HeadOptions(head=head_name(head), port=port, yes=yes, without=tuple(without)))


class Servos(Driven):
    """Joints by their angle. Entering the `with` block connects; leaving it moves to rest and switches torque off.

    Every angle passes the limits of position, speed, acceleration and jerk of the head's file. Methods may be called
    from any thread. An error that ended the loop (a bus that failed) is raised by the next call, as RobotError.

    Attributes:
        joints: names, in the order of every array (J,).
        low_rad, high_rad: (J,) range of every joint on this port.
        rest_rad: (J,) angles to which the joints move at the end.
    """

    def __init__(self, options: HeadOptions) -> None:
        self._options = options
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Connect. Blocks while the servos are identified; torque stays as found. Raises RobotError."""
        self._opened = self._stack.enter_context(open_head(self._options))
        head = self._opened.config
        self.joints, self._range = tuple(head.joints), head.range
        self.low_rad, self.high_rad, self.rest_rad = self._range.low, self._range.high, head.rest_rad
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        """Stop, and close the ports."""
        with self._stack:
            super().__exit__(kind, error, trace)

    def enable(self) -> None:
        """Switch torque on, each joint held where it stands; one outside its range moves in. Blocks until all are on.

        Raises ServoError, BusError. Does nothing while torque is on.
        """
        if self._run is not None and self._run.running:
            return
        readings = self._opened.bus.poll(self._opened.clock.now_s())
        stands = [readings[joint].position_rad if joint in readings else None for joint in self.joints]
        found = [rest if at is None else at for at, rest in zip(stands, self.rest_rad.tolist(), strict=True)]
        self._target = _Target(self._range.nearest(np.array(found)), self.joints)
        self._run = Background(self._drive, Interrupt(), HaltLatch())
        self._run.start()

    def write(self, angles_rad: ArrayLike) -> None:
        """Set the goals of the joints, (J,) rad; the newest replace all others. Returns at once.

        The joints move from the next tick on, as fast as their limits allow, and stay there. Raises InputError,
        with nothing changed, for a wrong shape, a value that is not finite, or an angle outside its joint's range;
        BusError before `enable`.
        """
        self._running()
        self._target.angles_rad = self._checked(angles_rad)

    def move(self, angles_rad: ArrayLike, limit_s: float = 10.0) -> bool:
        """Write goals, block until the sent goals have arrived there or for `limit_s`, and return whether they have."""
        self.write(angles_rad)
        run, target = self._running(), self._target.angles_rad
        for _ in range(round(limit_s / _LOOK_S)):
            seen = run.seen
            if seen is not None and np.abs(seen.goals_rad - target).max() < ARRIVED_RAD:
                return True
            run.wait(_LOOK_S)
            self._running()
        return False

    def read(self) -> Readings:
        """Return the newest reading of every joint. Before `enable` it polls the servos and blocks for that."""
        if self._run is None:
            return self._opened.bus.poll(self._opened.clock.now_s())
        seen = self._running().seen
        return {} if seen is None else seen.readings

    def report(self) -> Report | None:
        """Return the report after `stop`, with the keys of `run --json`; None before."""
        return None if self._run is None else self._run.report

    def _running(self) -> Background:
        if self._run is None:
            raise BusError("torque is off: enable() first")
        self._run.check()
        if not self._run.running:
            raise BusError("torque is off: the run has ended")
        return self._run

    def _checked(self, angles_rad: ArrayLike) -> Doubles:
        angles = np.array(angles_rad, np.float64)
        if angles.shape != (len(self.joints),):
            raise InputError(f"angles have shape {angles.shape}; this head has ({len(self.joints)},) joints")
        inside = self._range.holds(angles, SLACK_RAD)
        if not inside.all():
            worst = int(np.argmin(inside))
            inside_rad = f"{self.low_rad[worst]:.4f}..{self.high_rad[worst]:.4f}"
            raise InputError(f"{self.joints[worst]} = {angles[worst]:g} rad is not in {inside_rad}")
        return self._range.nearest(angles)

    def _drive(self, now: Background) -> Report:
        opened, alone = self._opened, NobodyThere()
        parts = run_parts(opened, alone, alone, retargeter=self._target, halt=now.halt, observers=[now])
        return drive_head(opened, parts, now.interrupt)


@dataclass
class _Target:
    """A `Retargeter` that returns the angles (J,) written last, for every face."""

    angles_rad: Doubles
    joints: Sequence[str]

    def start(self) -> None:
        return None

    def step(self, motion: Floats, state: None, knobs: Any = None) -> tuple[Doubles, None]:
        return self.angles_rad, None

    def shown_pose(self, motion: Floats, knobs: Any = None) -> Doubles:
        """Return the pose unchanged: no neck is solved."""
        return motion[..., POSE].astype(np.float64)
