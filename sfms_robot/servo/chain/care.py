"""What becomes of a servo in trouble, while the bus runs.

    fault, pinch, strain   its policy: hold, limp, reduce, or reboot and ease in
    silent, restarted      goals are withheld; once it answers it is prepared and switched on as at start-up
    back                   it holds where it stands, and takes goals again when they begin there

So no goal ever reaches a servo that was away, other than one that continues from where it stands. Everything is said
once. A servo that gets into trouble of its own again and again is left alone; a bad wire is not its fault.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Faults
from sfms_robot.errors import BusError
from sfms_robot.servo.chain.link import RegisterLink
from sfms_robot.servo.chain.recovery import AGAIN_S, ATTEMPTS, Recovery
from sfms_robot.servo.chain.startup import Startup
from sfms_robot.servo.policy import BusServo, LoadWatch, Measured, Voice, torque_register
from sfms_robot.servo.registers import Table

log = logging.getLogger(__name__)

TORQUE_LOST: Final = "torque lost"  # it restarted, or something switched it off
REBOOT: Final = "reboot"
PATIENCE_S: Final = 0.2  # with a servo that falls silent on its way back
REST_S: Final = 3.0  # a joint that was pinched stays limp so long
_LIMP: Final = ("limp", REBOOT, TORQUE_LOST)  # reasons to be away that take the torque with them
_TRIES: Final = 2
FORGET_S: Final = 60.0  # attempts older than this do not count any more
NEAR: Final = 1 / 500  # of a turn: a goal this close to where a joint stands continues from there


class Told(Protocol):
    """What the servos of a bus last said, as far as it matters here; arrays (J,) in bus order.

    Attributes:
        ticks: positions.
        seen_s: when they came.
        current_mA: NaN where it is not known.
    """

    ticks: NDArray[np.int64]
    seen_s: NDArray[np.float64]
    current_mA: NDArray[np.float64]

    def measured(self, index: int) -> Measured: ...


class Care:
    """Troubles of the servos of one bus, by index in bus order.

    Attributes:
        fault: what is wrong, None where nothing is.
        away: whose goals are withheld, and why.
        rejoining: who holds a position (ticks) and waits for goals that begin there.
        rejoined: who came to hold a position in this tick.
    """

    def __init__(self, servos: Sequence[BusServo], tables: Sequence[Table], faults: Faults, telemetry: Told) -> None:
        self._servos = servos
        self._tables = tables
        self._voice = Voice(servos, faults)
        self._telemetry = telemetry
        self._loads = LoadWatch(servos)
        self._recovery = Recovery()
        self._shake: Startup[Any] | None = None
        self._link: RegisterLink | None = None
        self._bits = [0] * len(servos)
        self._faulty: list[list[str]] = [[] for _ in servos]  # faults that count
        self._attempts_s: list[list[float]] = [[] for _ in servos]
        self.wanted: set[int] = set()
        self.fault: list[str | None] = [None] * len(servos)
        self.away: dict[int, str] = {}
        self.rejoining: dict[int, int] = {}
        self.rejoined: set[int] = set()

    @property
    def said(self) -> Mapping[str, None]:
        """Every fault so far, `joint: fault`, in the order of appearance."""
        return self._voice.said

    def attach(self, link: RegisterLink, shake: Startup[Any]) -> None:
        """The wire in use from now on."""
        self._link, self._shake = link, shake

    def switched_on(self, index: int) -> None:
        """Torque came on by `enable`: a clean slate."""
        self.wanted.add(index)
        self.away.pop(index, None)
        self.rejoining.pop(index, None)
        self._recovery.drop(index)
        if self.fault[index] == TORQUE_LOST:
            self.fault[index] = None

    def switched_off(self) -> None:
        """No goals to anybody any more."""
        for index in self.wanted:
            self._recovery.drop(index)
        self.wanted.clear()
        self.away.clear()
        self.rejoining.clear()

    # --- what is noticed ----------------------------------------------------------------------------------------

    def take_bits(self, index: int, bits: int, now_s: float) -> None:
        """Fault bits as told by the servo; acted upon when a fault is new, or begins to count."""
        if not bits and not self._bits[index]:
            return
        self._bits[index] = bits
        names = [
            name
            for name in self._names(index, bits)
            if self._voice.counts(index, name, self._telemetry.measured(index))
        ]
        new, self._faulty[index] = set(names) - set(self._faulty[index]), names
        if names or not self._stays(index):  # who stays out says why, also when the cause has passed
            self.fault[index] = ", ".join(names) or None
        if new:
            self._voice.say(index, ", ".join(names))
            if index in self.wanted and index not in self._recovery:
                self._act(index, self._servos[index].safety.on_fault, now_s)

    def take_currents(self, indices: Sequence[int], now_s: float) -> None:
        """Judge the present currents of servos that have just told them."""
        currents = self._telemetry.current_mA
        for index in indices:
            current = abs(float(currents[index]))
            if current <= self._loads.lowest_mA[index] and not self._loads.pending(index):
                continue
            broken = self._loads.step(index, current, now_s)
            if broken is not None and index in self.wanted and index not in self.away:
                name, rule = broken
                self._voice.say(index, f"{name} ({current:.0f} mA)")
                self._act(index, rule.then, now_s)
                if rule.then == "limp":
                    self._again(index, now_s + REST_S, now_s)

    def torque_lost(self, index: int, now_s: float) -> None:
        """Its torque is off and we think it is on."""
        if index not in self.wanted or self.away.get(index) in _LIMP:
            return
        if self._faulty[index]:
            self.away[index] = "limp"  # its own protection took the torque, and said why
            return
        self._voice.say(index, TORQUE_LOST)
        if index not in self.away:
            self.fault[index] = self.fault[index] or TORQUE_LOST
            self.away[index] = TORQUE_LOST
            self._again(index, now_s, now_s)

    def gone(self, index: int, why: str) -> None:
        """It does not answer, and not because of one lost packet."""
        if index in self.wanted and self.away.get(index) != REBOOT:
            if index in self._recovery:
                self._recovery.drop(index)
                self.away[index] = why  # it was to come back, and still is
            self.rejoining.pop(index, None)
            self.away.setdefault(index, why)

    def answers(self, index: int, now_s: float) -> None:
        """A servo that was gone answers again."""
        if index in self.away and index not in self._recovery and not self._stays(index):
            self._again(index, now_s, now_s, counted=False)

    def distrust(self, index: int, why: str, now_s: float) -> None:
        """Something may have gone on behind our back: bring it back as if it had been away."""
        if index in self.wanted and index not in self.away:
            self.away[index] = why
            self._again(index, now_s, now_s, counted=False)

    def step(self, now_s: float) -> int:
        """Go on with those who come back; the number that did."""
        out = self._recovery.step(now_s)
        for index in out.silent:
            if self._shake is not None:
                self._recovery.begin(index, self._shake, now_s + PATIENCE_S)
        for index, reason in out.refused.items():
            log.warning("%s", reason)
            self._again(index, now_s + AGAIN_S, now_s)
        for index, ticks in out.back.items():
            self.away.pop(index, None)
            self._bits[index], self._faulty[index], self.fault[index] = 0, [], None
            self.rejoining[index] = ticks
            self.rejoined.add(index)
            self._telemetry.ticks[index], self._telemetry.seen_s[index] = ticks, now_s
            log.warning("%s is back and holds where it stands", self._voice.about(index))
        return len(out.back)

    def near(self, index: int, goal_ticks: int) -> bool:
        """Whether a goal continues from where a rejoining joint stands."""
        return abs(goal_ticks - self.rejoining[index]) <= NEAR * self._tables[index].ticks_per_revolution

    # --- what is done -------------------------------------------------------------------------------------------

    def _act(self, index: int, policy: str, now_s: float) -> None:
        if policy == "limp":
            self.away[index] = "limp"
            self._switch_off(index)
        elif policy == "hold":
            self.away[index] = "hold"
        elif policy == "reduce":
            table = self._tables[index]
            current = self._servos[index].safety.current_limit_mA is not None and "goal_current" in table.fields
            strength = "goal_current" if current else torque_register(self._servos[index].map)
            self._write(index, strength or "", lambda raw: raw // 2)
        elif self._shake is not None and self._shake.can_reboot:
            self.away[index] = REBOOT
            self._again(index, now_s, now_s, reboot=True)
        else:
            self.away[index] = "limp"
            self._switch_off(index)
            self._again(index, now_s + REST_S, now_s)

    def _switch_off(self, index: int) -> None:
        torque = self._tables[index].role("torque_enable")
        self._write(index, torque.name if torque is not None else "", lambda raw: 0)

    def _write(self, index: int, name: str, change: Callable[[int], int]) -> None:
        """One register, changed; once more where nobody says that it was taken."""
        field = self._tables[index].fields.get(name)
        if field is None or self._link is None:
            return
        servo = self._servos[index].id
        for _ in range(_TRIES):
            now = self._link.read(servo, field.address, field.size)
            if now is None or len(now.data) != field.size:
                continue
            if self._link.write(servo, field.address, field.to_bytes(change(field.from_bytes(now.data)))) is not None:
                return

    def _again(self, index: int, due_s: float, now_s: float, reboot: bool = False, counted: bool = True) -> None:
        """Bring it back; `counted` where the servo itself is to blame, not the wire or the host."""
        if self._shake is None:
            raise BusError("no wire is attached")
        if not counted:
            self._recovery.begin(index, self._shake, due_s)
            return
        recent = self._attempts_s[index] = [t for t in self._attempts_s[index] if now_s - t < FORGET_S]
        if len(recent) >= ATTEMPTS:
            log.warning(
                "%s came back %d times in %g s and is left alone", self._voice.about(index), len(recent), FORGET_S
            )
            self.fault[index] = self.fault[index] or "left alone"
            return
        recent.append(now_s)
        self._recovery.begin(index, self._shake, due_s, reboot)

    def _stays(self, index: int) -> bool:
        return self.away.get(index) in ("limp", "hold")

    def _names(self, index: int, bits: int) -> list[str]:
        table = self._tables[index]
        faults = table.faults if table.protocol == 2 else table.status_faults
        return [faults.get(bit, f"hardware error bit {bit}") for bit in range(8) if bits >> bit & 1]
