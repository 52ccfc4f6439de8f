"""A bus of servos that speak the FF FF frame and have no watchdog: what Dynamixel 1.0 and Feetech have in common.

What it promises stands in `chain_bus`. Where the family can, all servos are read by one request, and those behind a
silent one by a second. Where it cannot, they are read one by one, as many per poll as the budget allows, in rotation.
These servos switch their torque on by themselves when they are given a goal: withholding goals is what keeps a limp
one limp.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Bus as BusConfig
from sfms_robot.config import Faults
from sfms_robot.ports import TickConversion
from sfms_robot.servo.chain.chain_bus import READ_DEADLINE_S, ChainBus
from sfms_robot.servo.chain.link import Answer
from sfms_robot.servo.chain.protocol1_link import Family, Frame1Link
from sfms_robot.servo.chain.protocol1_poll import GroupRead, InTurn, ask_together
from sfms_robot.servo.chain.protocol1_startup import Protocol1Startup
from sfms_robot.servo.chain.protocol1_telemetry import Frame1Telemetry
from sfms_robot.servo.chain.roster import Roster
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port

log = logging.getLogger(__name__)

POLL_SHARE: Final = 0.6  # of a tick that reading servos one by one may take
_GROUP_TRIAL_S: Final = 0.05


class Frame1Bus(ChainBus[Frame1Link, Frame1Telemetry]):
    """One wire of servos, as `ports.Bus`; arguments as of `ChainBus`.

    Subclasses say which family, and how it reads several servos at once.
    """

    family: ClassVar[Family]

    def __init__(
        self,
        name: str,
        servos: Sequence[BusServo],
        conversion: TickConversion,
        open_port: Callable[[], Port],
        baud: int,
        read_deadline_s: float = READ_DEADLINE_S,
        config: BusConfig | None = None,
        faults: Faults | None = None,
    ) -> None:
        super().__init__(name, servos, conversion, open_port, baud, read_deadline_s, config, faults)
        budget_s = POLL_SHARE / self._config.rate_hz
        self._in_turn = InTurn(list(self._index), self._telemetry.block, baud, budget_s)
        self._roster = Roster(list(self._index))
        self._group: GroupRead | None = None
        self._checkup = 0  # whose torque or current is read next

    @abstractmethod
    def _group_reader(self, link: Frame1Link) -> GroupRead | None:
        """How the family reads several servos by one request; None when it does not."""

    def _state(self) -> Frame1Telemetry:
        return Frame1Telemetry(self.name, self.family, self._tables, self._conversion)

    def _open(self) -> Frame1Link:
        return Frame1Link(self._open_port(), self._baud, self._read_deadline_s, self.family)

    def _shake(self, link: Frame1Link, tries: int = 3) -> Protocol1Startup:
        return Protocol1Startup(self.name, link, self._servos, self._tables, self._conversion, self._baud, tries)

    @property
    def _listed(self) -> Roster:
        return self._roster

    def _met(self, link: Frame1Link, bits: Mapping[int, int]) -> None:
        self._roster = Roster(list(self._index))
        self._group = self._tried(link, self._group_reader(link))

    def _tried(self, link: Frame1Link, read: GroupRead | None) -> GroupRead | None:
        if read is None:
            return None
        with link.patient(_GROUP_TRIAL_S):
            if len(read(*self._telemetry.block, list(self._index))) == len(self._index):
                return read
        log.info("bus %r: not every servo answers a request for several: they are read one by one", self.name)
        return None

    def _returned(self, link: Frame1Link, now_s: float) -> None:
        super()._returned(link, now_s)
        self._group = self._group and self._group_reader(link)

    # --- every tick ---------------------------------------------------------------------------------------------

    def _send(self, link: Frame1Link, places: NDArray[np.intp], ticks: NDArray[np.int64], now_s: float) -> None:
        goal = self._telemetry.fields["goal_position"]
        link.sync_write(goal.address, {self._servos[i].id: goal.to_bytes(int(ticks[i])) for i in places})

    def _listen(self, link: Frame1Link, now_s: float) -> bool:
        listed = self._roster.listed
        if self._group is not None:
            sweep = ask_together(self._group, self._telemetry.block, listed, self._roster.quiet_polls)
        else:
            sweep = self._in_turn.ask(link, listed)
        self._counts["reads"] += sweep.requests
        self._counts["retries"] += sweep.retries
        self._counts["errors"] += len(sweep.gaps) + len(sweep.missed)
        for servo, answer in sweep.answers.items():
            self._roster.answered(servo)
            self._take(self._index[servo], answer, now_s)
        for servo in self._roster.blame(bool(sweep.answers), sweep.gaps, sweep.missed, now_s):
            self._absences.gone(self._index[servo], now_s)
        self._look_closer(link, [servo for servo in listed if servo in sweep.answers], now_s)
        return self._probe(link, now_s) or bool(sweep.answers)

    def _take(self, index: int, answer: Answer, now_s: float) -> None:
        if len(answer.data) != self._telemetry.block[1]:
            self._counts["errors"] += 1  # it refuses to say
            return
        self._telemetry.take(index, answer.data, now_s)
        about_it = sum(1 << bit for bit in self._tables[index].status_faults)  # the other bits are about the request
        self._care.take_bits(index, answer.error & about_it, now_s)

    def _look_closer(self, link: Frame1Link, ids: Sequence[int], now_s: float) -> None:
        """Of one servo per poll, what is not in the block: whether it has torque, and in turn its current."""
        if not ids:
            return
        self._checkup += 1
        kinds = 2 if any(self._telemetry.currents) else 1
        servo = ids[self._checkup // kinds % len(ids)]
        index = self._index[servo]
        current = self._telemetry.currents[index]
        if current is not None and self._checkup % 2:
            answer = link.read(servo, current.address, current.size)
            if answer is not None and len(answer.data) == current.size:
                self._telemetry.take_current(index, current, answer.data)
                self._care.take_currents([index], now_s)
        else:
            self._check_torque(link, index, now_s)

    def _check_torque(self, link: Frame1Link, index: int, now_s: float) -> None:
        """A servo without torque gets no goals from now on; switched on by a goal, it would jump."""
        if index in self._care.wanted:
            torque = self._telemetry.torque
            answer = link.read(self._servos[index].id, torque.address, torque.size)
            if answer is not None and answer.data == torque.to_bytes(0):
                self._care.torque_lost(index, now_s)

    def _probe(self, link: Frame1Link, now_s: float) -> bool:
        """Ask the silent servo that has waited longest; when that is in vain, it was more than a lost answer."""
        servo = self._roster.due(now_s)
        if servo is None:
            return False
        index = self._index[servo]
        self._counts["retries"] += 1
        answer = link.read(servo, *self._telemetry.block)
        if answer is None:
            self._roster.probe_failed(servo, now_s)
            self._absences.gone(index, now_s, again=False)
            self._care.gone(index, "silent")
            return False
        self._roster.answered(servo)
        self._roster.hurry(now_s)
        self._absences.back(index)
        self._take(index, answer, now_s)
        self._care.answers(index, now_s)
        self._check_torque(link, index, now_s)
        return True
