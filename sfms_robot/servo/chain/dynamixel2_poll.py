"""One tick of asking everybody: who answered, who did not, and what the answers' alert bits mean.

A dead servo breaks the chain of answers, so whoever stands behind it is asked again in the same tick, without it. A
fast sync read (all in one packet) is used while it works: five failures in a row, and it is not tried again.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from sfms_robot.config import Bus as BusConfig
from sfms_robot.servo.chain.dynamixel2_link import Dxl2Link
from sfms_robot.servo.chain.dynamixel2_telemetry import Block, Telemetry
from sfms_robot.servo.chain.roster import Roster
from sfms_robot.servo.chain.schedule import Rotation, blocks_per_tick
from sfms_robot.servo.codecs.dxl2 import ALERT, Packet

log = logging.getLogger(__name__)

_REQUESTS: Final = 3  # for the same thing in one tick at most
_PROBES: Final = 4  # in one tick, as long as they are answered
_FAST_FAILURES: Final = 5
_HEALTH_TICKS: Final = 5  # between two looks at torque and error status
_HEALTH_SHARE: Final = 8  # servos in one look
_ALERTS_READ: Final = 2  # per tick
_LENGTHS: Final = 4  # of a read, one byte apart: a late answer has the length of a request that is over


@dataclass
class Heard:
    """What one tick brought, by id."""

    any: bool = False
    newly_silent: list[int] = field(default_factory=list)
    probed_in_vain: list[int] = field(default_factory=list)
    came_back: list[int] = field(default_factory=list)
    alerts: dict[int, bool] = field(default_factory=dict)
    health: dict[int, tuple[int, int]] = field(default_factory=dict)  # torque enable, error bits
    blocks: list[int] = field(default_factory=list)


class Sweep:
    """Asks the servos of one bus. `ids` in bus order; the counters of the bus are counted up in place."""

    def __init__(
        self,
        name: str,
        ids: Sequence[int],
        telemetry: Telemetry,
        goal_size: int,
        config: BusConfig,
        counts: dict[str, int],
    ) -> None:
        self.roster = Roster(ids)
        self._name = name
        self._ids = list(ids)
        self._index = {servo: i for i, servo in enumerate(ids)}
        self._telemetry = telemetry
        self._goal_size = goal_size
        self._config = config
        self._counts = counts
        self._fast = False
        self._fast_proven = False
        self._fast_failures = 0
        self._blocks = 1
        self._rotation, self._looks = Rotation(), Rotation()
        self._tick = 0
        self._alerting: set[int] = set()
        self._extra = 0

    def restart(self, link: Dxl2Link) -> None:
        """Everybody is listed; find out whether they can answer in one packet."""
        self.roster = Roster(self._ids)
        self._fast, self._fast_proven, self._fast_failures = self._config.fast_read != "off", False, 0
        self._alerting.clear()
        if self._config.fast_read == "auto":
            answers = link.fast_sync_read(*self._telemetry.position, self._ids)
            self._fast = len(answers) == len(self._ids)
        self._plan()

    def measure(self, link: Dxl2Link, now_s: float) -> None:
        """Everything of everybody, once."""
        self._take(
            self._telemetry.block, self._request(link, self._telemetry.block, self._ids, self._fast), now_s, Heard()
        )

    def tick(self, link: Dxl2Link, now_s: float) -> Heard:
        """Raises BusError when the port fails."""
        heard = Heard()
        telemetry, listed = self._telemetry, self.roster.listed
        whole = self._blocks >= len(self._ids)
        answers, gaps, missed = self._everybody(link, telemetry.block if whole else telemetry.position, listed)
        self._take(telemetry.block if whole else telemetry.position, answers, now_s, heard)
        if not whole and answers:
            chosen = self._rotation.take([servo for servo in listed if servo in answers], self._blocks)
            self._take(telemetry.block, self._request(link, telemetry.block, chosen, self._fast), now_s, heard)
        for servo in answers:
            self.roster.answered(servo)
        heard.newly_silent = self.roster.blame(bool(answers), gaps, missed, now_s)
        self._tick += 1
        if self._tick % _HEALTH_TICKS == 0 and answers:
            self._look(link, self._looks.take(list(answers), _HEALTH_SHARE), heard)
        self._new_alerts(link, heard)
        self._probe(link, now_s, heard)
        heard.any = bool(answers) or bool(heard.came_back)
        return heard

    # --- requests -----------------------------------------------------------------------------------------------

    def _everybody(
        self, link: Dxl2Link, where: Block, ids: Sequence[int]
    ) -> tuple[dict[int, Packet], list[int], list[int]]:
        """(answers, ids at which the chain broke, ids that were passed over)."""
        answers: dict[int, Packet] = {}
        gaps: list[int] = []
        missed: list[int] = []
        rest = list(ids)
        for attempt in range(_REQUESTS):
            # A wire that was quiet in the last tick as well is asked once: most likely nobody is there.
            if not rest or (attempt > 0 and not answers and self.roster.quiet_polls > 0):
                break
            self._counts["retries"] += attempt > 0
            fast = self._fast and attempt == 0 and len(rest) > 1
            got = self._request(link, where, rest, fast)
            if fast and not got:
                if self._fast_proven:  # the first servo is the likely cause: one silence in a tick is enough
                    missed, rest = rest[:1], rest[1:]
                else:
                    rest = [*rest[1:], rest[0]]  # was it the first servo, or the fast read? Now the others come first
                continue
            if self._fast and attempt == 1 and not answers:
                self._count_against_fast(len(got) == len(rest))
            elif fast:
                self._fast_failures = 0
                self._fast_proven |= len(got) == len(rest)
            answers |= got
            last = max((i for i, servo in enumerate(rest) if servo in got), default=-1)
            missed += [servo for servo in rest[: last + 1] if servo not in got]
            gaps += rest[last + 1 : last + 2]
            rest = rest[last + 2 :]
        if not answers:
            missed = []  # on a quiet wire nobody was passed over
        self._counts["errors"] += len(gaps) + len(missed)
        return answers, gaps, missed

    def _request(self, link: Dxl2Link, where: Block, ids: Sequence[int], fast: bool) -> dict[int, Packet]:
        """Answers, trimmed to `where`. After a silence other lengths are asked for, so that what comes late is told."""
        self._counts["reads"] += 1
        address, length = where
        longer = length + self._extra
        read = link.fast_sync_read if fast and len(ids) > 1 else link.sync_read
        got = read(address, longer, ids)
        if self._extra:
            got = {servo: packet._replace(params=packet.params[:length]) for servo, packet in got.items()}
        if len(got) < len(ids):
            self._extra = (self._extra + 1) % _LENGTHS
        return got

    def _count_against_fast(self, all_there: bool) -> None:
        """Silence to a fast read that a plain one then breaks, everybody answering."""
        self._fast_failures = self._fast_failures + 1 if all_there else 0
        if self._fast_failures >= _FAST_FAILURES:
            self._fast = False
            self._plan()
            log.warning("bus %r: fast sync read is not answered; plain sync read from now on", self._name)

    def _plan(self) -> None:
        telemetry, config = self._telemetry, self._config
        self._blocks = blocks_per_tick(
            len(self._ids),
            telemetry.position[1],
            telemetry.block[1],
            self._goal_size,
            config.baud,
            config.rate_hz,
            self._fast,
        )

    # --- answers ------------------------------------------------------------------------------------------------

    def _take(self, where: Block, answers: dict[int, Packet], now_s: float, heard: Heard) -> None:
        good = []
        for servo, packet in answers.items():
            error = packet.error
            if error or servo in self._alerting:
                heard.alerts[servo] = bool(error & ALERT)
            if error & ~ALERT:
                self._counts["errors"] += 1
            else:
                good.append(servo)
        if good:
            indices = [self._index[servo] for servo in good]
            self._telemetry.take(where, indices, [answers[servo] for servo in good], now_s)
            if where == self._telemetry.block:
                heard.blocks += good

    def _look(self, link: Dxl2Link, ids: Sequence[int], heard: Heard) -> None:
        """Torque enable and error status of a few."""
        where = self._telemetry.health
        for servo, packet in self._request(link, where, ids, fast=False).items():
            self._health(servo, packet, heard)

    def _health(self, servo: int, packet: Packet, heard: Heard) -> None:
        start, length = self._telemetry.health
        if len(packet.params) != length:
            return
        torque, error = self._telemetry.torque, self._telemetry.error
        bits = error.from_bytes(packet.params[error.address - start :]) if error is not None else 0
        heard.health[servo] = torque.from_bytes(packet.params[torque.address - start :]), bits

    def _new_alerts(self, link: Dxl2Link, heard: Heard) -> None:
        """Read what is wrong with servos whose alert bit has just come on."""
        fresh = [servo for servo, alert in heard.alerts.items() if alert and servo not in self._alerting]
        asked = fresh[:_ALERTS_READ]
        self._alerting -= {servo for servo, alert in heard.alerts.items() if not alert}
        self._alerting |= set(asked)
        if asked:
            self._look(link, asked, heard)

    def _probe(self, link: Dxl2Link, now_s: float, heard: Heard) -> None:
        """Ask silent servos that have waited long enough, one by one, until one does not answer."""
        for _ in range(_PROBES):
            servo = self.roster.due(now_s)
            if servo is None:
                return
            self._counts["retries"] += 1
            answer = self._request(link, self._telemetry.position, [servo], fast=False)
            if not answer:
                self.roster.probe_failed(servo, now_s)
                heard.probed_in_vain.append(servo)
                return
            self._take(self._telemetry.position, answer, now_s, heard)
            self.roster.answered(servo)
            self.roster.hurry(now_s)
            heard.came_back.append(servo)
            self._look(link, [servo], heard)
