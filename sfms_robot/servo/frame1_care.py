"""What becomes of a servo in trouble on a bus of the FF FF family, while the bus runs.

    fault, pinch, strain   its policy: hold, limp, reduce, or (there is no reboot) limp for a while and on again
    silent, restarted      goals are withheld; once it answers it is prepared and switched on as at start-up
    back                   it holds where it stands, and takes goals again when they begin there

These servos switch their torque on by themselves when they are given a goal: withholding goals is what keeps a limp
one limp. Everything is said once. Who comes back too often is left alone.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from sfms_robot.config import Faults
from sfms_robot.servo.policy import BusServo, LoadWatch, Measured, Voice
from sfms_robot.servo.registers import Table

log = logging.getLogger(__name__)

TORQUE_LOST: Final = "torque lost"  # it restarted, or something switched it off
PAUSE_S: Final = 0.2  # with a servo that falls silent on its way back
AGAIN_S: Final = 2.0  # after a refusal
REST_S: Final = 3.0  # a joint that gave way stays limp so long before it is tried again
ATTEMPTS: Final = 5
FORGET_S: Final = 60.0  # attempts older than this do not count any more
NEAR: Final = 1 / 240  # of a turn: a goal this close to where a joint stands continues from there


@dataclass(slots=True)
class _Trouble:
    """What is wrong with one servo.

    `due_s`: when to try to bring it back; None = it stays as it is. `ends_s`: when it came back, or refused to.
    """

    bits: int = 0
    fault: str | None = None
    away: bool = False
    due_s: float | None = None
    rejoining: int | None = None
    ends_s: list[float] = field(default_factory=list)


class Frame1Care:
    """Troubles of the servos of one bus, by index in bus order.

    Attributes:
        wanted: who was switched on and not off again.
        rejoined: who came to hold a position in this tick.
    """

    def __init__(self, servos: Sequence[BusServo], tables: Sequence[Table], faults: Faults) -> None:
        self._servos = servos
        self._tables = tables
        self._voice = Voice(servos, faults)
        self._loads = LoadWatch(servos)
        self._troubles = [_Trouble() for _ in servos]
        self.wanted: set[int] = set()
        self.rejoined: set[int] = set()

    @property
    def said(self) -> Mapping[str, None]:
        """Every fault so far, `joint: fault`, in the order of appearance."""
        return self._voice.said

    def fault(self, index: int) -> str | None:
        return self._troubles[index].fault

    def switched_on(self, index: int) -> None:
        """Torque came on by `enable`: a clean slate."""
        self.wanted.add(index)
        trouble = self._troubles[index]
        trouble.away, trouble.due_s, trouble.rejoining = False, None, None
        if trouble.fault == TORQUE_LOST:
            trouble.fault = None

    def switched_off(self) -> None:
        """No goals to anybody any more."""
        self.wanted.clear()
        for trouble in self._troubles:
            trouble.away, trouble.due_s, trouble.rejoining = False, None, None

    def receivers(self, ticks: Sequence[int]) -> list[int]:
        """Who gets goals: switched on, not away, and not waiting for goals that begin where it stands."""
        out = []
        for index in sorted(self.wanted):
            trouble = self._troubles[index]
            if trouble.rejoining is not None:
                near = NEAR * self._tables[index].ticks_per_revolution
                if abs(ticks[index] - trouble.rejoining) > near:
                    continue
                trouble.rejoining = None
            if not trouble.away:
                out.append(index)
        return out

    # --- what is noticed ----------------------------------------------------------------------------------------

    def take_status(self, index: int, error: int, seen: Measured, now_s: float) -> str | None:
        """The error byte of an answer; the policy to apply now, None for none."""
        table, trouble = self._tables[index], self._troubles[index]
        bits = sum(1 << bit for bit in table.status_faults if error >> bit & 1)
        new, trouble.bits = bits & ~trouble.bits, bits
        names = [name for bit, name in sorted(table.status_faults.items()) if bits >> bit & 1]
        names = [name for name in names if self._voice.counts(index, name, seen)]
        if not names:
            stays_out = trouble.away and trouble.due_s is None  # for good, and says why though the cause has passed
            if trouble.fault != TORQUE_LOST and not stays_out:
                trouble.fault = None
            return None
        trouble.fault = ", ".join(names)
        self._voice.say(index, trouble.fault)
        fresh = any(new >> bit & 1 and name in names for bit, name in table.status_faults.items())
        return self._policy(index, self._servos[index].safety.on_fault, now_s) if fresh else None

    def take_current(self, index: int, current_mA: float, now_s: float) -> str | None:
        """A present current; the policy to apply now, None for none."""
        broken = self._loads.step(index, current_mA, now_s)
        if broken is None or self._troubles[index].away:
            return None
        name, rule = broken
        self._voice.say(index, f"{name} ({abs(current_mA):.0f} mA)")
        policy = self._policy(index, rule.then, now_s)
        if policy == "limp":
            self._again(index, now_s + REST_S, now_s)
        return policy

    def _policy(self, index: int, policy: str, now_s: float) -> str | None:
        """Withhold goals where the policy wants it."""
        trouble = self._troubles[index]
        if index not in self.wanted or trouble.away:
            return None
        if policy != "reduce":
            trouble.away, trouble.due_s = True, None
        if policy == "reboot_and_ease_in":
            self._again(index, now_s + REST_S, now_s)
            return "limp"
        return policy

    def torque_lost(self, index: int, now_s: float) -> None:
        """Its torque is off and we think it is on."""
        trouble = self._troubles[index]
        if index in self.wanted and not trouble.away:
            if trouble.fault is None:
                trouble.fault = TORQUE_LOST
                self._voice.say(index, TORQUE_LOST)
            self.distrust(index, now_s)

    def gone(self, index: int) -> None:
        """It does not answer."""
        if index in self.wanted and not self._troubles[index].away:
            self._troubles[index].away = True
            self._troubles[index].due_s = float("inf")  # until it answers

    def answers(self, index: int, now_s: float) -> None:
        """A servo that was gone answers again."""
        if self._troubles[index].due_s is not None:
            self._again(index, now_s, now_s)

    def distrust(self, index: int, now_s: float) -> None:
        """Something may have gone on behind our back: bring it back as if it had been away."""
        if index in self.wanted:
            self._troubles[index].away, self._troubles[index].rejoining = True, None
            self._again(index, now_s, now_s)

    # --- the way back -------------------------------------------------------------------------------------------

    def due(self, now_s: float) -> int | None:
        """Whom to try to bring back now."""
        waiting = [(t.due_s, i) for i, t in enumerate(self._troubles) if t.due_s is not None and i in self.wanted]
        first = min(waiting, default=None)
        return first[1] if first is not None and first[0] <= now_s else None

    def back(self, index: int, ticks: int, now_s: float) -> None:
        """It has torque again and holds `ticks`."""
        trouble = self._troubles[index]
        trouble.ends_s.append(now_s)
        trouble.away, trouble.due_s, trouble.rejoining = False, None, ticks
        trouble.fault, trouble.bits = None, 0
        self.rejoined.add(index)
        log.warning("%s is back and holds where it stands", self._voice.about(index))

    def later(self, index: int, now_s: float) -> None:
        """It fell silent on its way back, which is not its last word."""
        self._troubles[index].due_s = now_s + PAUSE_S

    def failed(self, index: int, reason: str, now_s: float) -> None:
        """It refused."""
        log.warning("%s", reason)
        self._troubles[index].ends_s.append(now_s)
        self._again(index, now_s + AGAIN_S, now_s)

    def _again(self, index: int, due_s: float, now_s: float) -> None:
        trouble = self._troubles[index]
        trouble.ends_s = [time_s for time_s in trouble.ends_s if now_s - time_s < FORGET_S]
        if len(trouble.ends_s) >= ATTEMPTS:
            log.warning("%s: %d attempts in %g s, it is left alone", self._voice.about(index), ATTEMPTS, FORGET_S)
            trouble.due_s, trouble.fault = None, trouble.fault or "left alone"
            return
        trouble.due_s = due_s
