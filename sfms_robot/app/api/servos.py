"""The servos of a head by themselves: joint angles in, readings out, under the same limits as a whole run.

It is a run whose joint angles come from a program instead of a face. The loop has a thread of its own, so servos are
written to and looked after at their rate, whatever the program does meanwhile, and their watchdogs stay content.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.app.api.background import Background, Report, head_name
from sfms_robot.app.head.pose import NobodyThere
from sfms_robot.app.listen.report import run_report
from sfms_robot.app.open_head import HeadOptions, open_head
from sfms_robot.app.session import Programme, drive_head
from sfms_robot.app.wiring import SIM
from sfms_robot.config import Head
from sfms_robot.errors import BusError, InputError, RobotError
from sfms_robot.frames import POSE, Doubles, Floats, Reading
from sfms_robot.ports import Observer
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.safety import Interrupt

log = logging.getLogger(__name__)

ARRIVED_RAD: Final = 1e-3  # of the goal sent; the servo itself is behind by its lag
SLACK_RAD: Final = 1e-9  # so that the end of a range, computed twice, is inside it
_LOOK_S: Final = 0.01


def open_bus(head: Head | str, port: str = SIM, *, yes: bool = False, without: Sequence[str] = ()) -> Servos:
    """The servos of a head, for a `with` block.

    Args:
        head: what `load_head` gave, a shipped name, or a folder.
        port: "sim" for emulated servos, a device, or NAME=DEVICE[,NAME=DEVICE] for a head of several buses.
        yes: hobby servos report no position and jump when they come on; confirms that nobody is in their way.
        without: joints that are left alone.

    Raises ConfigError for a head or port that cannot be right.
    """
    return Servos(HeadOptions(head_name(head), port, False, yes, tuple(without)))


class Servos:
    """Joints by their angle. Entering the `with` block connects; leaving it comes to rest and takes torque off.

    Nothing that is written reaches a servo but through the limits of position, speed, acceleration and jerk of the
    head's file. Methods may be called from any thread. What ended the loop meanwhile (a bus that failed) is raised by
    the next call, as RobotError.

    Attributes:
        joints: names, in the order of every (J,).
        low_rad, high_rad: (J,) range of every joint on this port.
        rest_rad: (J,) where leaving brings them.
    """

    def __init__(self, options: HeadOptions) -> None:
        self._options = options
        self._stack = ExitStack()
        self._run: Background | None = None
        self._target = _Target(np.zeros(0))

    def __enter__(self) -> Self:
        """Connect. Blocks while the servos are identified; torque stays as found. Raises RobotError."""
        self._opened = self._stack.enter_context(open_head(self._options))
        joints = self._opened.config.joints
        self.joints = tuple(joints)
        self.low_rad = np.array([joint.min_rad for joint in joints.values()])
        self.high_rad = np.array([joint.max_rad for joint in joints.values()])
        self.rest_rad = self._opened.motion.rest_rad
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        """`stop`, then the ports are given back. Does not hide an exception that is on its way."""
        with self._stack:
            try:
                self.stop()
            except RobotError as failure:
                if error is None:
                    raise
                log.error("%s", failure)

    def enable(self) -> None:
        """Torque on, each joint held where it stands; one outside its range comes in. Blocks until all are on.

        Raises ServoError, BusError. Again: does nothing while torque is on.
        """
        if self._run is not None and self._run.running:
            return
        readings = self._opened.bus.poll(self._opened.clock.now_s())
        stands = [readings[joint].position_rad if joint in readings else None for joint in self.joints]
        found = [rest if at is None else at for at, rest in zip(stands, self.rest_rad.tolist(), strict=True)]
        self._target = _Target(np.clip(found, self.low_rad, self.high_rad), self.joints)
        self._run = Background(self._drive)
        self._run.start()

    def write(self, angles_rad: ArrayLike) -> None:
        """Where the joints are to go, (J,) rad; the newest counts. Returns at once.

        They are on their way with the next tick, as fast as their limits allow, and stay there. Raises InputError,
        with nothing changed, for a shape, a value that is not finite, or an angle outside its joint's range; BusError
        before `enable`.
        """
        self._running()
        self._target.angles_rad = self._checked(angles_rad)

    def move(self, angles_rad: ArrayLike, limit_s: float = 10.0) -> bool:
        """`write`, then block until the goals sent are there; for `limit_s` at most: whether they are."""
        self.write(angles_rad)
        run, target = self._running(), self._target.angles_rad
        for _ in range(round(limit_s / _LOOK_S)):
            seen = run.progress.seen
            if seen is not None and np.abs(seen.goals_rad - target).max() < ARRIVED_RAD:
                return True
            run.wait(_LOOK_S)
            self._running()
        return False

    def read(self) -> Mapping[str, Reading]:
        """Freshest reading of every joint. Before `enable` it asks the servos and blocks for that; then never."""
        if self._run is None:
            return self._opened.bus.poll(self._opened.clock.now_s())
        seen = self._running().progress.seen
        return {} if seen is None else seen.readings

    def stop(self) -> None:
        """Ease to rest and torque off; blocks until then. Raises once what went wrong meanwhile.

        4 s at most from inside the joints' ranges; one found far outside takes what its limits need, up to a minute.
        """
        if self._run is not None:
            self._run.stop()

    def release(self) -> None:
        """Torque off now, without coming to rest. From any thread; does not wait. Raises nothing."""
        if self._run is not None:
            self._run.release()

    def report(self) -> Report | None:
        """After `stop`: the report, with the keys of `run --json`. None before."""
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
        inside = (angles >= self.low_rad - SLACK_RAD) & (angles <= self.high_rad + SLACK_RAD)
        if not inside.all():
            worst = int(np.argmin(inside))
            low, high = self.low_rad[worst], self.high_rad[worst]
            raise InputError(f"{self.joints[worst]} = {angles[worst]:g} rad is not in {low:.4f}..{high:.4f}")
        return np.clip(angles, self.low_rad, self.high_rad)

    def _drive(self, interrupt: Interrupt, halt: HaltLatch, observer: Observer) -> Report:
        opened, alone = self._opened, NobodyThere()
        programme = Programme(alone, alone, None, retargeter=self._target, halt=halt, observers=[observer])
        drove = drive_head(opened, programme, interrupt, signals=False)
        return run_report(opened, drove, alone, "none", 0)


class _Target:
    """A `ports.Retargeter` that gives the angles (J,) written last, whatever the face."""

    def __init__(self, angles_rad: Doubles, joints: Sequence[str] = ()) -> None:
        self.angles_rad = angles_rad
        self.joints = joints

    def start(self) -> None:
        return None

    def step(self, motion: Floats, state: None, knobs: Any = None) -> tuple[Doubles, None]:
        return self.angles_rad, None

    def shown_pose(self, motion: Floats, knobs: Any = None) -> Doubles:
        """No neck that anybody makes up for: as asked."""
        return motion[..., POSE].astype(np.float64)
